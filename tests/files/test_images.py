"""Reading images: what is refused, what is said, and what the pixels are."""

from __future__ import annotations

import struct
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.image_files import find_images, read_header, view_names
from neurocal_cli.files.images import encode_png, parse_image, read_image

COLOUR = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
GREY = COLOUR[..., 0].copy()
LOSSLESS = [".png", ".tif", ".bmp", ".ppm"]


def encoded(ending: str, picture: np.ndarray) -> bytes:
    done, data = cv2.imencode(ending, picture)
    assert done
    return data.tobytes()


def exif(orientation: int, order: str = "<") -> bytes:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(f"{order}IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def turned(ending: str, orientation: int, order: str = "<") -> bytes:
    """A file of ``GREY`` with an EXIF orientation."""
    data = encoded(ending, GREY)
    if ending == ".png":
        return data[:33] + chunk(b"eXIf", exif(orientation, order)) + data[33:]
    block = b"Exif\0\0" + exif(orientation, order)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:]


@pytest.mark.parametrize("ending", [*LOSSLESS, ".pgm"])
def test_grey_pixels_come_back_as_they_are(ending: str) -> None:
    plain = b"P5\n# a comment\n40 30\n255\n" + GREY.tobytes()
    data = plain if ending == ".ppm" else encoded(ending, GREY)
    image = parse_image(data)
    assert (image.grey.dtype, image.size, image.notes) == (np.uint8, (40, 30), ())
    np.testing.assert_array_equal(image.grey, GREY)


@pytest.mark.parametrize("ending", LOSSLESS)
def test_colours_are_weighed_as_opencv_weighs_them(ending: str) -> None:
    expected = COLOUR @ np.array([0.114, 0.587, 0.299])
    assert np.abs(parse_image(encoded(ending, COLOUR)).grey - expected).max() <= 1.1


@pytest.mark.parametrize("ending", [".png", ".tif", ".pgm"])
def test_sixteen_bits_are_kept(ending: str) -> None:
    deep = GREY.astype(np.uint16) * 257
    image = parse_image(encoded(ending, deep))
    assert image.grey.dtype == np.uint16
    np.testing.assert_array_equal(image.grey, deep)


def test_a_jpeg_is_read() -> None:
    smooth = np.tile(np.arange(40, dtype=np.uint8) * 4, (30, 1))
    assert np.abs(parse_image(encoded(".jpg", smooth)).grey.astype(int) - smooth).max() < 6


@pytest.mark.parametrize("ending", [".png", ".jpg"])
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", "<>")
def test_the_exif_orientation_is_applied_as_opencv_does_and_said(
    ending: str, orientation: int, order: str
) -> None:
    data = turned(ending, orientation, order)
    image = parse_image(data, "a.jpg")
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(image.grey, expected)
    assert image.size == ((30, 40) if orientation >= 5 else (40, 30))
    assert len(image.notes) == (orientation != 1)
    assert all("EXIF" in note for note in image.notes)


def test_a_turned_image_is_upright() -> None:
    np.testing.assert_array_equal(parse_image(turned(".png", 3)).grey, GREY[::-1, ::-1])
    np.testing.assert_array_equal(parse_image(turned(".png", 6)).grey, np.rot90(GREY, -1))


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif", ".bmp", ".ppm", ".pgm"])
def test_a_file_cut_anywhere_is_refused_in_one_line(ending: str, capfd: pytest.CaptureFixture[str]) -> None:
    data = encoded(ending, COLOUR if ending != ".pgm" else GREY)
    for length in [*range(60), *range(60, len(data), len(data) // 40), len(data) - 1]:
        with pytest.raises(FormatError) as caught:
            parse_image(data[:length], "cut")
        assert str(caught.value).startswith("cut: ")
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif", ".bmp", ".pgm"])
def test_damaged_files_are_refused_or_read_but_never_crash(
    ending: str, capfd: pytest.CaptureFixture[str]
) -> None:
    rng, data = np.random.default_rng(1), encoded(ending, GREY)
    for _ in range(150):
        damaged = bytearray(data)
        for place in rng.integers(0, min(len(data), 400), 4):
            damaged[place] = rng.integers(256)
        with suppress(FormatError):
            parse_image(bytes(damaged), "a", most_pixels=1_000_000)
    assert capfd.readouterr() == ("", "")


def test_a_jpeg_that_is_damaged_inside_is_refused() -> None:
    data = bytearray(encoded(".jpg", COLOUR))
    data[len(data) // 2 : len(data) // 2 + 40] = b"\x5a\xff\xd0" * 13 + b"\0"
    with pytest.raises(FormatError, match="damaged"):
        parse_image(bytes(data))


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "is empty"),
        (b"view,X,Y,Z,u,v\n" * 9, "is not a readable image"),
        (b"GIF89a" + bytes(50), "is a GIF file, which is not read"),
        (b"P5\n0 7\n255\n", "0 x 7 px"),
        (b"P5\nx y\n255\n" + bytes(50), "damaged"),
        (b"P5\n5 5\n255\n", "cut off"),
    ],
)
def test_what_is_no_image_is_said(data: bytes, problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        parse_image(data, "file")


def bombs() -> dict[str, bytes]:
    """Small files that claim 60000 x 50000 px."""
    png = encoded(".png", GREY)
    head = chunk(b"IHDR", struct.pack(">II", 60000, 50000) + png[24:29])
    jpg = bytearray(encoded(".jpg", GREY))
    frame = jpg.find(b"\xff\xc0")
    jpg[frame + 5 : frame + 9] = struct.pack(">HH", 50000, 60000)
    tif = encoded(".tif", GREY)
    for tag, value in ((256, 60000), (257, 50000)):
        place = tif.find(struct.pack("<H", tag) + b"\x03\0" + struct.pack("<I", 1))
        tif = tif[: place + 8] + struct.pack("<I", value) + tif[place + 12 :]
    bmp = bytearray(encoded(".bmp", GREY))
    bmp[18:26] = struct.pack("<ii", 60000, -50000)
    bmp[30:34] = struct.pack("<I", 1)  # packed: the file's length tells nothing
    return {
        "png": png[:8] + head + png[33:],
        "jpg": bytes(jpg),
        "tif": tif,
        "bmp": bytes(bmp),
        "pnm": b"P2 60000 50000 255 1 2 3",
    }


@pytest.mark.parametrize("kind", bombs())
def test_a_file_that_claims_too_many_pixels_is_refused_before_it_is_decoded(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", never)
    with pytest.raises(FormatError, match="60000 x 50000 px, more than the 200 million"):
        parse_image(bombs()[kind], "bomb")


@pytest.mark.parametrize("value", [0, 255])
def test_tiny_black_and_white_images_are_read(value: int) -> None:
    assert parse_image(encoded(".png", np.full((8, 8), value, np.uint8))).size == (8, 8)
    assert parse_image(encoded(".png", np.full((1, 1), value, np.uint8))).grey.item() == value


def test_a_header_is_read_without_the_pixels() -> None:
    header = read_header(turned(".jpg", 8), "a")
    assert (header.kind, header.width, header.height, header.orientation) == ("JPEG", 40, 30, 8)


def test_a_missing_file_and_a_folder_are_said(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_image(tmp_path / "none.png")
    with pytest.raises(FormatError, match="is a folder"):
        read_image(tmp_path)


def test_a_picture_is_written_in_its_colours() -> None:
    red = np.zeros((5, 4, 3), np.uint8)
    red[..., 0] = 200
    back = cv2.imdecode(np.frombuffer(encode_png(red), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(back, red[..., ::-1])
    with pytest.raises(InputError, match="shape"):
        encode_png(np.zeros((0, 4), np.uint8))


def test_folders_and_patterns_name_their_images_in_order(tmp_path: Path) -> None:
    for name in ("b2.png", "b1.JPG", "a.tiff", "notes.txt", ".hidden.png"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder.png").mkdir()
    inside = [str(tmp_path / name) for name in ("a.tiff", "b1.JPG", "b2.png")]
    assert list(find_images([str(tmp_path)])) == inside
    assert list(find_images([f"{tmp_path}/b*"])) == inside[1:]
    assert find_images(["-", "absent.png"]) == ("-", "absent.png")
    with pytest.raises(FormatError, match="no file matches"):
        find_images([f"{tmp_path}/c*.png"])
    with pytest.raises(FormatError, match="holds no images"):
        find_images([str(tmp_path / "folder.png")])


def test_a_file_whose_name_looks_like_a_pattern_is_that_file(tmp_path: Path) -> None:
    path = tmp_path / "a[1].png"
    path.write_bytes(b"x")
    assert find_images([str(path)]) == (str(path),)


def test_views_are_named_after_their_files_and_each_once() -> None:
    assert view_names(["a/left01.png", "b/left02.png", "-"]) == ("left01", "left02", "stdin")
    with pytest.raises(InputError, match=r"a/x\.png and b/x\.jpg would both be the view 'x'"):
        view_names(["a/x.png", "b/x.jpg"])
    with pytest.raises(InputError, match=r"x\.png is given twice"):
        view_names(["x.png", "x.png"])

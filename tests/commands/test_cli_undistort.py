"""``neurocal undistort``: what is written, what is said, and how it ends."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result
from support.command_line import refused, run, succeed
from support.places import SAMPLES

from neurocal_cli import Correspondences, read_calibration, read_points, undistort_image, undistort_points
from neurocal_cli.files.exchange.reading import read_camera
from neurocal_cli.files.points_csv import write_points

SIZE = (400, 300)
ROS = """image_width: 400
image_height: 300
camera_name: left
camera_matrix: {{rows: 3, cols: 3, data: [510, {skew}, 202, 0, 508, 147, 0, 0, 1]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: {n}, data: {k}}}
"""


def undistort(*words: object, stdin: bytes | None = None) -> Result:
    return run("undistort", *words, stdin=stdin)


def camera_file(path: Path, model: str, k: list[float], skew: float = 0.0) -> Path:
    path.write_text(ROS.format(model=model, n=len(k), k=k, skew=skew))
    return path


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    return camera_file(tmp_path / "camera.yaml", "plumb_bob", [-0.3, 0.1, 0.001, 0.002, 0.0], 0.5)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for k in (1, 2, 3):
        shutil.copy(SAMPLES / f"board{k:02d}.png", folder)
    return folder


@pytest.fixture
def points(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [399, 299], (8, 2))
    write_points(
        Correspondences(
            rng.normal(size=(8, 3)),
            pixels,
            ["a"] * 4 + ["b, c"] * 4,
            image_size=SIZE,
            point=list("12341234"),
            covariance=np.tile([0.04, 0.01, 0.02], (8, 1)),
            unit="inch",
        ),
        tmp_path / "points.csv",
    )
    return tmp_path / "points.csv"


def picture(path: Path) -> np.ndarray:
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image)


def write(path: Path, image: np.ndarray) -> Path:
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return path


# Images


def test_images_go_to_a_folder(camera: Path, images: Path, tmp_path: Path) -> None:
    result = undistort(camera, images, "-o", tmp_path / "straight")
    assert (result.exit_code, result.stdout) == (0, "")
    assert result.stderr == "undistorted 3 of 3 files\n"
    names = sorted(path.name for path in (tmp_path / "straight").iterdir())
    assert names == ["board01.png", "board02.png", "board03.png"]
    seen = picture(images / "board01.png")
    expected = undistort_image(seen, read_camera(camera))
    assert np.array_equal(picture(tmp_path / "straight" / "board01.png"), expected)
    assert not np.array_equal(expected, seen)


def test_one_image_goes_to_a_file_of_any_kind(camera: Path, images: Path, tmp_path: Path) -> None:
    for name in ("one.png", "one.tif", "one.jpg", "one.bmp", "one.pgm"):
        result = undistort(camera, images / "board01.png", "-o", tmp_path / name)
        assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
        near = np.abs(picture(tmp_path / name).astype(int) - picture(tmp_path / "one.png"))
        assert near.max() <= (20 if name == "one.jpg" else 0)


def test_one_image_goes_to_a_folder_too(camera: Path, images: Path, tmp_path: Path) -> None:
    assert undistort(camera, images / "board01.png", "-o", tmp_path / "new").exit_code == 0
    assert (tmp_path / "new" / "board01.png").is_file()


def test_one_image_goes_to_standard_output(camera: Path, images: Path, tmp_path: Path) -> None:
    undistort(camera, images / "board01.png", "-o", tmp_path / "one.png")
    result = undistort(camera, images / "board01.png")
    assert result.exit_code == 0
    assert result.stdout_bytes == (tmp_path / "one.png").read_bytes()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(300, 400), (300, 400, 3)])
def test_depth_and_colours_stay(camera: Path, tmp_path: Path, dtype: type, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    write(tmp_path / "in.png", image)
    assert undistort(camera, tmp_path / "in.png", "-o", tmp_path / "out.png").exit_code == 0
    done = picture(tmp_path / "out.png")
    assert (done.shape, done.dtype) == (image.shape, image.dtype)
    assert np.array_equal(done, undistort_image(image, read_camera(camera)))


def test_sixteen_bits_do_not_become_eight(camera: Path, tmp_path: Path) -> None:
    write(tmp_path / "in.png", np.zeros((300, 400), np.uint16))
    result = undistort(camera, tmp_path / "in.png", "-o", tmp_path / "out.jpg")
    refused(result, "an image of 16 bits cannot be written to a .jpg file; use .png")
    assert not (tmp_path / "out.jpg").exists()


def test_images_that_cannot_be_corrected_are_a_line_each(camera: Path, images: Path, tmp_path: Path) -> None:
    write(images / "small.png", np.zeros((50, 100), np.uint8))
    (images / "broken.png").write_bytes(b"no image")
    result = undistort(camera, images, "-o", tmp_path / "straight")
    assert result.exit_code == 0
    assert result.stderr.splitlines() == [
        f"{images}/broken.png: is not a readable image; give PNG, JPEG, TIFF, BMP, PGM or PPM",
        f"{images}/small.png: has 100 x 50 px, but the camera is for 400 x 300 px; give original "
        "images of this camera or, if they were resized, make theirs: neurocal resize CAMERA.yaml --to 100 "
        "50 -o RESIZED.yaml",
        "undistorted 3 of 5 files",
    ]
    assert len(list((tmp_path / "straight").iterdir())) == 3


def test_if_nothing_can_be_corrected_nothing_is_written(camera: Path, images: Path, tmp_path: Path) -> None:
    for path in images.iterdir():
        write(path, np.zeros((50, 100), np.uint8))
    result = undistort(camera, images, "-o", tmp_path / "straight", "--camera", tmp_path / "new.yaml")
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1] == (
        "Error: none of the 3 files could be undistorted; see the reasons above"
    )
    assert not (tmp_path / "straight").exists()
    assert not (tmp_path / "new.yaml").exists()


def test_one_image_of_another_size_is_an_error(camera: Path, tmp_path: Path) -> None:
    write(tmp_path / "small.png", np.zeros((50, 100), np.uint8))
    result = undistort(camera, tmp_path / "small.png", "-o", tmp_path / "out.png")
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: {tmp_path}/small.png: has 100 x 50 px, but the camera is for")


def test_a_camera_without_a_size_takes_that_of_the_first_image(images: Path, tmp_path: Path) -> None:
    text = ROS.format(model="plumb_bob", n=5, k=[-0.3, 0.1, 0, 0, 0], skew=0)
    path = tmp_path / "camera.yaml"
    path.write_text("\n".join(line for line in text.splitlines() if not line.startswith("image_")))
    write(images / "other.png", np.zeros((50, 100), np.uint8))
    result = undistort(path, images, "--alpha", 0, "--camera", tmp_path / "n.yaml", "-o", tmp_path / "out")
    assert result.exit_code == 0
    assert "undistorted 3 of 4" in result.stderr
    assert read_camera(tmp_path / "n.yaml").image_size == SIZE


def test_an_image_that_was_turned_says_so(camera: Path, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (400, 300), dtype=np.uint8)
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 274, 3, 1, 6, 0, 0)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    (tmp_path / "t.jpg").write_bytes(
        data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    )
    result = undistort(camera, tmp_path / "t.jpg", "-o", tmp_path / "t.png")
    assert result.exit_code == 0
    assert "turned by 90 degrees clockwise, as its EXIF orientation says" in result.stderr
    assert picture(tmp_path / "t.png").shape == (300, 400)


# The new camera


def test_the_new_camera_is_that_of_the_corrected_images(camera: Path, images: Path, tmp_path: Path) -> None:
    result = undistort(
        camera,
        images / "board01.png",
        "--alpha",
        "1",
        "--camera",
        tmp_path / "n.yaml",
        "-o",
        tmp_path / "a.png",
    )
    assert result.exit_code == 0
    new = read_camera(tmp_path / "n.yaml")
    assert (new.distortion.model, new.image_size, new.name) == ("none", SIZE, "left")
    assert new.intrinsics.alpha_u < 480
    again = undistort(tmp_path / "n.yaml", tmp_path / "a.png", "-o", tmp_path / "b.png")
    assert again.exit_code == 0
    assert np.array_equal(picture(tmp_path / "a.png"), picture(tmp_path / "b.png"))


def test_by_default_the_camera_matrix_stays(camera: Path, points: Path, tmp_path: Path) -> None:
    undistort(camera, points, "-o", tmp_path / "out.csv", "--camera", tmp_path / "n.yaml")
    assert np.array_equal(read_camera(tmp_path / "n.yaml").intrinsics.A, read_camera(camera).intrinsics.A)


# Points


def test_points_go_to_standard_output(camera: Path, points: Path, tmp_path: Path) -> None:
    result = undistort(camera, points)
    assert (result.exit_code, result.stderr) == (0, "")
    (tmp_path / "done.csv").write_text(result.stdout)
    done, seen = read_points(tmp_path / "done.csv"), read_points(points)
    expected = undistort_points(seen, read_camera(camera))
    assert np.array_equal(done.pixels, expected.pixels)
    assert np.array_equal(done.covariance, expected.covariance)  # type: ignore[arg-type]
    assert np.array_equal(done.world, seen.world)
    assert done.view_names == seen.view_names == ("a", "b, c")
    assert list(done.point) == list(seen.point)  # type: ignore[arg-type]
    assert (done.unit, done.image_size) == ("inch", SIZE)


def test_points_come_from_standard_input(camera: Path, points: Path) -> None:
    assert undistort(camera, "-", stdin=points.read_bytes()).stdout == undistort(camera, points).stdout


def test_several_files_keep_their_names(camera: Path, points: Path, images: Path, tmp_path: Path) -> None:
    result = undistort(camera, points, images / "board01.png", "-o", tmp_path / "out")
    assert result.exit_code == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["board01.png", "points.csv"]


def test_a_pixel_that_cannot_have_been_seen_is_named_by_its_line(points: Path, tmp_path: Path) -> None:
    camera = camera_file(tmp_path / "c.yaml", "plumb_bob", [-5.0, 0, 0, 0, 0])
    result = undistort(camera, points, "-o", tmp_path / "out.csv")
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: {points}:5: the distortion maps nothing to the pixel (")
    assert not (tmp_path / "out.csv").exists()


def test_points_of_another_size_are_refused(camera: Path, points: Path) -> None:
    points.write_text(points.read_text().replace("400 300", "640 480"))
    result = undistort(camera, points)
    refused(result, "the image_size is 640 x 480 px, but the camera is for 400 x 300 px")


def test_columns_that_are_not_known_are_noted(camera: Path, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("X,Y,Z,u,v,colour\n0,0,0,200,150,3\n")
    result = undistort(camera, tmp_path / "p.csv")
    assert result.exit_code == 0
    assert "column not used: 'colour'" in result.stderr
    header = "# image_size: 400 300\n# unit: mm\n# undistorted: plane\nX,Y,Z,u,v\n"
    assert result.stdout.startswith(f"{header}0.0,0.0,0.0,")


def test_a_calibration_takes_its_own_lens_off(tmp_path: Path) -> None:
    calibrated = tmp_path / "camera.yaml"
    succeed("calibrate", SAMPLES / "flat.csv", "--distortion", "k1k2", "-o", calibrated)
    assert undistort(calibrated, SAMPLES / "flat.csv", "-o", tmp_path / "p.csv").exit_code == 0
    succeed("calibrate", tmp_path / "p.csv", "--distortion", "none", "-o", tmp_path / "again.yaml")
    first, second = read_calibration(calibrated), read_calibration(tmp_path / "again.yaml")
    assert pytest.approx(first.K, rel=2e-5, abs=0.02) == second.K
    assert second.rmse_px == pytest.approx(first.rmse_px, rel=1e-2)


@pytest.mark.parametrize(
    ("model", "k"),
    [("equidistant", [0.1, -0.02, 0.0, 0.0]), ("rational_polynomial", [0.3, -0.1, 0, 0, 0.02, 0.5, 0, 0])],
)
def test_all_kinds_of_lenses_do(
    model: str, k: list[float], images: Path, points: Path, tmp_path: Path
) -> None:
    camera = camera_file(tmp_path / "c.yaml", model, k)
    assert undistort(camera, points, "-o", tmp_path / "out.csv").exit_code == 0
    assert undistort(camera, images / "board01.png", "--alpha", 0, "-o", tmp_path / "out.png").exit_code == 0
    assert picture(tmp_path / "out.png").min() > 0  # nothing is black


# Usage


@pytest.mark.parametrize(
    ("words", "exit_code", "message"),
    [
        (["CAMERA", "IMAGES"], 2, "several files cannot go to standard output; give a folder, -o DIR"),
        (["CAMERA", "IMAGE", "-o", "IMAGE"], 2, "is an input and would be overwritten"),
        (["CAMERA", "IMAGES", "-o", "IMAGES"], 2, "is an input and would be overwritten"),
        (["CAMERA", "POINTS", "-o", "POINTS"], 2, "is an input and would be overwritten"),
        (["CAMERA", "POINTS", "-o", "CAMERA"], 2, "is an input and would be overwritten"),
        (
            ["CAMERA", "POINTS", "-o", "x.csv", "--camera", "CAMERA"],
            2,
            "is an input and would be overwritten",
        ),
        (["CAMERA", "POINTS", "-o", "x.csv", "--camera", "x.csv"], 2, "would both be written to x.csv"),
        (["CAMERA", "IMAGES", "-o", "POINTS"], 2, "is a file; give a folder"),
        (["CAMERA", "IMAGES", "-o", "x.png"], 2, "several files cannot go to one file, x.png; give a folder"),
        (["CAMERA", "POINTS", "IMAGE", "-o", "x.csv"], 2, "several files cannot go to one file, x.csv"),
        (["CAMERA", "IMAGE", "-o", "x.gif"], 2, "x.gif is no image that can be written; give .png"),
        (["CAMERA", "IMAGE", "--alpha", "2", "-o", "x.png"], 2, "--alpha is 2; give a number from 0 to 1"),
        (["CAMERA", "IMAGE", "--alpha", "nan", "-o", "x.png"], 2, "alpha"),
        (["-", "-"], 2, "standard input (-) can be read only once"),
        (["CAMERA"], 2, "there is nothing to undistort; give FILE, --maps or --camera"),
        (["CAMERA", "IMAGE", "--fov", "175", "-o", "x.png"], 2, "up to 170, or --to cylinder for more"),
        (["CAMERA", "IMAGE", "--to", "cylinder", "--fov", "361", "-o", "x.png"], 2, "a number up to 360"),
        (["CAMERA", "IMAGE", "--fov", "90", "--alpha", "0", "-o", "x.png"], 2, "leave out --to, --fov and"),
        (["CAMERA", "IMAGE", "--maps", "CAMERA", "-o", "x.png"], 2, "is an input and would be overwritten"),
        (["POINTS", "IMAGE", "-o", "x.png"], 1, "points.csv"),
        (["absent.yaml", "IMAGE", "-o", "x.png"], 1, "absent.yaml: there is no such file"),
        (["CAMERA", "absent.png", "-o", "x.png"], 1, "absent.png: there is no such file"),
        (["CAMERA", "absent.csv"], 1, "absent.csv: there is no such file"),
        (["CAMERA", "POINTS", "-o", "no/such/x.csv"], 1, "its folder does not exist"),
    ],
)
def test_what_is_wrong_is_one_line(
    camera: Path, images: Path, points: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    words: list[str], exit_code: int, message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    names = {"CAMERA": camera, "IMAGES": images, "IMAGE": images / "board01.png", "POINTS": points}
    result = undistort(*(names.get(word, word) for word in words))
    assert (result.exit_code, result.stdout) == (exit_code, "")
    assert message in result.stderr
    assert result.stderr.splitlines()[-1].startswith("Error: ")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_two_images_of_one_name_are_refused(camera: Path, images: Path, tmp_path: Path) -> None:
    write(images / "board01.jpg", np.zeros((300, 400), np.uint8))
    result = undistort(camera, images, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "board01.jpg and " in result.stderr
    assert "would both be written to" in result.stderr


def test_points_need_no_image_library(camera: Path, points: Path) -> None:
    code = (
        "import sys; from neurocal_cli.commands import neurocal; "
        "neurocal(sys.argv[1:], standalone_mode=False); print(*sys.modules, file=sys.stderr)"
    )
    call = [sys.executable, "-c", code, "undistort", str(camera), str(points)]
    done = subprocess.run(call, capture_output=True, text=True, check=True)
    assert {"cv2", "scipy", "rich"}.isdisjoint(done.stderr.split())

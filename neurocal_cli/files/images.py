"""Read images and frames of videos as arrays, write images, and make thumbnails of them."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import FormatError, InputError, NeurocalError, one_line, reading_failures
from neurocal_cli.files.image_files import VIDEO, Header, other_kind, read_header
from neurocal_cli.files.reading import read_bytes

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
_MOST_PIXELS = 200_000_000  # more than any camera has; larger images are refused
_TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored along its diagonal",
    6: "turned by 90 degrees clockwise",
    7: "mirrored along its other diagonal",
    8: "turned by 90 degrees counter-clockwise",
}
_SIXTEEN_BITS = (".png", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")
_JPEG = (".jpg", ".jpeg", ".jpe")
_QUALITY = 95
_WIDEST = 960  # px; a page shows a photograph no wider
_NARROWEST = 120
_HEAD = 16  # bytes that identify the kind of file
_USUAL, _FASTEST = 30.0, 1e4  # frames per second
_STDERR = 2
_ONE_AT_A_TIME = threading.Lock()  # a process has only one stderr


@frozen_dataclass(eq=False)
class Image:
    """A grey image."""

    grey: Pixels  # (height, width) [DN]; of colours 0.299 R + 0.587 G + 0.114 B, as in OpenCV
    source: str = "image"  # name for messages
    turned: str = ""  # what was done to it as its EXIF orientation says; empty if nothing

    @property
    def notes(self) -> tuple[str, ...]:
        """Changes of the pixels that a user may not expect."""
        what = "as its EXIF orientation says and OpenCV does; pixel coordinates are those of the turned image"
        return (f"{self.turned}, {what}",) if self.turned else ()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.grey.shape[1], self.grey.shape[0]


def read_image(path: str | Path) -> Image:
    """Read an image: PNG, JPEG, TIFF, BMP, PGM or PPM, grey or colour, of 8 or 16 bits.

    As in OpenCV's ``imread``, an image is turned upright according to its EXIF orientation; pixel coordinates
    are those of the turned image. A note reports this.

    Parameters
    ----------
    path : str or Path
        ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read, is not an image, is damaged, or too large.
    """
    return parse_image(*read_bytes(path))


def read_picture(path: str | Path) -> tuple[Pixels, str, tuple[str, ...]]:
    """Read an image with its colours (R, G, B; no transparency), its name, and notes as of an `Image`."""
    image = _upright(*read_bytes(path), _MOST_PIXELS, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    return _reversed(image.grey), image.source, image.notes


def parse_image(data: bytes, source: str = "image", most_pixels: int = _MOST_PIXELS) -> Image:
    """Read an image from the bytes of a file; see `read_image`."""
    return _upright(data, source, most_pixels, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)


def _upright(data: bytes, source: str, most_pixels: int, flags: int) -> Image:
    """The image of a file, grey or not as OpenCV's flags say, with its EXIF orientation applied."""
    header = read_header(data, source)
    if header.width * header.height > most_pixels:
        raise FormatError(
            f"has {header.width} x {header.height} px, more than the {most_pixels / 1e6:g} million that are "
            "read; scale it down",
            source,
        )
    return Image(_decoded(data, header, source, flags), source, _TURNS.get(header.orientation, ""))


def _decoded(data: bytes, header: Header, source: str, flags: int) -> Pixels:
    """Decode a file with a valid header; the decoder's output to stderr is not shown."""
    with _captured_stderr() as complaints:
        try:
            pixels: Any = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
        except cv2.error:
            pixels = None
    if pixels is None:
        raise FormatError(
            f"cannot be decoded: a damaged {header.kind}, or a variety of it that few programs read; "
            "save it as PNG of 8 or 16 bits",
            source,
        )
    # The JPEG decoder fills undecodable parts with grey, and reports this only on stderr.
    if any(mark in text for text in complaints for mark in ("Corrupt JPEG", "Premature end")):
        raise FormatError("is damaged; copy the image again", source)
    turned = header.orientation >= 5
    size = (header.width, header.height) if turned else (header.height, header.width)
    if pixels.shape[:2] != size:
        raise FormatError(
            f"does not hold a single picture of {header.width} x {header.height} px; save it again", source
        )
    if pixels.dtype not in (np.uint8, np.uint16):
        raise FormatError("has pixels of neither 8 nor 16 bits; convert it to one of these", source)
    return pixels


@contextmanager
def _captured_stderr() -> Iterator[list[str]]:
    """Capture what the C libraries below OpenCV write to stderr; yields a list that receives the lines."""
    lines: list[str] = []
    with _ONE_AT_A_TIME, tempfile.TemporaryFile() as file:
        try:
            former = os.dup(_STDERR)
        except OSError:  # stderr is closed, so there is nothing to capture
            yield lines
            return
        try:
            os.dup2(file.fileno(), _STDERR)
            yield lines
        finally:
            os.dup2(former, _STDERR)
            os.close(former)
            file.seek(0)
            lines += file.read(100_000).decode("utf-8", "replace").splitlines()


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a grey (height, width) or colour (height, width, 3; R, G, B) picture as PNG."""
    return _encoded(picture, ".png", "PNG", [cv2.IMWRITE_PNG_COMPRESSION, 6])


def encode_image(pixels: Pixels, ending: str, quality: int = _QUALITY) -> bytes:
    """Encode a grey or colour (R, G, B) picture with the extension of a file; `quality` is JPEG's."""
    if pixels.dtype == np.uint16 and ending.lower() not in _SIXTEEN_BITS:
        raise InputError(
            f"an image of 16 bits cannot be written to a {ending} file; use {', '.join(_SIXTEEN_BITS)}"
        )
    if pixels.ndim == 3 and ending.lower() == ".pgm":
        raise InputError("a colour image cannot be written to a .pgm file; use .ppm or .png")
    return _encoded(
        pixels, ending.lower(), ending, [cv2.IMWRITE_JPEG_QUALITY, quality] if ending.lower() in _JPEG else []
    )


def _encoded(picture: Pixels, ending: str, kind: str, settings: list[int]) -> bytes:
    try:
        done, data = cv2.imencode(ending, np.ascontiguousarray(_reversed(picture)), settings)
    except cv2.error as error:
        raise InputError(f"a picture of the shape {picture.shape} cannot be written as {kind}") from error
    if not done:
        raise NeurocalError(f"the picture cannot be written as {kind}")
    return data.tobytes()


def _reversed(picture: Pixels) -> Pixels:
    """Swap the order of the colours between ours and OpenCV's."""
    return picture[..., ::-1] if picture.ndim == 3 else picture


def thumbnails(images: Mapping[str, str], size: tuple[int, int] | None, most_bytes: int) -> dict[str, bytes]:
    """Encode images, by name, as small JPEG files with a limit on their total size.

    All must have the `size` [px] if it is known. Only images of the least width may exceed the limit.
    """
    small: dict[str, NDArray[np.uint8]] = {}
    for name, path in images.items():
        image = read_image(path)
        if size is not None and image.size != size:
            raise FormatError(
                f"has {image.size[0]} x {image.size[1]} px, but the camera {size[0]} x {size[1]}; give the "
                "images that were calibrated from",
                image.source,
            )
        small[name] = _shrunk(image.grey, _WIDEST)
    width = _WIDEST
    while True:
        files = {name: encode_image(_shrunk(grey, width), ".jpg", 70) for name, grey in small.items()}
        total = sum(map(len, files.values()))
        if total <= most_bytes or width == _NARROWEST:
            return files
        # A thumbnail of half the width takes a little more than a quarter of the bytes.
        width = max(_NARROWEST, int(width * min(0.9, (most_bytes / total) ** 0.6)))


def _shrunk(grey: Pixels, width: int) -> NDArray[np.uint8]:
    """Convert an (H, W) image to 8 bits, and reduce it to at most `width` pixels."""
    eight = (grey // 257 if grey.dtype == np.uint16 else grey).astype(np.uint8, copy=False)
    if eight.shape[1] <= width:
        return eight
    height = max(1, round(eight.shape[0] * width / eight.shape[1]))
    return np.asarray(cv2.resize(eight, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def is_video(path: str) -> bool:
    """Whether a file begins like a video; False for stdin and for what is not a file."""
    if path == "-" or not os.path.isfile(path):
        return False
    with reading_failures(one_line(path)), open(path, "rb") as file:
        return other_kind(file.read(_HEAD)) == VIDEO


def video_frames(path: str) -> Iterator[NDArray[np.uint8]]:
    """Iterate over the frames of a video as grey images."""
    with _captured_stderr():
        capture = cv2.VideoCapture(path)
    count = 0
    try:
        while True:
            with _captured_stderr():
                there, frame = capture.read()
            if not there:
                break
            count += 1
            grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield np.asarray(grey, dtype=np.uint8)
    finally:
        capture.release()
    if not count:
        raise FormatError(
            "is a video that cannot be decoded here, as it is damaged or OpenCV has no codec for it; extract "
            "images from it, as with `ffmpeg -i VIDEO -vf fps=1 frame%03d.png`",
            one_line(path),
        )


def frame_rate(path: str) -> float:
    """Frames per second according to the video's header; 30 if that is missing or absurd."""
    with _captured_stderr():
        capture = cv2.VideoCapture(path)
        rate = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
    return rate if 0 < rate < _FASTEST else _USUAL

"""Images that show no chessboard but another target, and files that are no images, are named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.command_line import refused, run
from support.marked import plane_of
from support.places import SAMPLES

from neurocal_cli.detection.board_kind import other_kind
from neurocal_cli.files.images import read_image
from neurocal_cli.observations.board import Plane

DESCRIBED = Plane("", 9, 6, 25.0)


def photographed(target: np.ndarray) -> np.ndarray:
    """A target of 1000 x 750 px seen askew, on grey."""
    corners = np.float32([[0, 0], [1000, 0], [1000, 750], [0, 750]])
    seen = np.float32([[100, 60], [540, 90], [520, 430], [80, 440]])
    homography = cv2.getPerspectiveTransform(corners, seen)
    image = cv2.warpPerspective(target, homography, (640, 480), borderValue=128, flags=cv2.INTER_AREA)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def markers(kind: str) -> np.ndarray:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    if kind == "charuco":
        board = cv2.aruco.CharucoBoard((8, 6), 30.0, 22.0, family)
    else:
        board = cv2.aruco.GridBoard((6, 4), 30.0, 8.0, family)
    return board.generateImage((1000, 750), marginSize=60)


def grid_of_squares() -> np.ndarray:
    squares = (np.indices((6, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = np.kron(squares, np.ones((100, 100), dtype=np.uint8))
    return photographed(np.pad(image, ((75, 75), (100, 100)), constant_values=255))


def circles(staggered: bool, light: bool = False) -> np.ndarray:
    image = np.full((750, 1000), 20 if light else 255, dtype=np.uint8)
    step, radius = (40, 18) if staggered else (80, 26)
    for row in range(15 if staggered else 8):
        for column in range(10):
            middle = (90 + 80 * column + (40 if staggered and row % 2 else 0), 80 + step * row)
            cv2.circle(image, middle, radius, 240 if light else 0, -1, cv2.LINE_AA)
    return image


@pytest.mark.skipif(not hasattr(cv2, "aruco"), reason="this OpenCV has no markers")
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("charuco", "the image shows a ChArUco board of 8 x 6 squares"),
        ("aruco", "6 x 4 markers that stand alone"),
    ],
)
def test_markers_are_recognised(kind: str, said: str) -> None:
    assert said in other_kind([photographed(markers(kind))], DESCRIBED)


def test_markers_in_the_squares_make_another_kind() -> None:
    with_markers, plain = plane_of("charuco:8x6:30:22"), plane_of("chessboard:7x5:30")
    charuco, chessboard = photographed(markers("charuco")), grid_of_squares()
    assert "the image shows a ChArUco board of 8 x 6 squares" in other_kind([charuco], plain)
    assert other_kind([charuco], with_markers) == ""
    assert "the image shows a chessboard of 7 x 5 inner vertices" in other_kind([chessboard], with_markers)


@pytest.mark.parametrize(("staggered", "light"), [(False, False), (True, False), (True, True)])
def test_grids_of_circles_are_recognised(staggered: bool, light: bool) -> None:
    said = f"the image shows a grid of {'10 x 15 asymmetric' if staggered else '10 x 8'} circles"
    assert said in other_kind([photographed(circles(staggered, light))], DESCRIBED)
    deep = photographed(circles(staggered, light)).astype(np.uint16) * 200
    assert said in other_kind([deep], DESCRIBED)


@pytest.mark.parametrize("blur", [0.0, 3.0, 8.0])
def test_no_other_target_is_seen_in_chessboards(blur: float) -> None:
    image = np.array(read_image(SAMPLES / "board02.png").grey)
    assert other_kind([cv2.GaussianBlur(image, (0, 0), blur) if blur else image], DESCRIBED) == ""


def test_no_target_is_seen_in_noise() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    assert other_kind([noise], DESCRIBED) == ""
    assert other_kind([cv2.GaussianBlur(noise, (0, 0), 3.0)], DESCRIBED) == ""
    assert other_kind([np.zeros((1, 1), dtype=np.uint8)], DESCRIBED) == ""


@pytest.mark.slow
def test_no_other_target_is_seen_in_real_images(real_files: Callable[[str], list[Path]]) -> None:
    for pattern in ("opencv_stereo/*.jpg", "sony_chess/*.jpg", "fisheye_stereo/*.jpg", "zhang_planar/*.png"):
        for path in real_files(pattern):
            assert other_kind([np.array(read_image(path).grey)], DESCRIBED) == "", path.name


def test_detect_says_what_the_image_shows(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "dots.png"), photographed(circles(False)))
    result = run("detect", tmp_path / "dots.png", "--cols", 9, "--rows", 6, "--square", 25)
    refused(result, "dots.png: the image shows a grid of 10 x 8 circles; correct the description")
    assert "evenly lit" not in result.stderr


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            b"\0\0\0\x20ftypisom\0\0",
            "is a video that cannot be decoded here, as it is damaged or OpenCV has no codec",
        ),
        (b"RIFF\0\0\0\0AVI LIST", "is a video"),
        (b"\x1aE\xdf\xa3\0\0", "is a video"),
        (b"\0\0\0\x18ftypheic\0\0", "is a HEIC file, which is not read; convert it"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "is a WebP file"),
    ],
)
def test_files_that_are_no_images_are_named(data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(data)
    result = run("detect", tmp_path / "v.mp4", "--cols", 9, "--rows", 6, "--square", 25)
    refused(result, said)

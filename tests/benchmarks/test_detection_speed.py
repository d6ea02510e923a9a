"""Detection beside OpenCV's finders: rendered pictures, a board there or not, and photographs.

Run with ``pytest tests/benchmarks/test_detection_speed.py -n 0 --benchmark-enable``.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture
from support.real_data import RealFiles
from support.rendered import picture

from neurocal_cli.detection.batch import retain_freed_memory
from neurocal_cli.detection.board_kind import seen_board
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.measuring import measure
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.observations.board import Board

cv2 = pytest.importorskip("cv2")
CONDITIONS = ["base", "2 Mpx", "5 Mpx", "clutter only"]
# One board in view; three of them, of which one is asked for.
PHOTOGRAPHS = ["right01.jpg", "left02.jpg"]


def seen(condition: str) -> NDArray[np.uint8]:
    cv2.setNumThreads(1)
    retain_freed_memory()
    image = picture(condition, 900).image
    assert image.dtype == np.uint8
    return image


def classic(image: NDArray[np.uint8]) -> bool:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.001)
    found, corners = cv2.findChessboardCorners(image, (9, 6))
    if found:
        cv2.cornerSubPix(image, corners.reshape(-1, 1, 2), (11, 11), (-1, -1), criteria)
    return bool(found)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_neurocal_finds_and_measures(benchmark: BenchmarkFixture, condition: str) -> None:
    image = seen(condition)
    benchmark.group = f"{condition}, {image.size / 1e6:.1f} Mpx"
    points = benchmark(lambda: [measure(image, grid) for grid in find_grids(image)])
    assert bool(points) == (condition != "clutter only")


@pytest.mark.parametrize("condition", ["clutter only", "clutter only 5 Mpx"])
def test_neurocal_says_what_an_image_without_a_board_shows(
    benchmark: BenchmarkFixture, condition: str
) -> None:
    image, board = seen(condition), Board.single(9, 6, 25.0)
    benchmark.group = f"{condition}, {image.size / 1e6:.1f} Mpx"

    def refused() -> bool:
        try:
            detect_points(image, board)
        except NoBoardError:
            return True
        return False

    assert benchmark(refused)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_neurocal_finds_the_size_of_the_board(benchmark: BenchmarkFixture, condition: str) -> None:
    image = seen(condition)
    benchmark.group = f"{condition}, {image.size / 1e6:.1f} Mpx"
    board = benchmark(lambda: seen_board(image))
    assert (board is not None) == (condition != "clutter only")


@pytest.mark.parametrize("condition", CONDITIONS)
def test_opencv_classic_and_subpix(benchmark: BenchmarkFixture, condition: str) -> None:
    image = seen(condition)
    benchmark.group = f"{condition}, {image.size / 1e6:.1f} Mpx"
    assert benchmark(lambda: classic(image)) == (condition != "clutter only")


@pytest.mark.parametrize("condition", CONDITIONS)
def test_opencv_sector_based(benchmark: BenchmarkFixture, condition: str) -> None:
    image = seen(condition)
    benchmark.group = f"{condition}, {image.size / 1e6:.1f} Mpx"
    found = benchmark(lambda: cv2.findChessboardCornersSB(image, (9, 6))[0])
    assert bool(found) == (condition != "clutter only")


def photograph(real_files: RealFiles, name: str) -> NDArray[np.uint8]:
    cv2.setNumThreads(1)
    retain_freed_memory()
    (path,) = real_files(f"opencv_stereo/{name}")
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_neurocal_on_photographs(benchmark: BenchmarkFixture, real_files: RealFiles, name: str) -> None:
    image, board = photograph(real_files, name), Board.single(9, 6, 25.0)
    benchmark.group = f"photograph {name}, {image.size / 1e6:.1f} Mpx"
    assert len(benchmark(lambda: detect_points(image, board)).ids) == 93


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_opencv_classic_and_subpix_on_photographs(
    benchmark: BenchmarkFixture, real_files: RealFiles, name: str
) -> None:
    image = photograph(real_files, name)
    benchmark.group = f"photograph {name}, {image.size / 1e6:.1f} Mpx"
    assert benchmark(lambda: classic(image))


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_opencv_sector_based_on_photographs(
    benchmark: BenchmarkFixture, real_files: RealFiles, name: str
) -> None:
    image = photograph(real_files, name)
    benchmark.group = f"photograph {name}, {image.size / 1e6:.1f} Mpx"
    benchmark(lambda: cv2.findChessboardCornersSB(image, (9, 6)))  # it misses some

"""The size of a board is found without being told, and never another one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.real_data import RealFiles
from support.rendered import CONDITIONS, condition, picture
from support.slow_cases import slow_but

from neurocal_cli.detection.board_kind import (
    SeenBoard,
    Vote,
    agreed_size,
    find_board,
    found_board,
    seen_board,
)
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.identify import identify
from neurocal_cli.detection.placement import End, NoBoardError, board_ends
from neurocal_cli.files.board_kinds import kind_of
from neurocal_cli.observations.board import Board

FIRST = 1400  # seeds that nothing was developed on
SINGLE = tuple(name for name in CONDITIONS if "planes" not in name and "boards" not in name)
WHOLE, SURE, PART = Vote.WHOLE, Vote.SURE, Vote.PART


def grey(path: object) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def votes(*given: tuple[int, int, int, Vote]) -> list[SeenBoard]:
    """So many images of a size."""
    return [SeenBoard((cols, rows), vote) for count, cols, rows, vote in given for _ in range(count)]


@pytest.mark.parametrize(
    ("seen", "size"),
    [
        (votes((1, 9, 6, SURE)), (9, 6)),
        (votes((1, 9, 6, WHOLE)), (9, 6)),
        (votes((2, 9, 6, WHOLE), (5, 8, 6, WHOLE), (3, 9, 5, WHOLE)), (9, 6)),
        (votes((1, 9, 6, SURE), (4, 8, 6, PART)), (9, 6)),
        (votes((8, 9, 6, WHOLE), (1, 12, 9, PART)), (9, 6)),  # another pattern in one image
        (votes((1, 10, 6, WHOLE), (20, 9, 6, WHOLE)), (9, 6)),  # a single false line
        (votes((3, 10, 6, WHOLE), (7, 9, 6, SURE)), (9, 6)),  # a false line where the board is seen to end
        (votes((3, 9, 6, PART), (1, 8, 6, PART)), (9, 6)),
    ],
)
def test_the_largest_size_with_enough_votes_is_the_boards(
    seen: list[SeenBoard], size: tuple[int, int]
) -> None:
    plane = agreed_size(seen).plane
    assert (plane.cols, plane.rows) == size


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        (votes((1, 9, 6, PART)), "only parts of a chessboard are seen, of 9 x 6 inner vertices in 1 image;"),
        (votes((1, 9, 6, WHOLE), (1, 8, 6, WHOLE)), "only parts of a chessboard are seen"),
        (votes((5, 9, 6, Vote.NONE)), "only parts of a chessboard are seen"),
        (
            votes((3, 9, 6, SURE), (3, 7, 7, SURE)),
            "boards of different sizes, 9 x 6 and 7 x 7 inner vertices",
        ),
        (
            [SeenBoard((8, 6), WHOLE, ((8, 6), (7, 6)))] * 3,
            "the images show 3 chessboards beside each other, of 7 x 6, 8 x 6 and 8 x 6 inner vertices",
        ),
        (
            [SeenBoard((9, 6), WHOLE, ((5, 4),))] * 3,
            "of 5 x 4 and 9 x 6 inner vertices; measure each by itself, by --cols, --rows and --board-name",
        ),
        (
            [SeenBoard((9, 6), WHOLE, ((9, 6),))] * 3,
            "of 9 x 6 and 9 x 6 inner vertices; cut pictures that hold both images of a stereo camera apart",
        ),
    ],
)
def test_images_that_do_not_tell_the_size_are_refused(seen: list[SeenBoard], said: str) -> None:
    with pytest.raises(NoBoardError, match=said):
        agreed_size(seen)


def test_images_are_examined_until_the_size_is_certain() -> None:
    taken = []

    def images() -> np.ndarray:
        for k in range(100):
            taken.append(k)
            yield picture("base", 0).image

    board = find_board(images(), 25.0, "mm")
    assert board == Board.single(9, 6, 25.0)
    assert len(taken) == 5
    assert find_board([picture("base", 0).image]).unit == "squares"


def test_images_without_a_chessboard_are_refused() -> None:
    with pytest.raises(NoBoardError, match="no image shows a chessboard"):
        find_board([np.zeros((480, 640), np.uint8)])
    with pytest.raises(NoBoardError, match="no image shows a chessboard"):
        find_board([])


@pytest.mark.slow
def test_boards_that_all_images_cut_off_are_refused() -> None:
    seen = [seen_board(picture("board cut", seed).image) for seed in range(FIRST, FIRST + 12)]
    for first in range(0, 12, 3):
        with pytest.raises(NoBoardError, match="only parts of a chessboard are seen"):
            agreed_size([one for one in seen[first:] if one is not None])


@pytest.mark.slow
@pytest.mark.parametrize("name", SINGLE)
def test_rendered_boards_have_their_size_in_every_image_that_tells_it(name: str) -> None:
    count = 2 if "Mpx" in name else 12
    told = []
    for seed in range(FIRST, FIRST + count):
        seen = seen_board(picture(name, seed).image)
        if seen is None:
            assert name in ("stress 2", "tilt 75") or "only" in name
            continue
        plane = condition(name, seed).targets[0].plane
        try:
            found = agreed_size([seen]).plane
        except NoBoardError:
            continue
        told.append((found.cols, found.rows) == (max(plane.cols, plane.rows), min(plane.cols, plane.rows)))
    assert all(told)
    if name not in ("occluded", "board cut") and "only" not in name:
        assert len(told) >= 0.75 * count


@pytest.mark.parametrize(
    ("pattern", "size", "step"),
    [
        ("opencv_stereo/left*.jpg", (9, 6), 2),
        ("opencv_stereo/right*.jpg", (9, 6), 2),
        ("sony_chess/*.jpg", (6, 4), 2),
        ("fisheye_ocam/*.jpg", (8, 6), 2),
        ("fisheye_stereo/left*.jpg", (9, 6), 2),
        ("fisheye_stereo/right*.jpg", (9, 6), 2),
        ("line_pattern/chessboard.jpg", (36, 25), 1),
        ("photographs/sharpened[01]*.png", (9, 6), 1),
        ("photographs/fisheye_7x5_*.png", (7, 5), 1),
    ],
)
def test_the_sizes_of_real_boards_are_found(
    real_files: RealFiles, pattern: str, size: tuple[int, int], step: int
) -> None:
    found = found_board(grey(path) for path in real_files(pattern)[::step]).plane
    assert (kind_of(found), (found.cols, found.rows)) == ("chessboard", size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pattern", "size"),
    [
        ("opencv_stereo/*.jpg", (9, 6)),
        ("sony_chess/*.jpg", (6, 4)),
        ("fisheye_ocam/*.jpg", (8, 6)),
        ("fisheye_stereo/*.jpg", (9, 6)),
    ],
)
def test_no_single_photograph_tells_another_size(
    real_files: RealFiles, pattern: str, size: tuple[int, int]
) -> None:
    for path in real_files(pattern):
        seen = seen_board(grey(path))
        assert seen is not None
        assert seen.size == size, path.name


def test_walls_of_a_corner_are_no_single_board(real_files: RealFiles) -> None:
    images = (grey(path) for path in real_files("ortho3/*_calib.jpg"))
    with pytest.raises(NoBoardError, match="3 chessboards beside each other, of 7 x 6, 8 x 6 and 8 x 6"):
        found_board(images)


def test_photographs_of_circles_have_no_grid(real_files: RealFiles) -> None:
    for path in real_files("photographs/circles*.jpg"):
        assert find_grids(grey(path)) == []


@pytest.mark.parametrize("blur", slow_but((1.5,), (0.5, 1.5, 3.0)))
def test_drawn_circles_have_no_grid_and_overexposed_squares_have_one(blur: float) -> None:
    squares, circles = (np.full((400, 500), 255, np.uint8) for _ in range(2))
    for row in range(8):
        for col in range(10):
            if (row + col) % 2 == 0:
                left, top = 50 + 40 * col, 40 + 40 * row
                cv2.rectangle(squares, (left + 4, top + 4), (left + 36, top + 36), (0,), -1)
                cv2.circle(circles, (left + 20, top + 20), 17, (0,), -1, cv2.LINE_AA)
    assert find_grids(cv2.GaussianBlur(circles, (0, 0), blur)) == []
    assert [sorted(x.shape) for x in find_grids(cv2.GaussianBlur(squares, (0, 0), blur))] == [[7, 9]]


def test_a_board_is_found_beyond_the_border_of_a_shadow(real_files: RealFiles) -> None:
    """Its squares are 2.5 grey levels apart there, and the border hides a line of vertices."""
    (image,) = map(grey, real_files("photographs/shadow_rim.png"))
    (grid,) = find_grids(image)
    assert sorted(grid.shape) == [7, 9]
    assert set(board_ends(image, grid).values()) == {End.BOARD}
    found = found_board([image])
    assert (found.plane.cols, found.plane.rows, found.sure) == (9, 7, True)
    assert len(detect_points(image, Board.single(9, 7, 25.0), "vertices").ids) >= 34


def test_squares_that_a_window_cuts_belong_to_a_board_on_a_screen(real_files: RealFiles) -> None:
    """At three of its sides, an eighth to a quarter of the outer squares is left."""
    (image,) = map(grey, real_files("photographs/sharpened_screen.jpg"))
    grids = find_grids(image)
    found = found_board([image])
    assert (found.plane.cols, found.plane.rows, found.sure) == (9, 7, False)
    (located,) = identify(Board.single(9, 7, 25.0), grids, image).located
    assert located.grid.shape == (6, 7)
    assert {located.placement.apply(np.array([c, r]))[0] for c in (0, 5) for r in (0, 6)} == {1, 7}
    for cols, rows in ((9, 6), (7, 6)):
        with pytest.raises(
            NoBoardError, match=f"detected 9 x 7 inner vertices, but the board has {cols} x {rows}"
        ):
            identify(Board.single(cols, rows, 25.0), grids, image)


def in_shadow(light: float) -> tuple[np.ndarray, Grid]:
    """A board in a shadow that begins at its fifth line, and the grid of the four lines before it."""
    image = np.array(picture("tilt 0", 0).image, dtype=float)
    (grid,) = find_grids(image)
    first, last = grid.pixels[0, 4], grid.pixels[-1, 4]
    v, u = np.indices(image.shape)
    (du, dv), (au, av) = last - first, grid.pixels[0, 5] - first
    side = du * (v - first[1]) - dv * (u - first[0])
    dark = side * (du * av - dv * au) > 0
    return np.where(dark, 30 + light * (image - 30), image).round().astype(np.uint8), Grid(
        grid.pixels[:, :4], grid.dark
    )


@pytest.mark.parametrize(("light", "end"), [(0.1, End.PATTERN), (0.0, End.STOPS)])
def test_a_shadow_that_begins_at_a_line_is_no_end(light: float, end: End) -> None:
    image, lit = in_shadow(light)
    assert board_ends(image, lit)[1, 0] is end


def test_a_smaller_board_is_no_part_of_the_one_that_is_described(real_files: RealFiles) -> None:
    for path in real_files("photographs/fisheye_7x5_*.png"):
        image = grey(path)
        grids = find_grids(image)
        with pytest.raises(NoBoardError, match="detected 7 x 5 inner vertices") as told:
            identify(Board.single(8, 6, 25.0), grids, image)
        assert told.value.shown == (7, 5)
        assert len(identify(Board.single(7, 5, 25.0), grids, image).located) == 1

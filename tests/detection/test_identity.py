"""Which board point is which: sizes, turns, hidden parts, folds, colours."""

from __future__ import annotations

import itertools
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.occluders import Rectangle
from support.pictures import Rendered, Scene, Sides, Target, ground_truth
from support.rendered import Recipe, board_pose, condition, folded, picture, rendered, single
from support.seen_grids import labelled_vertices, seen_grid, seen_grids, true_vertices, turned_by
from support.slow_cases import slow_but

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection import Grid
from neurocal_cli.detection.identify import fit_camera, identify, rigid_motion
from neurocal_cli.detection.placement import (
    DIRECTIONS,
    SYMMETRIC_BOARD,
    End,
    NoBoardError,
    Placement,
    board_ends,
    placements,
    trimmed,
)
from neurocal_cli.observations.board import Board, Plane

EMPTY = np.zeros((480, 640), dtype=np.uint8)


def shot(scene: Scene) -> Rendered:
    return rendered(scene, np.random.default_rng(0))


def same(found: dict[str, Array], truth: dict[str, Array]) -> bool:
    return found.keys() == truth.keys() and all(np.array_equal(found[name], truth[name]) for name in truth)


def flat_grid(cols: int, rows: int, dark: int = 0) -> Grid:
    c, r = np.meshgrid(np.arange(cols), np.arange(rows))
    return Grid(np.stack([100.0 + 30 * c, 80.0 + 30 * r], axis=-1), dark)


@pytest.mark.parametrize(
    ("turn", "seed"),
    slow_but([(0, 0), (1, 0), (2, 1), (3, 1)], itertools.product(range(4), range(4))),
)
def test_the_first_vertex_of_an_odd_by_even_board_has_the_dark_square(seed: int, turn: int) -> None:
    scene, seen = condition("base", seed), picture("base", seed)
    identified = identify(scene.board, seen_grids(scene, seen, turn), seen.image)
    found = labelled_vertices(identified)
    if not scene.targets[0].first_black:
        found = turned_by(found, 9, 6)
    assert same(found, true_vertices(seen))
    assert identified.warnings == ()


def test_the_first_vertex_is_where_opencv_begins() -> None:
    import cv2

    for seed in range(4):
        scene, seen = condition("base", seed), picture("base", seed)
        done, corners = cv2.findChessboardCorners(seen.image, (9, 6))
        assert done
        found = labelled_vertices(identify(scene.board, seen_grids(scene, seen), seen.image))
        for name, corner in (("0:0", corners[0]), ("8:0", corners[8]), ("8:5", corners[-1])):
            assert np.hypot(*(found[name] - corner.ravel())) < 1


@pytest.mark.parametrize("name", slow_but(("board cut",), ("board cut", "occluded")))
def test_a_part_of_the_board_is_placed_by_the_ends_that_are_seen_or_refused(name: str) -> None:
    placed = 0
    for seed in range(5):
        scene, seen = condition(name, seed), picture(name, seed)
        try:
            found = labelled_vertices(identify(scene.board, seen_grids(scene, seen), seen.image))
        except NoBoardError as error:
            assert "it is ambiguous which" in str(error)  # noqa: PT017 - both are right, wrong points are not
            continue
        placed += 1
        found = found if scene.targets[0].first_black else turned_by(found, 9, 6)
        assert same(found, true_vertices(seen))
    assert placed >= 4


def test_a_part_that_could_be_anywhere_is_refused() -> None:
    with pytest.raises(NoBoardError, match="detected 5 x 4 of 9 x 6 inner vertices, but it is ambiguous"):
        identify(Board.single(9, 6, 25), [flat_grid(5, 4)], EMPTY)


@pytest.mark.parametrize(
    ("cols", "rows", "words"),
    [
        (6, 4, "detected 9 x 6 inner vertices, but the board has 6 x 4"),
        (4, 6, "detected 6 x 9 inner vertices, but the board has 4 x 6"),
        (9, 5, "detected 9 x 6 inner vertices, but the board has 9 x 5; give .* in the image$"),
        (10, 6, "detected 9 x 6 inner vertices, but the board has 10 x 6; .* image, or show all of it$"),
    ],
)
def test_a_board_of_another_size_is_named(cols: int, rows: int, words: str) -> None:
    scene, seen = condition("base", 0), picture("base", 0)
    with pytest.raises(NoBoardError, match=words):
        identify(Board.single(cols, rows, 25), seen_grids(scene, seen), seen.image)


def test_a_pattern_full_of_gaps_is_not_called_a_board_of_its_size() -> None:
    blinds = flat_grid(15, 13)
    blinds.pixels[1:12, 1:14][np.add.outer(np.arange(11), np.arange(13)) % 3 > 0] = np.nan
    with pytest.raises(NoBoardError, match="no board of 7 x 4 inner vertices, only parts of a pattern"):
        identify(Board.single(7, 4, 25), [blinds], EMPTY)


def test_a_piece_of_a_bigger_board_is_refused_though_it_has_the_size() -> None:
    seen = picture("base", 0)
    whole = seen_grid(seen.truth.planes[0], True)
    piece = Grid(whole.pixels[:4, :6], whole.dark)
    with pytest.raises(NoBoardError, match="the pattern continues beyond 6 x 4"):
        identify(Board.single(6, 4, 25), [piece], seen.image)


@pytest.mark.parametrize(("cols", "rows"), [(8, 6), (7, 5), (6, 6), (7, 7)])
def test_a_board_that_looks_the_same_after_a_turn_is_named_by_the_image_with_a_warning(
    cols: int, rows: int
) -> None:
    grid = flat_grid(cols, rows)
    board = Board.single(cols, rows, 25)
    for turn in range(4):
        pixels = np.rot90(grid.pixels, turn)
        dark = [0, rows, cols + rows, cols][turn] % 2
        identified = identify(board, [Grid(pixels, dark)], EMPTY)
        found = labelled_vertices(identified)
        assert identified.warnings == (SYMMETRIC_BOARD,)
        np.testing.assert_array_equal(found["0:0"], [100.0, 80.0])
        np.testing.assert_array_equal(found["1:0"], [130.0, 80.0])


@pytest.mark.parametrize(("cols", "most_changes"), [(8, 1), (9, 0)])
def test_names_keep_their_places_while_the_board_turns(cols: int, most_changes: int) -> None:
    """24 turns in the plane; only a board without a dark corner of its own changes names, once."""
    scene = single(Recipe(zoom=0.5, cols=cols, tilt=0, square=26, margin=0.3), np.random.default_rng(3))
    firsts = []
    for k in range(24):
        roll = -np.pi / 4 + np.pi / 12 * (k + 0.5)
        pose = board_pose(scene, np.array([160.0, 120.0]), 13.0, 20.0, 0.3, roll)
        turned = replace(scene, pose=pose)
        truth = ground_truth(turned)
        grid = seen_grid(truth.planes[0], scene.targets[0].first_black, k)
        found = labelled_vertices(identify(scene.board, [grid], np.zeros((240, 320), np.uint8)))
        ends = [
            bool(np.array_equal(found[name], truth.planes[0].vertices[0, 0]))
            for name in ("0:0", f"{cols - 1}:5")
        ]
        assert sum(ends) == 1
        firsts.append(ends[0])
    assert sum(a != b for a, b in pairwise(firsts)) <= most_changes


def test_a_board_far_behind_is_left_out_and_one_beside_is_refused() -> None:
    near = flat_grid(9, 6)
    far = Grid(near.pixels * 0.2, 0)
    identified = identify(Board.single(9, 6, 25), [near, far], EMPTY)
    assert identified.located[0].grid is near
    with pytest.raises(NoBoardError, match="2 boards of 9 x 6"):
        identify(Board.single(9, 6, 25), [near, Grid(near.pixels * 0.9, 0)], EMPTY)


def test_a_bigger_board_behind_does_not_hide_one_that_is_seen_to_its_ends() -> None:
    scene, seen = condition("base", 0), picture("base", 0)
    grids = [flat_grid(12, 12), *seen_grids(scene, seen)]
    assert len(identify(scene.board, grids, seen.image).located) == 1


def test_small_pieces_of_large_boards_are_refused() -> None:
    sheets = tuple(Plane(name, 40, 30, 5.0, (0.0, 0.0, z)) for name, z in (("a", 0.0), ("b", 40.0)))
    pieces = [flat_grid(3, 3), Grid(flat_grid(4, 3).pixels + 200.0, 0)]
    for board in (Board.single(40, 30, 5.0), Board(sheets)):
        with pytest.raises(NoBoardError, match="it is ambiguous which"):
            identify(board, pieces, EMPTY)


def test_a_piece_beside_a_bigger_board_is_not_taken_but_a_board_before_it_is() -> None:
    board, bigger = Board.single(9, 6, 25), flat_grid(12, 8)
    with pytest.raises(NoBoardError, match="detected 12 x 8 inner vertices, but the board has 9 x 6"):
        identify(board, [bigger, flat_grid(9, 6)], EMPTY)
    far = Grid(bigger.pixels * 0.5, 0)
    assert identify(board, [far, flat_grid(9, 6)], EMPTY).located[0].grid.shape == (9, 6)


def test_no_grid_is_no_board() -> None:
    with pytest.raises(NoBoardError, match="no board detected"):
        identify(Board.single(9, 6, 25), [], EMPTY)
    with pytest.raises(NoBoardError, match="fewer than 3 x 3 inner vertices are not detected"):
        identify(Board.single(7, 2, 25), [], EMPTY)


@pytest.mark.parametrize("seed", slow_but((1,), range(2)))
@pytest.mark.parametrize(
    "name",
    slow_but(
        ("three planes across",),
        ("two planes", "two planes distorted", "two planes across", "three planes", "three planes across"),
    ),
)
def test_planes_at_an_angle_are_told_apart_and_turned_right(name: str, seed: int) -> None:
    scene, seen = condition(name, seed), picture(name, seed)
    identified = identify(scene.board, seen_grids(scene, seen, seed), seen.image)
    assert same(labelled_vertices(identified), true_vertices(seen))
    assert identified.warnings == ()


def test_planes_of_one_size_are_told_apart_by_their_places() -> None:
    """Swapping the walls of this corner mirrors it, which no camera sees."""
    scene = folded(np.random.default_rng(1), planes=3)
    planes = [replace(t.plane, cols=5, rows=4) for t in scene.targets]
    planes[0] = replace(planes[0], origin=(2 * 28.0, 28.0, 0.0))
    scene = replace(
        scene, targets=tuple(replace(t, plane=p) for t, p in zip(scene.targets, planes, strict=True))
    )
    seen = shot(scene)
    identified = identify(scene.board, seen_grids(scene, seen, 1), seen.image)
    assert same(labelled_vertices(identified), true_vertices(seen))


def test_one_plane_of_several_does_not_tell_how_it_lies() -> None:
    scene, seen = condition("two planes", 0), picture("two planes", 0)
    with pytest.raises(NoBoardError, match="only 1 of the 2 planes detected"):
        identify(scene.board, seen_grids(scene, seen)[:1], seen.image)


def test_planes_that_lie_otherwise_than_the_board_says_are_refused() -> None:
    scene, seen = condition("two planes", 0), picture("two planes", 0)
    floor, wall = scene.board.planes
    wrong = Board((floor, replace(wall, origin=(28.0, 0.0, 4 * 28.0))))
    with pytest.raises(NoBoardError, match="origins and axes"):
        identify(wrong, seen_grids(scene, seen), seen.image)


def test_a_grid_that_is_no_part_of_a_folded_board_is_left_out() -> None:
    scene, seen = condition("two planes", 0), picture("two planes", 0)
    third = Plane("lid", 4, 4, 28.0, (0.0, 0.0, 300.0))
    board = Board((*scene.board.planes, third))
    stray = Grid(flat_grid(3, 3).pixels * 0.3 + [400.0, 0.0], 0)
    identified = identify(board, [*seen_grids(scene, seen), stray], seen.image)
    assert [one.plane.name for one in identified.located] == ["floor", "wall"]


def test_the_ends_of_a_board_are_told_from_the_frame_and_from_something_before_it() -> None:
    scene, seen = condition("base", 0), picture("base", 0)
    (grid,) = seen_grids(scene, seen)
    assert set(board_ends(seen.image, grid).values()) == {End.BOARD}
    inner = Grid(grid.pixels[1:-1, 1:-1], grid.dark)
    assert set(board_ends(seen.image, inner).values()) == {End.PATTERN}
    middle = tuple(np.mean(grid.pixels[0], axis=0))
    paper = Rectangle((float(middle[0]), float(middle[1]) - 10), (500, 40), 0.1, 0.9)
    hidden = shot(replace(scene, occluders=(paper,)))
    (rest,) = seen_grids(scene, hidden)
    assert board_ends(hidden.image, rest)[0, -1] in (End.STOPS, End.UNKNOWN)
    assert set(board_ends(EMPTY, grid).values()) == {End.UNKNOWN}
    left = np.ascontiguousarray(seen.image[:, int(grid.pixels[:, 0, 0].max()) :])
    shifted = Grid(grid.pixels[:, 2:] - [float(int(grid.pixels[:, 0, 0].max())), 0.0], grid.dark)
    assert board_ends(left, shifted)[-1, 0] is not End.BOARD


@pytest.mark.parametrize("level", [0.1, 0.5])
def test_a_board_of_which_something_straight_hides_a_half_is_labelled(level: float) -> None:
    """The other ends show the margin of the board, so this is none, though it cuts near a line."""
    scene, seen = condition("tilt 0", 0), picture("tilt 0", 0)
    (grid,) = seen_grids(scene, seen)
    first, last = grid.pixels[0, 5], grid.pixels[-1, 5]
    v, u = np.indices(seen.image.shape)
    tilted = last - 0.3 * (grid.pixels[-1, 6] - last) - first
    beyond = tilted[0] * (v - first[1]) - tilted[1] * (u - first[0])
    image = np.where(beyond < 0, round(255 * level), seen.image).astype(np.uint8)
    rest = Grid(grid.pixels[:, :5], grid.dark)
    found = labelled_vertices(identify(scene.board, [rest], image))
    assert same(found, {name: one for name, one in true_vertices(seen).items() if name in found})
    assert len(found) == rest.seen.sum()


def test_a_board_without_margin_before_a_dark_wall_ends_too() -> None:
    scene = single(Recipe(), np.random.default_rng(0))
    target = replace(scene.targets[0], margin=Sides.all(0.0))
    scene = replace(scene, targets=(target,), background=replace(scene.background, level=0.15))
    seen = shot(scene)
    (grid,) = seen_grids(scene, seen)
    assert set(board_ends(seen.image, grid).values()) == {End.BOARD}


def test_lines_that_are_hardly_there_are_left_out_only_where_the_board_is_smaller() -> None:
    planes = (Plane("", 9, 6, 25.0),)
    pixels = np.full((8, 10, 2), np.nan)
    pixels[1:7, 1:] = flat_grid(9, 6).pixels
    pixels[0, 3] = pixels[7, 5] = pixels[2, 0] = [1.0, 2.0]
    cut = trimmed(Grid(pixels, 1), planes)
    np.testing.assert_array_equal(cut.pixels, flat_grid(9, 6).pixels)
    assert cut.dark == 1  # two lines away: the first square has the same colour
    grid = flat_grid(10, 7)
    assert trimmed(grid, planes) is grid
    sparse = flat_grid(9, 6)
    sparse.pixels[0, 1:] = np.nan
    assert trimmed(sparse, planes) is sparse


def test_a_placement_says_which_squares_are_dark() -> None:
    grid, plane = flat_grid(4, 3, dark=1), Plane("", 4, 3, 1.0)
    every = list(placements(grid, plane, 0, {}, mirrored=True))
    assert len(every) == 4
    upright = Placement(0, ((1, 0), (0, 1)), (0, 0))
    assert upright in every
    assert not upright.first_square_is_dark(1)
    opposite = Placement(0, ((-1, 0), (0, -1)), (3, 2))
    assert opposite in every
    assert opposite.first_square_is_dark(1)
    ends = dict.fromkeys(DIRECTIONS, End.BOARD)
    assert not list(placements(grid, Plane("", 5, 3, 1.0), 0, ends, mirrored=True))


def test_the_linear_camera_tells_a_mirrored_target() -> None:
    scene = condition("two planes", 0)
    truth = picture("two planes", 0).truth
    world = np.concatenate([t.plane.vertices().reshape(-1, 3) for t in truth.planes])
    pixels = np.concatenate([t.vertices.reshape(-1, 2) for t in truth.planes])
    assert isinstance(scene.targets[0], Target)
    fit = fit_camera(world, pixels)
    assert (fit.handed, fit.rms < 1e-4) == (1, True)
    assert fit_camera(world * [-1, 1, 1], pixels).handed == -1
    far = 0.9 * world @ np.array([[1.0, 0.2, 0.1], [0.1, 1.0, 0.4]]).T + 1e-4 * np.random.default_rng(
        0
    ).normal(size=pixels.shape)
    assert fit_camera(world, far).handed == 0


def test_a_motion_is_found_and_a_reflection_is_none() -> None:
    points = np.random.default_rng(0).normal(size=(8, 3))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = rigid_motion(points, points @ turn.T + [1.0, 2.0, 3.0])
    assert moved is not None
    np.testing.assert_allclose(moved[0], turn, atol=1e-12)
    np.testing.assert_allclose(moved[1], [1.0, 2.0, 3.0], atol=1e-12)
    assert rigid_motion(points, points * [-1, 1, 1]) is None

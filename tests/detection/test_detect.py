"""From an image to labelled points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.pictures import Rendered, render
from support.rendered import Recipe, board_pose, condition, picture, single
from support.seen_grids import labelled_vertices, seen_grid
from support.slow_cases import slow_but

from neurocal_cli.detection import EDGE_H, EDGE_V, VERTEX, Measured, detect
from neurocal_cli.detection.detect import Detection, detect_points, label
from neurocal_cli.detection.identify import Identified, Located
from neurocal_cli.detection.placement import NoBoardError, Placement
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.points import Correspondences

BOARD = Board.single(9, 6, 28.0)


@cache
def detected(name: str, seed: int) -> tuple[Detection, Rendered]:
    seen = picture(name, seed)
    return detect_points(seen.image, condition(name, seed).board), seen


def true_points(seen: Rendered) -> dict[str, np.ndarray]:
    return {
        name: np.concatenate([world, pixel])
        for plane in seen.truth.planes
        for name, world, pixel in zip(*plane.plane.midpoints(), plane.midpoints, strict=True)
    }


def opposite(name: str) -> str:
    kind, c, r = name.split(":")
    last = (7, 5) if kind == "h" else (8, 4)
    return f"{kind}:{last[0] - int(c)}:{last[1] - int(r)}"


@pytest.mark.parametrize("name", slow_but(("two planes",), ("base", "two planes", "three planes")))
def test_points_are_where_the_ids_say(name: str) -> None:
    for seed in range(2):
        found, seen = detected(name, seed)
        truth = true_points(seen)
        turned = len(seen.truth.planes) == 1 and not condition(name, seed).targets[0].first_black
        assert len(found.ids) >= 0.9 * len(truth)
        assert len(set(found.ids)) == len(found.ids)
        expected = np.array([truth[opposite(point) if turned else point] for point in found.ids])
        assert np.abs(found.pixels - expected[:, 3:]).max() < 0.1
        if not turned:
            np.testing.assert_allclose(found.world, expected[:, :3], atol=1e-9)
        assert found.image_size == (640, 480)


@pytest.mark.slow
def test_ids_stay_on_their_places_while_the_board_turns_in_its_plane() -> None:
    scene = single(Recipe(zoom=0.5, square=28, margin=0.3), np.random.default_rng(5))
    firsts = set()
    for k in range(24):
        pose = board_pose(scene, np.array([160.0, 120.0]), 13.0, 25.0, 0.5, np.pi / 12 * k)
        seen = render(replace(scene, pose=pose), np.random.default_rng(k))
        (one,) = detect_points(seen.image, scene.board, "vertices").located
        names = labelled_vertices(Identified((one,)))
        assert len(names) == 54
        corners = seen.truth.planes[0].vertices[[0, -1], [0, -1]]
        near = np.hypot(*(names["0:0"] - corners).T) < 1
        assert near.sum() == 1
        firsts.add(bool(near[0]))
    assert len(firsts) == 1


def test_vertices_are_measured_when_asked_for() -> None:
    seen = detected("base", 0)[1]
    found = detect_points(seen.image, BOARD, "vertices")
    assert found.ids[0] == "0:0"
    assert len(found.ids) >= 50
    truth = seen.truth.planes[0].vertices.reshape(-1, 2)
    distances = np.hypot(*np.moveaxis(found.pixels[:, None] - truth, -1, 0)).min(axis=1)
    assert distances.max() < 0.1


def test_points_come_in_the_order_of_the_board() -> None:
    found, _ = detected("three planes", 0)
    order = [name for plane in condition("three planes", 0).board.planes for name in plane.midpoint_ids()]
    places = [order.index(name) for name in found.ids]
    assert places == sorted(places)


@pytest.mark.parametrize(("matrix", "offset"), [(((1, 0), (0, 1)), (2, 1)), (((0, 1), (-1, 0)), (1, 6))])
def test_edges_turn_with_their_grid(matrix: tuple, offset: tuple) -> None:
    plane = Plane("side", 9, 8, 10.0)
    kind = np.array([EDGE_H, EDGE_V, VERTEX])
    index = np.array([[1, 2], [1, 2], [1, 2]])
    zeros = np.zeros((3, 2))
    measured = Measured(kind, index, zeros, np.zeros((3, 3)), None, np.zeros((3, 3, 2)), 0, 0.0)
    grid = seen_grid(picture("base", 0).truth.planes[0], True)
    labels = label(Located(grid, plane, Placement(0, matrix, offset)), measured)
    if matrix[0][0] == 1:
        assert labels.ids == ["side/h:3:3", "side/v:3:3", "side/3:3"]
        np.testing.assert_allclose(labels.world[:, :2], [[35, 30], [30, 35], [30, 30]])
    else:  # (c, r) to (r + 1, 6 - c)
        assert labels.ids == ["side/v:3:4", "side/h:3:5", "side/3:5"]
        np.testing.assert_allclose(labels.world[:, :2], [[30, 45], [35, 50], [30, 50]])


def test_an_image_without_a_board_says_so() -> None:
    for value in (0, 255):
        with pytest.raises(NoBoardError, match="no board detected"):
            detect_points(np.full((100, 120), value, dtype=np.uint8), BOARD)
    with pytest.raises(NoBoardError, match="no board detected"):
        detect_points(np.zeros((8, 8), dtype=np.uint8), BOARD)
    with pytest.raises(NoBoardError, match="no board detected"):
        detect_points(np.zeros((1, 9000), dtype=np.uint8), BOARD)


def test_a_board_of_another_size_is_not_taken() -> None:
    with pytest.raises(NoBoardError, match="detected 9 x 6 inner vertices, but the board has 6 x 4"):
        detect_points(picture("base", 0).image, Board.single(6, 4, 28.0))


def measuring(monkeypatch: pytest.MonkeyPatch, change: Callable[[Measured], Measured]) -> None:
    measure = detect.measure
    monkeypatch.setattr(detect, "measure", lambda *words: change(measure(*words)))


def test_points_that_are_no_numbers_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoilt(measured: Measured) -> Measured:
        covariance, pixels = measured.covariance.copy(), measured.pixels.copy()
        covariance[0, 1] = 1e3
        covariance[1, 0] = np.nan
        covariance[2, 2] = 0.0
        pixels[3, 0] = np.inf
        return replace(measured, covariance=covariance, pixels=pixels)

    whole, seen = detected("base", 0)
    measuring(monkeypatch, spoilt)
    found = detect_points(seen.image, BOARD)
    assert len(found.ids) == len(whole.ids) - 4
    assert found.rejected == whole.rejected + 4
    Correspondences.from_detections({"a": found})


@pytest.mark.parametrize(
    ("rejected", "reason"),
    [(86, "only 5 of 91 points of the board can be measured"), (0, "only 5 points of the board are seen")],
)
def test_a_handful_of_points_is_not_a_view(
    monkeypatch: pytest.MonkeyPatch, rejected: int, reason: str
) -> None:
    def few(measured: Measured) -> Measured:
        names = ("kind", "index", "pixels", "covariance")
        return replace(measured, **{name: getattr(measured, name)[:5] for name in names}, rejected=rejected)

    seen = detected("base", 0)[1]
    measuring(monkeypatch, few)
    with pytest.raises(NoBoardError, match=reason):
        detect_points(seen.image, BOARD)


def test_views_are_gathered_with_their_covariance() -> None:
    views = {f"view{seed}": detected("base", seed)[0] for seed in range(2)}
    points = Correspondences.from_detections(views, "inch")
    assert points.view_names == ("view0", "view1")
    assert (points.image_size, points.unit) == ((640, 480), "inch")
    assert points.n_points == sum(len(one.ids) for one in views.values())
    assert points.covariance is not None
    assert points.point is not None
    np.testing.assert_array_equal(points.pixels[: len(views["view0"].ids)], views["view0"].pixels)
    np.testing.assert_array_equal(points.covariance[-3:], views["view1"].covariance[-3:])


def test_images_of_two_sizes_are_refused_by_name() -> None:
    one, _ = detected("base", 0)
    other = replace(one, image_size=(320, 240))
    with pytest.raises(InputError, match="image b has 320 x 240 px but a has 640 x 480 px"):
        Correspondences.from_detections({"a": one, "b": other})
    with pytest.raises(InputError, match="no images"):
        Correspondences.from_detections({})


def test_pixels_that_are_not_finite_are_refused() -> None:
    seen = picture("base", 1)
    image = seen.image.astype(float)
    image[:3] = np.nan
    with pytest.raises(InputError, match="not finite"):
        detect_points(image, BOARD)

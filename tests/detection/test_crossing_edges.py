"""The edges to the rim tell where the outermost mid-points lie along their edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.measured import found, take
from support.pictures import Scene, Sensor, Target
from support.real_data import RealFiles
from support.rendered import condition, rendered
from support.slow_cases import slow_but

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.detection import Grid
from neurocal_cli.detection.detect import Detection, detect_points
from neurocal_cli.detection.fitting.grid_fit import GridFit, fit_grid, fit_rim
from neurocal_cli.detection.fitting.map_fit import WideMap
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.fitting.strips import GridEdges, GridImage
from neurocal_cli.detection.measuring import edges_served, positions_along_edges
from neurocal_cli.files.images import read_image
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.simulation.rendering.scene import Background


def strongly_distorted() -> Scene:
    """A board at the border of an image through a lens with large p1, p2 and k3."""
    lens = Distortion("plumb_bob", np.array([0.64, -0.85, -0.011, 0.008, 1.53]))
    camera = Camera(Intrinsics(505.0, 503.0, 201.0, 148.0), lens, (400, 300))
    R = Pose.from_euler(0.304, -0.55, 0.244, np.zeros(3)).R
    board = (Target(Plane("", 9, 6, 25.0)),)
    pose = Pose(R, np.array([-85.7, -49.7, 378.5]))
    return Scene(camera, pose, board, Background(0.45), psf=0.7, sensor=Sensor(read_noise=2.0))


def seen(seed: int, name: str) -> tuple[Scene, Detection]:
    scene = strongly_distorted() if name == "strongly distorted" else condition(name, seed)
    # The colour of its first square tells which end of the board is which.
    scene = replace(scene, targets=tuple(replace(target, first_black=True) for target in scene.targets))
    return scene, detect_points(rendered(scene, np.random.default_rng(seed), 6).image, scene.board)


def outermost(one: Detection) -> Array:
    """Rows of the mid-points that are measured in both directions."""
    assert one.across is not None
    return np.flatnonzero(~one.across.any(axis=1))


def is_in_an_outer_row(name: str, cols: int, rows: int) -> bool:
    kind, c, r = name.split("/")[-1].split(":")
    return int(r) in (0, rows - 1) if kind == "h" else int(c) in (0, cols - 1)


@pytest.mark.parametrize("name", slow_but(("base",), ("base", "strongly distorted", "k1 -0.3", "gamma 2.2")))
def test_outermost_midpoints_are_measured_along_their_edges(name: str) -> None:
    squares: list[Array] = []
    for seed in range(3):
        scene, one = seen(seed, name)
        rows, (plane,) = outermost(one), scene.board.planes
        whole = 2 * (plane.cols - 1) + 2 * (plane.rows - 1)
        assert whole - 1 <= len(rows) <= whole  # an outlier is left out
        assert all(is_in_an_outer_row(one.ids[row], plane.cols, plane.rows) for row in rows)
        truth = scene.camera.project(scene.pose.to_camera(one.world[rows]))[0]
        u, v = (one.pixels[rows] - truth).T
        suu, suv, svv = one.covariance[rows].T
        squares.append((svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2))
    # 78 points; at the border of a strong lens the variances are a third too large.
    least = 0.5 if name == "strongly distorted" else 0.7
    assert least < np.concatenate(squares).mean() / 2 < 1.4
    assert np.concatenate(squares).max() < 25


def test_they_stay_where_they_are_across_their_edges() -> None:
    scene = condition("base", 0)
    image = rendered(scene, np.random.default_rng(0), 6).image
    one, rim = (detect_points(image, scene.board, kind) for kind in ("midpoints", "edges"))
    assert rim.across is not None
    rows = outermost(one)
    same = np.array([rim.ids.index(name) for name in one.ids])
    n = rim.across[same]
    np.testing.assert_allclose((one.pixels * n).sum(axis=1), (rim.pixels[same] * n).sum(axis=1), atol=1e-9)
    others = np.setdiff1d(np.arange(len(one.ids)), rows)
    np.testing.assert_array_equal(one.pixels[others], rim.pixels[same][others])
    assert not np.array_equal(one.pixels[rows], rim.pixels[same][rows])


def test_each_edge_to_the_rim_serves_one_midpoint_beside_its_vertex() -> None:
    seen = np.ones((5, 6), dtype=bool)
    seen[2, 3] = seen[0, 0] = False
    grid = Grid(np.where(seen[..., None], 0.0, np.nan) + np.zeros((5, 6, 2)), 0)
    edges, rim = GridEdges.of(grid, 2), GridEdges.of(grid, 1)
    served = edges_served(grid.shape, edges, rim, np.ones(len(edges.index), dtype=bool))
    assert (served >= 0).all()
    ends = edges.index[:, None] + np.where(edges.vertical[:, None, None], [[0, 0], [0, 1]], [[0, 0], [1, 0]])
    for row, vertical, first, known in zip(served, rim.vertical, rim.index, rim.known, strict=True):
        vertex = first + (0 if known[0] else 1) * np.array([0, 1] if vertical else [1, 0])
        assert edges.vertical[row] != vertical
        assert (ends[row] == vertex).all(axis=1).any()
    # Without the edges between vertices there is nothing to serve.
    assert (edges_served(grid.shape, edges, rim, np.zeros(len(edges.index), dtype=bool)) == -1).all()


@pytest.mark.parametrize("kind", [SmoothMap, WideMap])
def test_each_lens_has_a_model_without_a_polynomial(kind: type[SmoothMap]) -> None:
    assert sorted({*kind.lens_models, *kind.simple_models}) == [(k, 0) for k in range(len(kind.lenses))]
    assert kind.models[: kind.richest_lens + 1] == kind.lens_models[: kind.richest_lens + 1]


def plain_board() -> tuple[GridImage, GridFit]:
    _, picture = take("base", 0)
    grid_image = GridImage(picture.image, found(picture.truth.planes[0], 1)[0], 1 / 12)
    return grid_image, fit_grid(grid_image)


def test_nothing_is_told_of_a_board_that_departs_from_the_map() -> None:
    grid_image, fitted = plain_board()
    along = positions_along_edges(grid_image, fitted)
    assert along is not None
    assert len(along.rows) == len(along.value) > 20
    uneven = replace(fitted, map=replace(fitted.map, excess=4.0))
    assert positions_along_edges(grid_image, uneven) is None


def test_paper_boards_are_measured_across_their_edges_only(real_files: RealFiles) -> None:
    path = real_files("opencv_stereo/left01.jpg")[0]
    one = detect_points(read_image(path).grey, Board.single(9, 6, 25.0))
    assert len(one.ids) == 93
    assert not len(outermost(one))


def test_edges_that_the_map_sends_far_out_of_the_image_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond a board, the map of a wide lens may reach the horizon: edges were a million pixels long."""
    grid_image, fitted = plain_board()
    whole = fit_rim(grid_image, fitted)
    assert whole is not None
    at = SmoothMap.at
    least = 0.0

    def folded(self: SmoothMap, place: Array) -> Array:
        return np.where(place[..., :1] < least, 300.0, 1.0) * at(self, place)

    monkeypatch.setattr(SmoothMap, "at", folded)
    some = fit_rim(grid_image, fitted)
    assert some is not None
    assert len(some[0].index) == len(whole[0].index) - grid_image.grid.shape[1]
    least = np.inf
    assert fit_rim(grid_image, fitted) is None
    assert positions_along_edges(grid_image, fitted) is None

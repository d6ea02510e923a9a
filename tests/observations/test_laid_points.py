"""Points of another kind lie on the estimated board: vertices of a board whose mid-points were estimated."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from support.real_data import RealFiles

from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.detect import Detection, detect_points
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.estimated_board import laid
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

PLANE = Board.single(9, 6, 25.0).planes[0]
VERTICES = PLANE.at(np.argwhere(np.ones((9, 6))).astype(float))


def offset(world: Array) -> Array:
    """A board that is bent and stretched."""
    x, y = (world[:, 0] - 100) / 100, (world[:, 1] - 60) / 100
    return np.stack([0.3 * x, 0 * x, 0.5 * x**2 - 0.2 * x * y], axis=-1)


def estimated(given: Array) -> Target:
    return Target(
        given,
        given + offset(given),
        np.full(given.shape, 0.01),
        np.zeros(len(given), dtype=np.intp),
        {},
        False,
        9.0,
    )


def points_at(world: Array) -> Correspondences:
    return Correspondences(world, world[:, :2], image_size=(640, 480))


def test_vertices_lie_on_the_surface_of_the_mid_points() -> None:
    target = estimated(PLANE.at(PLANE.midpoint_grid()))
    moved = laid(target, points_at(VERTICES)).world
    np.testing.assert_allclose(moved, VERTICES + offset(VERTICES), atol=0.02)
    np.testing.assert_array_equal(target.applied(points_at(VERTICES)).world, VERTICES)


def test_points_of_the_target_move_with_it_and_others_stay() -> None:
    target = estimated(VERTICES)
    elsewhere = np.array([[100.0, 60, 5], [400.0, 60, 0]])  # above the board, and far beside it
    moved = laid(target, points_at(np.concatenate([VERTICES, elsewhere]))).world
    np.testing.assert_array_equal(moved[: len(VERTICES)], target.found)
    np.testing.assert_array_equal(moved[len(VERTICES) :], elsewhere)


def test_a_target_of_few_points_tells_no_surface() -> None:
    target = estimated(VERTICES[:8])
    np.testing.assert_array_equal(laid(target, points_at(VERTICES[20:])).world, VERTICES[20:])


@pytest.mark.slow
def test_a_camera_from_mid_points_predicts_vertices_of_a_paper_board(real_files: RealFiles) -> None:
    paths = real_files("opencv_stereo/right??.jpg")
    found = {kind: detected(paths, kind) for kind in ("midpoints", "vertices")}
    camera = calibrate(found["midpoints"].select(found["midpoints"].view_index % 2 == 0), skew=False)
    others = found["vertices"].select(found["vertices"].view_index % 2 == 1)
    assert evaluate_camera(camera, others).rmse_px < 0.1  # 0.17 with the board as given


def detected(paths: list[Path], kind: str) -> Correspondences:
    board = Board.single(9, 6, 25.0)
    found: dict[str, Detection] = {}
    for path in paths:
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        found[path.stem] = detect_points(image, board, kind, grids=find_grids(image, [(9, 6)]))  # type: ignore[arg-type]
    return Correspondences.from_detections(found)

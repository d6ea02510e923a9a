"""Pixels of points with their covariance: it holds for noise, and is that of the verdict."""

from __future__ import annotations

import numpy as np
import pytest
from support.made_calibration import CAMERA, made_calibration
from support.noisy_flat_set import TRUE, pose, trial
from support.plain_projection import project

from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

# On the board, and far off it, where the pose matters most.
PLACES = np.array([[100.0, 80.0, 0.0], [0.0, 0.0, 0.0], [300.0, 200.0, -150.0], [-200.0, 50.0, 300.0]])


def misses(trials: int) -> Array:
    """(trials, places) squared errors of predicted pixels in units of their covariance; 2 on average."""
    found = []
    for seed in range(trials):
        got = trial(seed).project(PLACES, "view3")
        assert got.covariance is not None
        off = got.pixels - project(TRUE.A, pose(3), PLACES)[0]
        found.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(got.covariance), off))
    return np.array(found)


@pytest.mark.parametrize(
    ("trials", "low", "high"),
    [(16, 1.1, 3.2), pytest.param(300, 1.8, 2.2, marks=pytest.mark.slow)],
)
def test_pixels_scatter_as_their_covariance_says(trials: int, low: float, high: float) -> None:
    mean = misses(trials).mean(axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean


def test_without_a_view_the_std_is_that_of_the_verdict() -> None:
    camera = trial(0)
    over = Evidence(camera).projection
    assert over is not None
    depth = float(over.depths[1])
    found = camera.project(depth * camera.camera.seen_points(over.pixels))
    np.testing.assert_allclose(found.pixels, over.pixels, atol=1e-9)
    assert found.std is not None
    np.testing.assert_allclose(found.std, over.std[1], rtol=1e-9)


def test_points_behind_the_camera_have_no_pixel() -> None:
    found = trial(0).project(np.array([[0.0, 0.0, 100.0], [0.0, 0.0, -100.0]]))
    assert found.covariance is not None
    assert found.seen.tolist() == [True, False]
    assert np.isfinite(found.pixels).all(axis=1).tolist() == [True, False]
    assert np.isfinite(found.covariance).all(axis=(1, 2)).tolist() == [True, False]


def test_without_points_the_covariance_is_unknown_and_the_pixels_are_the_same() -> None:
    camera, point = trial(0), np.array([[10.0, 20.0, 500.0]])
    lean = camera.lean.project(point)
    assert lean.covariance is None
    assert lean.std is None
    np.testing.assert_array_equal(lean.pixels, camera.project(point).pixels)


def test_a_view_that_is_not_there_and_other_shapes_are_refused() -> None:
    camera = made_calibration(2)
    assert camera.intrinsics == CAMERA
    with pytest.raises(InputError, match="no view 'view07'; give one of view00, view01"):
        camera.project(PLACES, "view07")
    with pytest.raises(InputError, match=r"shape \(N, 3\), found \(4, 2\)"):
        camera.project(PLACES[:, :2])

"""Errors over many noisy trials against the Cramer-Rao bound, and reported std against the errors."""

import numpy as np
import pytest
from support.scenes import Scene, pinhole, table_1
from support.slow_cases import slow_but

from neurocal_cli import Calibration
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES

UNKNOWNS = {1: 11, 2: 9, 3: 6, 4: 5}


def parameters(calibration: Calibration) -> Array:
    pose = calibration.views["view"].pose
    return np.concatenate([calibration.intrinsics.values(), pose.euler, pose.t])


def reported_std(calibration: Calibration) -> Array:
    view = calibration.views["view"].std
    return np.array([calibration.std[n] for n in INTRINSIC_NAMES] + [view[n] for n in POSE_NAMES])


def bound(scene: Scene, type: int) -> Array:
    """Cramer-Rao std for 1 px of noise: the reported std of nearly noise-free data, scaled."""
    points = scene.points(1e-6, np.random.default_rng(0))
    calibration = pinhole(points, **scene.given(type))
    n = 2 * len(points)
    sigma = calibration.rmse_px * np.sqrt(len(points) / (n - UNKNOWNS[type]))
    return reported_std(calibration) / sigma


def run(type: int, sigma: float, trials: int) -> tuple[Array, Array]:
    """Ratios of the rms error and of the rms reported std to the bound, estimated ones only."""
    scene, rng = table_1(), np.random.default_rng(1000 * type + int(10 * sigma))
    truth = np.concatenate([scene.intrinsics.values(), scene.poses["view"].euler, scene.poses["view"].t])
    errors, stds = [], []
    for trial in range(trials):
        calibration = pinhole(scene.points(sigma, rng), seed=trial, **scene.given(type))
        assert calibration.converged
        errors.append(parameters(calibration) - truth)
        stds.append(reported_std(calibration))
    limit = sigma * bound(scene, type)
    free = limit > 0
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    std = np.sqrt(np.mean(np.square(stds), axis=0))
    return rms[free] / limit[free], std[free] / limit[free]


def check(type: int, sigma: float, trials: int) -> None:
    errors, stds = run(type, sigma, trials)
    assert len(errors) == UNKNOWNS[type]
    # The relative standard error of an rms over n trials is 1 / sqrt(2 n); three of them and a half,
    # as up to eleven parameters are looked at.
    sampling = 3.5 / np.sqrt(2 * trials)
    assert errors.max() < 1.05 + sampling
    assert errors.min() > 1 - sampling  # nothing unbiased can be better
    assert np.abs(stds - 1).max() < 0.05


@pytest.mark.parametrize("type", slow_but((1,), (1, 2, 3, 4)))
def test_errors_are_at_the_cramer_rao_bound(type: int) -> None:
    check(type, 1.0, 36)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.2, 1.0, 2.0])
@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_errors_are_at_the_cramer_rao_bound_over_many_trials(type: int, sigma: float) -> None:
    check(type, sigma, 500)


def test_the_bound_is_the_inverse_of_the_fisher_information() -> None:
    scene = table_1()
    points = scene.points()
    views = arrange(points)
    problem = scene.problem(points, 1)
    state = scene.true_state(views)
    normal, _ = normal_blocks(views.batches, state)
    unknowns, n = UNKNOWNS[1], 2 * len(points)
    normal[0, -1, -1] = (1.0 / views.pixel_scale) ** 2 * (n - unknowns)
    entries = Minimum(views, state, normal, problem.free, True).covariance(n).shared
    J = scene.intrinsics.entry_jacobian() * views.pixel_scale
    fisher = np.sqrt(np.diag(J @ entries @ J.T))
    assert bound(scene, 1)[:5] == pytest.approx(fisher, rel=1e-4)

"""Hardly more equations than unknowns: nothing is left out down to an exact fit, and nobody is misled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Camera, Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.errors import NeurocalError

CAMERA = Camera(Intrinsics(1400.0, 1400.0, 950.0, 545.0), image_size=(1920, 1080))


def seen(n: int, seed: int, sigma: float = 0.5) -> Correspondences:
    """Points in a room of 2 x 1 x 2 m, seen from 4 m."""
    rng = np.random.default_rng([n, seed])
    pose = Pose.from_euler(*rng.uniform(-0.3, 0.3, 3), np.array([0.0, 0.0, 4.0]))
    world = rng.uniform([-1, -0.5, -1], [1, 0.5, 1], (n, 3))
    pixels = CAMERA.project(world @ pose.R.T + pose.t)[0]
    return Correspondences(world, pixels + sigma * rng.normal(size=(n, 2)), image_size=CAMERA.image_size)


def calibrated(points: Correspondences) -> Calibration | None:
    try:
        return calibrate(points, skew=False, distortion="none")
    except NeurocalError:  # the points lie badly
        return None


@pytest.mark.parametrize("n", slow_but([6, 8], [6, 7, 8, 10]))
def test_noise_in_few_points_is_no_outlier(n: int) -> None:
    found = [camera for seed in range(20) if (camera := calibrated(seen(n, seed))) is not None]
    assert len(found) > 15
    assert [camera.n_rejected for camera in found] == [0] * len(found)


def test_a_wrong_point_of_few_is_left_out_alone() -> None:
    left_out = []
    for seed in range(10):
        points = seen(10, seed)
        pixels = points.pixels.copy()
        pixels[3] += [60, -40]
        found = calibrated(replace(points, pixels=pixels))
        if found is not None and found.rejected.points is not None:
            left_out.append(found.rejected.points.world.tolist() == points.world[[3]].tolist())
    assert len(left_out) > 5
    assert all(left_out)


@pytest.mark.parametrize(("n", "words"), [(6, {"poor"}), (8, {"usable", "poor"})])
def test_residuals_that_are_too_few_to_tell_the_noise_are_told(n: int, words: set[str]) -> None:
    for seed in range(5):
        found = calibrated(seen(n, seed))
        if found is not None and found.verdict is not None:
            assert found.verdict.word in words
            (reason,) = (r for r in found.verdict.reasons if "more than there are unknowns" in r)
            assert f"only {2 * n - 10} equations more" in reason
            assert f"give at least {9 - n} point" in " ".join(found.verdict.advice)


@pytest.mark.parametrize("n", [6, 7])
def test_few_spare_equations_name_no_other_lens(n: int) -> None:
    """Any coefficient explains the error then."""
    for seed in range(8):
        found = calibrated(seen(n, seed))
        if found is not None and found.verdict is not None:
            assert not any("distortion" in reason for reason in found.verdict.reasons)

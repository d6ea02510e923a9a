"""Frames whose errors last from one to the next count as fewer views, and nothing else does."""

from __future__ import annotations

import numpy as np
import pytest
from support.grouped_views import ALPHA, moving, photographed, poses
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Correspondences, calibrate
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.calibration.verdict.evidence import Evidence

_LASTING = 0.85  # correlation of a point's errors from frame to frame


def alike(points: Correspondences, **options: str) -> RepeatedPoses:
    return Evidence(calibrate(points, distortion="k1k2p1p2", **options)).repeated


@pytest.mark.parametrize("seed", range(3))
def test_frames_with_lasting_errors_are_worth_as_many_views_as_their_correlation_tells(seed: int) -> None:
    found = alike(moving(60, np.random.default_rng([1, seed]), _LASTING), target="given")
    assert found.n_poses == 60  # each frame has a pose of its own
    # The mean of 60 such errors has 11 times the variance of independent ones; motion averages some of it.
    assert 4 < 1 / found.worth < 11
    assert 3 <= found.n_groups <= 9
    assert (np.diff(found.group) >= 0).all()
    assert (np.bincount(found.folds(5)) > 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_frames_with_independent_errors_are_views(seed: int) -> None:
    assert alike(moving(60, np.random.default_rng([2, seed]), 0.0)).none


@pytest.mark.parametrize("curl", [0.0, 2.0])
def test_a_bent_board_in_frames_is_no_lasting_error(curl: float) -> None:
    """The next frame shows the same bend from nearly the same side."""
    assert alike(moving(60, np.random.default_rng(3), 0.0, curl), target="given").none


def test_points_elsewhere_on_the_board_are_no_lasting_error() -> None:
    points = moving(60, np.random.default_rng(4), 0.0)
    at = np.random.default_rng(5).normal(size=(54, 3)) * [0.05, 0.05, 0.0]
    moved = points.world - np.tile(at, (60, 1))  # three times the noise
    assert alike(Correspondences(moved, points.pixels, points.view, points.image_size), target="given").none


def test_photographs_in_any_order_are_views() -> None:
    rng = np.random.default_rng(6)
    assert alike(photographed(poses(40, rng), rng)).none


@pytest.mark.parametrize("n", slow_but((12,), (12, 60)))
def test_the_std_of_a_video_are_true_and_no_cause_is_named(n: int) -> None:
    errors, found = [], []
    for seed in range(n):
        c = calibrate(moving(60, np.random.default_rng([7, seed]), _LASTING))
        errors.append(
            [(c.intrinsics.alpha_u - ALPHA) / c.std["alpha_u"], (c.intrinsics.u0 - 650.0) / c.std["u0"]]
        )
        found.append(c)
    # As independent views they were 2.1 times their std, and a sixth of the sets was told a cause.
    assert np.sqrt(np.mean(np.square(errors))) < 1.35
    assert np.abs(errors).max() < 4.0
    # What the few points outside of the image, or their part of it, give as a reason is no cause.
    assert not [
        reason for c in found for reason in c.verdict.reasons if "std" not in reason and "image" not in reason
    ]
    assert all("as in a video; the 60 views count as" in " ".join(c.warnings) for c in found)


def test_a_bent_board_is_estimated_from_such_frames() -> None:
    found: Calibration = calibrate(moving(60, np.random.default_rng(8), _LASTING, 2.0))
    assert found.target is not None
    assert np.ptp(found.target.offsets[:, 2]) == pytest.approx(2.0, rel=0.15)
    assert abs(found.intrinsics.alpha_u - ALPHA) < 3 * found.std["alpha_u"]

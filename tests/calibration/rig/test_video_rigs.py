"""The standard deviations of a rig that two videos calibrated, whose errors last from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest
from support.grouped_views import ALPHA, moving
from support.slow_cases import slow_but

from neurocal_cli import Pose, calibrate_stereo


@pytest.mark.parametrize("n", slow_but((6,), (6, 40)))
def test_the_std_of_a_rig_from_videos_are_true(n: int) -> None:
    true = Pose.from_euler(0.02, -0.05, 0.01, np.array([-60.0, 2.0, 4.0]))
    errors = []
    for seed in range(n):
        left, right = (moving(60, np.random.default_rng([9, seed]), 0.85, from_=one) for one in (None, true))
        rig = calibrate_stereo(left, right)
        of_cameras = [(c.intrinsics.alpha_u - ALPHA) / c.std["alpha_u"] for c in (rig.left, rig.right)]
        errors.append(
            [*of_cameras, *(rig.pose.t - true.t) / [rig.std[name] for name in ("t_x", "t_y", "t_z")]]
        )
    # As independent frames they were 2.6 times their std, 6 at most. The five errors of a rig are alike.
    assert np.sqrt(np.mean(np.square(errors))) < 1.15 + 1.0 / np.sqrt(n)
    assert np.abs(errors).max() < 4.0

"""A camera calibrated again and again from noisy pixels of a flat board in eight views."""

from __future__ import annotations

from functools import cache

import numpy as np

from neurocal_cli import Calibration, Correspondences, Intrinsics, Pose, calibrate
from support.plain_projection import project

BOARD = np.array([[30.0 * c, 30.0 * r, 0.0] for c in range(8) for r in range(6)])
TRUE = Intrinsics(600.0, 610.0, 320.0, 240.0)
NOISE = 0.3  # px


def pose(k: int) -> Pose:
    return Pose.from_euler(
        0.35 * np.cos(k), 0.4 * np.sin(k), 0.3 * k, np.array([-100.0, -70.0, 700 + 20.0 * k])
    )


@cache
def trial(seed: int) -> Calibration:
    """A camera calibrated from noisy pixels of a flat board in eight views."""
    rng = np.random.default_rng(seed)
    pixels = np.concatenate([project(TRUE.A, pose(k), BOARD)[0] for k in range(8)])
    views = np.repeat([f"view{k}" for k in range(8)], len(BOARD))
    noisy = pixels + NOISE * rng.standard_normal(pixels.shape)
    points = Correspondences(np.tile(BOARD, (8, 1)), noisy, views, image_size=(640, 480))
    return calibrate(
        points, distortion="none", skew=False, outliers="keep", target="given", seed=seed, starts=4
    )

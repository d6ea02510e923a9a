"""A smooth map of a board into an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.detection.fitting.smooth_map import Frame, SmoothMap


def some_map(degree: int = 4, radial: int = 3) -> SmoothMap:
    """A map of a board of 9 x 6 vertices with all terms of its lens and polynomial."""
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    frame = Frame.of(grid, (640, 480))
    homography = np.array([0.4, 0.05, 0.02, -0.04, 0.3, -0.01, 0.1, -0.05])
    now = SmoothMap(frame, np.concatenate([homography, np.zeros(9)])).with_model(radial, degree)
    values = now.parameters.copy()
    values[8:14] = [0.02, -0.03, -0.2, 0.05, 0.02, -0.01]
    values[14:16] = [0.004, -0.003] if radial >= 4 else 0.0
    values[16] = 0.03 if radial >= 5 else 0.0
    values[17:] = rng.normal(0, 0.0005, len(values) - 17)
    return replace(now, parameters=values)

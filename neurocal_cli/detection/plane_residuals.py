"""Residuals of measured points from a smooth map of their plane, to show the noise without a camera."""

from __future__ import annotations

import cv2
import numpy as np

from neurocal_cli.detection.grid import EDGE_H, EDGE_V, Measured
from neurocal_cli.detection.wide_lens import fit_wide_lens
from neurocal_cli.geometry import Array

_FEWEST_WIDE = 12  # points needed for the equidistant lens
_POINTS_A_TERM = 6  # least number of points per coefficient of the polynomial; for pictures only


def plane_residuals(measured: Measured, size: tuple[int, int] | None = None) -> Array:
    """Residuals of the measured pixels from a plane and a polynomial fitted to them.

    The plane is projected by a pinhole or an equidistant lens, whichever fits better. The polynomial models
    the deviations of the real lens; its degree is five, or less for few points.

    Parameters
    ----------
    measured : Measured
    size : (width, height), optional [px]
        Of the image; without it, only the pinhole is fitted.

    Returns
    -------
    residuals : (N, 2) array [px]
        Zero for fewer than five points, because a homography fits four exactly.
    """
    grid = measured.index + 0.5 * np.stack([measured.kind == EDGE_H, measured.kind == EDGE_V], axis=-1)
    if len(grid) < 5:
        return np.zeros_like(measured.pixels)
    H, _ = cv2.findHomography(grid, measured.pixels, 0)
    if H is None:
        return np.zeros_like(measured.pixels)
    seen = np.column_stack([grid, np.ones(len(grid))]) @ H.T
    left = np.asarray(measured.pixels - seen[:, :2] / seen[:, 2:], dtype=float)
    if size is not None and len(grid) >= _FEWEST_WIDE:
        wide = fit_wide_lens(grid, measured.pixels, size).residual
        left = wide if (wide**2).sum() < (left**2).sum() else left
    degree = max((d for d in range(1, 6) if _POINTS_A_TERM * (d + 1) * (d + 2) <= 2 * len(grid)), default=0)
    x, y = ((grid - grid.mean(axis=0)) / max(float(np.ptp(grid)), 1.0)).T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)
    return np.asarray(left - terms @ np.linalg.lstsq(terms, left, rcond=None)[0])

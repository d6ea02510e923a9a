"""Projection of points by a calibration, with the covariance of their pixels."""

from __future__ import annotations

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.verdict.assessment import pixel_covariance_of
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.camera.measured import ProjectedPoints
from neurocal_cli.errors import InputError


def project(calibration: Calibration, points: Array, view: str | None = None) -> ProjectedPoints:
    """Project points (N, 3); see `Calibration.project`."""
    points = real_array("points", points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points must have the shape (N, 3), found {points.shape}")
    if view is not None:
        points = calibration.pose_of(view).to_camera(points)
    pixels, seen = calibration.camera.project(points)
    covariance = pixel_covariance_of(calibration, points[seen], view)
    if covariance is not None:
        everywhere = np.full((len(points), 2, 2), np.nan)
        everywhere[seen] = covariance
        covariance = everywhere
    return ProjectedPoints(pixels, covariance, seen)

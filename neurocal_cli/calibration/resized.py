"""Calibrations and rigs of resized or cropped images, with their standard deviations.

The points belong to the images that were measured and stay in the original file. The poses are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration, ViewResult
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.resizing import Resizing
from neurocal_cli.observations.points import Correspondences


def resized(result: Calibration | Rig, changes: Sequence[Resizing]) -> Calibration | Rig:
    """The calibration, or the rig, of new images; one change for each camera.

    Standard deviations and covariances are those of the new parameters. Errors in pixels are multiplied by
    the geometric mean of the scales in u and in v.
    """
    if isinstance(result, Calibration):
        views, second = (_views(views, changes[0]) for views in (result.views, result.second_poses))
        return replace(_resized(result, changes[0]), views=views, second_poses=second)
    mean = float(np.mean([change.mean for change in changes]))
    errors: dict[str, Any] = {name: mean * getattr(result, name) for name in ("rmse_px", "max_px")}
    cameras = map(_resized, result.cameras.values(), changes)
    by_name = dict(zip(result.cameras, cameras, strict=True))
    return replace(result.lean, cameras=by_name, judgement=None, **errors)


def _views(views: Mapping[str, ViewResult], change: Resizing) -> dict[str, ViewResult]:
    return {
        name: replace(view, n_points=0, rmse_px=change.mean * view.rmse_px) for name, view in views.items()
    }


def _resized(cal: Calibration, change: Resizing) -> Calibration:
    """The camera of the new images with its uncertainty, without poses."""
    factors = change.factors

    def scaled(names: tuple[str, ...], covariance: Array) -> Array:
        by = np.array([factors.get(name, 1.0) for name in names])
        return np.asarray(covariance * np.outer(by, by))

    return replace(
        cal.lean,
        intrinsics=change.intrinsics(cal.intrinsics),
        std={name: factors.get(name, 1.0) * value for name, value in cal.std.items()},
        covariance=scaled(cal.covariance_names, cal.covariance),
        given_covariance=scaled(cal.given_names, cal.given_covariance),
        points=Correspondences.none(change.size, cal.unit),
        rmse_px=change.mean * cal.rmse_px,
        max_px=change.mean * cal.max_px,
        lens_choice={name: change.mean * error for name, error in cal.lens_choice.items()},
        straight_lines=None,
        square_pixels=cal.square_pixels and change.scale[0] == change.scale[1],
        judgement=None,
    )

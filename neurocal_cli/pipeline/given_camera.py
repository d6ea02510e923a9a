"""Add the uncertainty of a given camera to the standard deviations of the poses (type 3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.given_camera import covariance_by_camera, entry_covariance
from neurocal_cli.bundle_adjustment.parameter_uncertainty import pose_std
from neurocal_cli.bundle_adjustment.units import normalised
from neurocal_cli.bundle_adjustment.views import arrange
from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.pinhole import POSE_NAMES
from neurocal_cli.verdict.assessment import stored_state


# Poses that the points do not determine have an infinite std already.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def with_given_covariance(found: Calibration, given: Calibration) -> Calibration:
    """A calibration of type 3 whose poses have the uncertainty of the given camera, as far as it is known."""
    names, covariance = given.known_covariance
    if not names or not np.isfinite(covariance).all():
        return found
    views = arrange(found.points)
    state = stored_state(found, views.names)
    entries = entry_covariance(found.intrinsics, state.model, names, covariance, views.pixel_scale)
    block = covariance_by_camera(views, normalised(state, views), entries)
    added = pose_std(state.R, (state.R @ views.centre[..., None])[..., 0], views.scale, block)
    results = dict(found.views)
    for name, more in zip(views.names, added.tolist(), strict=True):
        std = found.views[name].std
        both = {one: float(np.hypot(std[one], by)) for one, by in zip(POSE_NAMES, more, strict=True)}
        results[name] = replace(found.views[name], std=both)
    return replace(found, views=results, given_covariance=covariance, given_names=names)

"""The state of an adjustment from a calibration and its poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.adjustment.reprojection import CameraState
from neurocal_cli.calibration.calibration import Calibration


def stored_state(calibration: Calibration, names: Sequence[str]) -> CameraState:
    """The camera of a calibration and its poses of the named views, in pixels and world units."""
    poses, camera = [calibration.views[name].pose for name in names], calibration.camera
    R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
    return CameraState(np.array([camera.entries]), R, t, camera.model, camera.distortion.coefficients)

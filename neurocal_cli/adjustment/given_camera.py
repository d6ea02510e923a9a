"""Uncertainty of poses that comes from the uncertainty of a given camera (type 3).

The poses of a view follow an error of the given camera as they would follow that parameter if it were
estimated, d pose = -B^-1 C d camera, where B and C are the blocks of the view's normal matrix for its pose
and for its pose and the camera. With the covariance S of the camera, the pose of the view has the additional
covariance B^-1 C S C^T B^-1. It does not fall with the number of points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.adjustment.reprojection import POSE, camera_columns, normal_blocks
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics
from neurocal_cli.camera.state import CameraState


def entry_covariance(
    intrinsics: Intrinsics, model: str, names: Sequence[str], covariance: Array, pixel_scale: float
) -> Array:
    """(5 + K, 5 + K) covariance of A's entries in normalised pixels and of the distortion coefficients.

    `covariance` (n, n) is that of the parameters with these names; the others are exact.
    """
    every = (*INTRINSIC_NAMES, *coefficient_names(model))
    place = [every.index(name) for name in names]
    to_entries = np.eye(len(every))
    to_entries[:5, :5] = np.linalg.inv(intrinsics.entry_jacobian() * pixel_scale)
    return np.asarray(to_entries[:, place] @ covariance @ to_entries[:, place].T)


def covariance_by_camera(views: Views, state: CameraState, entries: Array) -> Array:
    """(V, 6, 6) covariance of omega and tau, normalised, that a camera's covariance causes.

    `entries` (5 + K, 5 + K) is as from `entry_covariance`, and `state` is normalised and at its minimum.
    """
    normal, _ = normal_blocks(views.batches, state)
    columns = camera_columns(state.k.shape[-1])
    gain = solve_scaled(normal[:, POSE, POSE], np.swapaxes(normal[:, columns, POSE], 1, 2))  # (V, 6, 5 + K)
    return np.asarray(gain @ entries @ np.swapaxes(gain, 1, 2))

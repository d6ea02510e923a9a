"""Standard deviation of triangulated depths from the covariance of a rig and its cameras."""

from __future__ import annotations

import numpy as np

from neurocal_cli.bundle_adjustment.problem import intrinsic_matrix
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.geometry import Array, rotation_step
from neurocal_cli.stereo.relative_poses import RelativePoses
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.stereo.triangulation import triangulate

_STEP = 1e-2  # standard deviations: small enough to be linear, large against rounding
_LEAST_STEP = 1e-9


def depth_std(
    rig: Rig, poses: RelativePoses, covariance: Array, pixels: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Depths of points in the left camera's frame, and their standard deviations for exact pixels.

    Parameters
    ----------
    rig : Rig
    poses : RelativePoses
        Of the same rig, for the order of the unknowns.
    covariance : (F, F) array
        Of the unknowns, from `rig_covariance`.
    pixels : two of (N, 2) array [px]

    Returns
    -------
    depth, std : (N,) arrays [world unit]
        nan for points that are behind a camera.
    """

    def depths(step: Array) -> Array:
        left, right = (_moved_camera(poses, side, step) for side in (0, 1))
        w, tau = np.split(step[poses.rig], 2)
        pose = Pose(rotation_step(w) @ rig.R, rig.t + tau * poses.unit)
        found = triangulate(left, right, pose, *pixels)
        return np.where(found.behind, np.nan, found.points[:, 2])

    depth = depths(np.zeros(len(covariance)))
    steps = np.maximum(_STEP * np.sqrt(np.abs(np.diagonal(covariance))), _LEAST_STEP)
    J = np.stack([(depths(row) - depth) / row.max() for row in np.diag(steps)], axis=1)
    return depth, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, covariance, J), 0.0))


def _moved_camera(poses: RelativePoses, side: int, step: Array) -> Camera:
    """One camera after a step of the unknowns."""
    state, seen = poses.problem.cameras[side], poses.problem.observations[side]
    values = np.concatenate([state.entries[0], state.k])
    values[poses.problem.estimated[side]] += step[poses.own[side]]
    A = intrinsic_matrix(seen.in_pixels(values[:5]))
    return Camera(Intrinsics.from_matrix(A), Distortion(state.model, values[5:]))

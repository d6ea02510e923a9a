"""Standard deviation of triangulated depths from the covariance of a rig and its cameras."""

from __future__ import annotations

import numpy as np

from neurocal_cli.bundle_adjustment.problem import intrinsic_matrix
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.geometry import Array, rotation_step
from neurocal_cli.stereo.problem import RigProblem
from neurocal_cli.stereo.relative_poses import RelativePoses
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.stereo.triangulation import triangulate

_STEP = 1e-2  # standard deviations: small enough to be linear, large against rounding
_LEAST_STEP = 1e-9


def depth_std(
    rig: Rig,
    problem: RigProblem,
    poses: RelativePoses,
    covariance: Array,
    pixels: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Depths of points in the left camera's frame, and their standard deviations for exact pixels.

    Parameters
    ----------
    rig : Rig
    problem : RigProblem
        Of the same rig.
    poses : RelativePoses
        For the order of the unknowns.
    covariance : (F, F) array
        Of the unknowns, from `rig_covariance`.
    pixels : two of (N, 2) array [px]

    Returns
    -------
    depth, std : (N,) arrays [world unit]
        nan for points that are behind a camera.
    """
    moved = _Moved(rig, problem, poses)
    depth = moved.depths(np.zeros(len(covariance)), pixels)
    steps = np.maximum(_STEP * np.sqrt(np.abs(np.diagonal(covariance))), _LEAST_STEP)
    J = np.stack([(moved.depths(row, pixels) - depth) / row.max() for row in np.diag(steps)], axis=1)
    return depth, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, covariance, J), 0.0))


class _Moved:
    """A rig whose parameters are moved by a step of the unknowns."""

    def __init__(self, rig: Rig, problem: RigProblem, poses: RelativePoses) -> None:
        self.rig, self.problem, self.poses = rig, problem, poses

    def depths(self, step: Array, pixels: tuple[Array, Array]) -> Array:
        """(N,) depths; nan behind a camera."""
        pose = self.rig.pose
        by_rig = step[self.poses.rig]
        moved = Pose(rotation_step(by_rig[:3]) @ pose.R, pose.t + by_rig[3:] * self.poses.unit)
        left, right = (self._camera(side, step) for side in (0, 1))
        found = triangulate(left, right, moved, *pixels)
        return np.where(found.behind, np.nan, found.points[:, 2])

    def _camera(self, side: int, step: Array) -> Camera:
        state, seen = self.problem.cameras[side], self.problem.observations[side]
        place, by = self.poses.estimated[side], step[(self.poses.left, self.poses.right)[side]]
        values = np.concatenate([state.entries[0], state.k])
        values[place] += by
        entries = values[:5] * seen.pixel_scale
        entries[3:] += seen.pixel_centre
        A = intrinsic_matrix(entries)
        return Camera(Intrinsics.from_matrix(A), Distortion(state.model, values[5:]))

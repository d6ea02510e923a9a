"""The reprojection error (3) of two cameras on one rig: derivatives and normal matrices.

A view of both cameras has one pose, in the left camera's frame. Its pose in the right camera is R'_k = R R_k
and t'_k = R t_k + t. A view of one camera alone has the pose in that camera and does not determine the rig.
The derivatives of each camera are those of `neurocal_cli.bundle_adjustment.reprojection`. Those of the right
camera are transformed by the chain rule:

    R -> exp(w) R,  t -> t + tau,  R_k -> exp(w_k) R_k,  t_k -> t_k + tau_k   give
    w' = w + R w_k,  tau' = w x (R t_k) + R tau_k + tau
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.point_batches import PointBatches
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, camera_columns, normal_blocks
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array, cross_matrix, orthonormalised, rotation_step


@frozen_dataclass(eq=False)
class Frames:
    """The views of both cameras, each with a normalised frame of its target.

    Attributes
    ----------
    centre : (V, 3) array
    scale : (V,) array
        World = centre + scale * local.
    in_both : (V,) bool array
        Whether the view is of both cameras.
    unit : float
        Unit of the rig's translation [world unit].
    """

    centre: Array
    scale: Array
    in_both: NDArray[np.bool_]
    unit: float


@frozen_dataclass(eq=False)
class Observations:
    """Observations of one camera.

    Attributes
    ----------
    batches : PointBatches
        Its views in local coordinates of the frames, with normalised pixels.
    view : (V_c,) int array
        Frame of each of its views.
    pixel_centre : (2,) array
    pixel_scale : float
        S1 [px].
    weight : float
        Of a squared normalised residual, (pixel_scale / sigma)^2, so that residuals are whitened.
    n_points : int
    n_equations : float
        Two for most points; see `measured_directions`.
    """

    batches: PointBatches
    view: NDArray[np.intp]
    pixel_centre: Array
    pixel_scale: float
    weight: float
    n_points: int
    n_equations: float


@frozen_dataclass(eq=False)
class RigState:
    """Two cameras, the rig and the poses, normalised.

    Attributes
    ----------
    cameras : two of CameraState
        Only their entries and distortion are used; the poses are those below.
    R, t : (3, 3), (3,) arrays
        The rig, X_right = R X_left + t, t in `Frames.unit`.
    view_R, view_t : (V, 3, 3), (V, 3) arrays
        Of each frame's local coordinates, Xc / scale = R local + t, in the left camera's frame, or in the
        right camera's for its single views.
    """

    cameras: tuple[CameraState, CameraState]
    R: Array
    t: Array
    view_R: Array
    view_t: Array

    @cached_property
    def columns(self) -> Columns:
        """Columns of the unknowns for the distortion models of both cameras."""
        ends = np.cumsum([0, *(5 + len(camera.k) for camera in self.cameras), 6, 6])
        return Columns(*(np.arange(a, b) for a, b in pairwise(ends.tolist())))

    def moved(self, shared: Array, own: Array) -> RigState:
        """The state after a step: shared (columns.n_shared,), own (V, 6)."""
        columns = self.columns
        cameras = tuple(
            replace(
                camera,
                entries=camera.entries + shared[None, place[:5]],
                k=camera.k + shared[place[5:]],
            )
            for camera, place in zip(self.cameras, columns.cameras, strict=True)
        )
        rig = shared[columns.rig]
        return RigState(
            (cameras[0], cameras[1]),
            rotation_step(rig[:3]) @ self.R,
            self.t + rig[3:],
            rotation_step(own[:, :3]) @ self.view_R,
            self.view_t + own[:, 3:],
        )

    def orthonormalised(self) -> RigState:
        """The same with rotations that are orthonormal in spite of rounding."""
        return replace(self, R=orthonormalised(self.R), view_R=orthonormalised(self.view_R))

    def camera_with_poses(self, side: int, frames: Frames, observations: Observations) -> CameraState:
        """One camera with the poses of its own views."""
        view = observations.view
        R, t = self.view_R[view], self.view_t[view]
        if side == 1:
            through = frames.in_both[view][:, None]
            baseline = self.t * (frames.unit / frames.scale[view])[:, None]
            R, t = (
                np.where(through[..., None], self.R @ R, R),
                np.where(through, t @ self.R.T + baseline, t),
            )
        return replace(self.cameras[side], R=R, t=t)


@frozen_dataclass(eq=False)
class Columns:
    """Columns of the unknowns in the normal matrices.

    Attributes
    ----------
    left, right : (5 + K,) int arrays
        Entries of A and distortion coefficients of each camera.
    rig, pose : (6,) int arrays
        w and tau.
    """

    left: NDArray[np.intp]
    right: NDArray[np.intp]
    rig: NDArray[np.intp]
    pose: NDArray[np.intp]

    @property
    def cameras(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns of the left and of the right camera."""
        return self.left, self.right

    @property
    def n_shared(self) -> int:
        """Number of unknowns that all views share."""
        return int(self.pose[0])

    @property
    def width(self) -> int:
        """Number of all columns, the residual last."""
        return int(self.pose[-1]) + 2


def rig_normal_blocks(
    frames: Frames, observations: tuple[Observations, Observations], state: RigState
) -> tuple[Array, bool]:
    """Products of derivatives and residuals, summed over the points of each view in both cameras.

    Returns
    -------
    normal : (V, D, D) array
        In the order of the columns, for residuals of variance 1.
    sensible : bool
        Whether all points are in front of their cameras and the distortions are monotonic there.
    """
    D = state.columns.width
    normal = np.zeros((len(frames.scale), D, D))
    sensible = True
    for side, observed in enumerate(observations):
        camera = state.camera_with_poses(side, frames, observed)
        blocks, fine = normal_blocks(observed.batches, camera)
        T = rig_jacobian(frames, observed, state, side)
        normal[observed.view] += observed.weight * (np.swapaxes(T, 1, 2) @ blocks @ T)
        sensible = sensible and bool(fine.all())
    return normal, sensible


def rig_jacobian(frames: Frames, observed: Observations, state: RigState, side: int) -> Array:
    """Derivatives of the columns of one camera by the columns of the rig, (V_c, 12 + K, D)."""
    columns = state.columns
    place = columns.cameras[side]
    own = camera_columns(len(place) - 5)
    T = np.zeros((len(observed.view), len(own) + 7, columns.width))
    T[:, own, place] = 1.0
    T[:, -1, -1] = 1.0
    pose = np.arange(POSE.start, POSE.stop)
    through = frames.in_both[observed.view] if side == 1 else np.zeros(len(observed.view), dtype=bool)
    alone = np.flatnonzero(~through)
    T[alone[:, None], pose, columns.pose] = 1.0
    which = np.flatnonzero(through)
    if which.size:
        view = observed.view[which]
        by_rig, by_pose = np.zeros((len(which), 6, 6)), np.zeros((6, 6))
        by_rig[:, :3, :3] = np.eye(3)
        by_rig[:, 3:, :3] = -cross_matrix(state.view_t[view] @ state.R.T)
        by_rig[:, 3:, 3:] = np.eye(3) * (frames.unit / frames.scale[view])[:, None, None]
        by_pose[:3, :3] = by_pose[3:, 3:] = state.R
        T[which[:, None, None], pose[:, None], columns.rig] = by_rig
        T[which[:, None, None], pose[:, None], columns.pose] = by_pose
    return T

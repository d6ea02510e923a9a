"""The pixel error (3) of two cameras on one rig: derivatives and normal matrices of both at once.

A view that both cameras saw has one pose, in the left camera's frame; the right camera's follows
through the rig, R'_k = R R_k and t'_k = R t_k + t. A view that only one camera saw has that camera's
pose and tells nothing of the rig, but as much of its camera as it ever did. Each camera's derivatives
are those of `neurocal_cli.bundle_adjustment.reprojection`; the right camera's are led through the rig:

    R -> exp(w) R,  t -> t + tau,  R_k -> exp(w_k) R_k,  t_k -> t_k + tau_k   give
    w' = w + R w_k,  tau' = w x (R t_k) + R tau_k + tau
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.point_batches import PointBatches
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, camera_columns, normal_blocks
from neurocal_cli.geometry import Array, cross_matrix, orthonormalised, rotation_step

__all__ = ["Columns", "Frames", "RigState", "Sightings", "rig_normal_blocks", "through_rig"]


@dataclass(frozen=True, eq=False)
class Frames:
    """The views of both cameras, each with one normalised frame for its target.

    Attributes
    ----------
    centre : (V, 3) array
    scale : (V,) array
        World = centre + scale * local.
    through_rig : (V,) bool array
        Whether both cameras saw the view.
    unit : float
        Of the rig's translation [world unit].
    """

    centre: Array
    scale: Array
    through_rig: NDArray[np.bool_]
    unit: float


@dataclass(frozen=True, eq=False)
class Sightings:
    """What one camera saw.

    Attributes
    ----------
    batches : PointBatches
        Of its own views, in the frames' local coordinates, its own normalised pixels.
    view : (V_c,) int array
        Place of each of its views among the frames.
    pixel_centre : (2,) array
    pixel_scale : float
        S1 [px].
    weight : float
        Of a squared normalised residual: whitened pixels, (pixel_scale / sigma)^2.
    n_points : int
    n_equations : float
        Two of most points; see `directions`.
    """

    batches: PointBatches
    view: NDArray[np.intp]
    pixel_centre: Array
    pixel_scale: float
    weight: float
    n_points: int
    n_equations: float


@dataclass(frozen=True, eq=False)
class RigState:
    """Two cameras, the rig and the poses, normalised.

    Attributes
    ----------
    cameras : two of CameraState
        Of which entries and lens count; their poses follow from the rest.
    R, t : (3, 3), (3,) arrays
        The rig, X_right = R X_left + t, t in `Frames.unit`.
    view_R, view_t : (V, 3, 3), (V, 3) arrays
        Of each frame's local coordinates: Xc / scale = R local + t, in the left camera's frame, or in
        the right camera's for views that it alone saw.
    """

    cameras: tuple[CameraState, CameraState]
    R: Array
    t: Array
    view_R: Array
    view_t: Array

    def moved(self, columns: Columns, shared: Array, own: Array) -> RigState:
        """The state after a step: shared (columns.n_shared,), own (V, 6)."""
        cameras = tuple(
            replace(
                camera,
                entries=camera.entries + shared[None, place[:5]],
                k=camera.k + shared[place[5:]],
            )
            for camera, place in zip(self.cameras, (columns.left, columns.right), strict=True)
        )
        rig = shared[columns.rig]
        return RigState(
            (cameras[0], cameras[1]),
            rotation_step(rig[:3]) @ self.R,
            self.t + rig[3:],
            rotation_step(own[:, :3]) @ self.view_R,
            self.view_t + own[:, 3:],
        )

    def settled(self) -> RigState:
        """The same, rounding taken off the rotations."""
        return replace(self, R=orthonormalised(self.R), view_R=orthonormalised(self.view_R))

    def seen_by(self, side: int, frames: Frames, sightings: Sightings) -> CameraState:
        """One camera with the poses of its own views."""
        view = sightings.view
        R, t = self.view_R[view], self.view_t[view]
        if side == 1:
            through = frames.through_rig[view][:, None]
            baseline = self.t * (frames.unit / frames.scale[view])[:, None]
            R, t = (
                np.where(through[..., None], self.R @ R, R),
                np.where(through, t @ self.R.T + baseline, t),
            )
        return replace(self.cameras[side], R=R, t=t)


@dataclass(frozen=True, eq=False)
class Columns:
    """Places of the unknowns among the columns of the normal matrices.

    Attributes
    ----------
    left, right : (5 + K,) int arrays
        Entries of A and coefficients of the lens of each camera.
    rig, pose : (6,) int arrays
        w and tau.
    """

    left: NDArray[np.intp]
    right: NDArray[np.intp]
    rig: NDArray[np.intp]
    pose: NDArray[np.intp]

    @classmethod
    def of(cls, state: RigState) -> Columns:
        """Lay out the columns for two cameras' lenses."""
        ends = np.cumsum([0, *(5 + len(camera.k) for camera in state.cameras), 6, 6])
        return cls(*(np.arange(a, b) for a, b in pairwise(ends.tolist())))

    @property
    def n_shared(self) -> int:
        """Number of unknowns that all views share."""
        return int(self.pose[0])

    @property
    def width(self) -> int:
        """Number of all columns, the residual last."""
        return int(self.pose[-1]) + 2


def rig_normal_blocks(
    frames: Frames, sightings: tuple[Sightings, Sightings], state: RigState, columns: Columns
) -> tuple[Array, bool]:
    """Products of derivatives and residuals summed over each view's points in both cameras.

    Returns
    -------
    normal : (V, D, D) array
        In the columns' order, whitened: squared residuals of variance 1.
    sensible : bool
        Whether all points are in front of their cameras and no lens folds any of them back.
    """
    normal = np.zeros((len(frames.scale), columns.width, columns.width))
    sensible = True
    for side, seen in enumerate(sightings):
        camera = state.seen_by(side, frames, seen)
        blocks, fine = normal_blocks(seen.batches, camera)
        T = through_rig(frames, seen, state, columns, side)
        normal[seen.view] += seen.weight * (np.swapaxes(T, 1, 2) @ blocks @ T)
        sensible = sensible and bool(fine.all())
    return normal, sensible


def through_rig(frames: Frames, seen: Sightings, state: RigState, columns: Columns, side: int) -> Array:
    """Derivatives of one camera's own columns by the rig's columns, (V_c, 12 + K, D)."""
    place = (columns.left, columns.right)[side]
    own = camera_columns(len(place) - 5)
    T = np.zeros((len(seen.view), len(own) + 7, columns.width))
    T[:, own, place] = 1.0
    T[:, -1, -1] = 1.0
    pose = np.arange(POSE.start, POSE.stop)
    through = frames.through_rig[seen.view] if side == 1 else np.zeros(len(seen.view), dtype=bool)
    alone = np.flatnonzero(~through)
    T[alone[:, None], pose, columns.pose] = 1.0
    which = np.flatnonzero(through)
    if which.size:
        view = seen.view[which]
        by_rig, by_pose = np.zeros((len(which), 6, 6)), np.zeros((6, 6))
        by_rig[:, :3, :3] = np.eye(3)
        by_rig[:, 3:, :3] = -cross_matrix(state.view_t[view] @ state.R.T)
        by_rig[:, 3:, 3:] = np.eye(3) * (frames.unit / frames.scale[view])[:, None, None]
        by_pose[:3, :3] = by_pose[3:, 3:] = state.R
        T[which[:, None, None], pose[:, None], columns.rig] = by_rig
        T[which[:, None, None], pose[:, None], columns.pose] = by_pose
    return T

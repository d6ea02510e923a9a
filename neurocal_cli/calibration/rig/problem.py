"""The reprojection error (3) of a rig, its unknowns and its derivatives: several cameras in common frames.

A frame is what the cameras saw at one moment: one view of each of some of them. A frame of several cameras
has one pose (R_k, t_k), in the frame of reference of the first camera of the rig, whether that one saw it or
not. Its pose in camera c is R'_k = R_c R_k and t'_k = R_c t_k + t_c. A frame of one camera alone has the pose
in that camera and does not determine the rig. The derivatives of each camera are those of
`adjustment.reprojection`, transformed by the chain rule:

    R_c -> exp(w) R_c,  t_c -> t_c + tau,  R_k -> exp(w_k) R_k,  t_k -> t_k + tau_k   give
    w' = w + R_c w_k,  tau' = w x (R_c t_k) + R_c tau_k + tau

Where the images of a frame were taken at different times, the target moved in between. With its path (omega,
v) as a polynomial in time, known from the frames before and after, and the time d between the frame and the
view, exp(omega(d)) R_k, t_k + v(d) take the place of R_k, t_k; d is the difference of the stated times plus a
delay of each camera, which can be estimated.

`adjust.rig_problem` makes one normalised problem of the calibrations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead
from neurocal_cli.adjustment.problem import translations
from neurocal_cli.adjustment.reprojection import (
    POSE,
    camera_columns,
    normal_blocks,
)
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.calibration import Calibration, estimated_parameters
from neurocal_cli.calibration.lens_choice.monotonic_fit import MonotonicFit
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, by_motion, rotation_step
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.target import Target

Frames = Sequence[NDArray[np.intp]]
"""Of each camera, the frame (V_c,) of each of its views; views of one moment have one frame."""


@frozen_dataclass(eq=False)
class Motion:
    """The path of the target around each frame, and when the views were taken."""

    # (V, k, 6) turn and shift of the target, normalised: the coefficients of the powers of time from 1 to k.
    path: Array
    lag: tuple[Array, ...]  # of each camera, (V_c,) stated time of the view less that of its frame
    stated: bool = False  # whether the times are stated

    def of(self, frames: NDArray[np.intp]) -> Motion:
        """With the paths of other frames, (V,) of the present ones."""
        return replace(self, path=self.path[frames])

    def at(self, elapsed: Array, frames: NDArray[np.intp]) -> tuple[Array, Array]:
        """Turn and shift (n, 6) after some time (n,), and their derivatives by the time."""
        powers = np.arange(1, self.path.shape[1] + 1)
        path = self.path[frames]
        moved = elapsed[:, None] ** powers
        speed = powers * elapsed[:, None] ** (powers - 1)
        return np.einsum("np,npi->ni", moved, path), np.einsum("np,npi->ni", speed, path)


@frozen_dataclass(eq=False)
class Columns:
    """Columns of the unknowns in the normal matrix: A's entries and coefficients, and steps w, tau."""

    cameras: tuple[NDArray[np.intp], ...]  # (5 + K,) of each
    rigs: tuple[NDArray[np.intp], ...]  # (6,) of each camera but the first, for which it is empty
    delays: tuple[NDArray[np.intp], ...]  # (1,) likewise; all empty without a motion

    @property
    def n_shared(self) -> int:
        """Number of unknowns that all views share."""
        return sum(map(len, (*self.cameras, *self.rigs, *self.delays)))


@frozen_dataclass(eq=False)
class RigState:
    """The cameras, the rig X_c = R_c X_first + t_c, and the poses Xc / scale = R_k local + t_k."""

    cameras: tuple[CameraState, ...]  # only their entries and distortion are used
    R: Array  # (C, 3, 3), the first is the identity
    t: Array  # (C, 3) in units of `RigProblem.unit`, the first is 0
    view_R: Array  # (V, 3, 3) of each frame, in the first camera or, for frames of one camera alone, in that
    view_t: Array  # (V, 3)
    delay: Array  # (C,) of each camera's images [unit of time], the first is 0
    timed: bool  # whether the delays are unknowns

    @cached_property
    def columns(self) -> Columns:
        """Columns of the unknowns for the distortion models of the cameras."""
        C = len(self.cameras)
        widths = [5 + len(camera.k) for camera in self.cameras]
        widths += [0, *[6] * (C - 1), 0, *[int(self.timed)] * (C - 1)]
        places = [np.arange(end - width, end) for width, end in zip(widths, accumulate(widths), strict=True)]
        return Columns(tuple(places[:C]), tuple(places[C : 2 * C]), tuple(places[2 * C :]))

    def moved(self, shared: Array, own: Array) -> RigState:
        """The state after a step: shared (columns.n_shared,), own (V, 6)."""
        columns = self.columns
        cameras = tuple(
            camera.changed(shared[None, place])
            for camera, place in zip(self.cameras, columns.cameras, strict=True)
        )
        steps = np.zeros((len(cameras), 6))
        steps[1:] = shared[np.concatenate(columns.rigs)].reshape(-1, 6)
        delay = self.delay.copy()
        if self.timed:
            delay[1:] += shared[np.concatenate(columns.delays)]
        return RigState(
            cameras,
            rotation_step(steps[:, :3]) @ self.R,
            self.t + steps[:, 3:],
            rotation_step(own[:, :3]) @ self.view_R,
            self.view_t + own[:, 3:],
            delay,
            self.timed,
        )


@frozen_dataclass(eq=False)
class Observations:
    """Observations of one camera."""

    views: Views  # its views, with the world coordinates normalised as those of their frames
    view: NDArray[np.intp]  # (V_c,) frame of each of its views
    weight: float  # of a squared normalised residual, (S1 / sigma)^2, so that residuals are whitened


@frozen_dataclass(eq=False)
class ViewEquations:
    """Normal equations of one camera's views, in the shared unknowns that it has and the frames' poses."""

    place: NDArray[np.intp]  # (m,) columns of the shared unknowns and the residual, the last one
    frame: NDArray[np.intp]  # (V_c,) of each view
    M: Array  # (V_c, m + 6, m + 6)


@frozen_dataclass(eq=False)
class RigProblem:
    """Observations of C cameras in V common frames, and the poses in each camera alone."""

    calibrations: tuple[Calibration, ...]  # each camera alone
    centre: Array  # (V, 3) world = centre + scale * local
    scale: Array  # (V,)
    unit: float  # of the rig's translations [world unit]
    observations: tuple[Observations, ...]
    cameras: tuple[CameraState, ...]  # as calibrated alone, with the poses of the views
    own_normal: tuple[Array, ...]  # (V_c, 12 + K, 12 + K) whitened `normal_blocks` in each camera alone
    # Of the points of each frame's first camera: principal axes as columns, the longest first, (V, 3, 3), rms
    # extents along them (V, 3), and whether the target is flat (V,).
    basis: Array
    extent: Array
    is_flat: NDArray[np.bool_]
    motion: Motion | None = None  # of the target, if the times of the views are known
    # By camera, that which keeps its distortion monotonic up to the corners of its image.
    penalties: Mapping[int, MonotonicFit] = field(default_factory=dict)

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """Views of each camera, in the order of its observations."""
        return tuple(observed.views.names for observed in self.observations)

    @cached_property
    def views(self) -> list[dict[int, str]]:
        """Of each frame, the name of the view of each camera that saw it, by the index of the camera."""
        found: list[dict[int, str]] = [{} for _ in self.scale]
        for side, (names, observed) in enumerate(zip(self.names, self.observations, strict=True)):
            for name, frame in zip(names, observed.view.tolist(), strict=True):
                found[frame][side] = name
        return found

    @cached_property
    def n_views(self) -> NDArray[np.intp]:
        """(V,) of each frame."""
        views = np.concatenate([observed.view for observed in self.observations])
        return np.bincount(views, minlength=len(self.scale))

    @cached_property
    def together(self) -> NDArray[np.bool_]:
        """(V,) frames of several cameras, which have their pose in the first camera of the rig."""
        return self.n_views > 1

    @property
    def target(self) -> Target | None:
        """The estimated target, if it is that of all cameras."""
        target = self.calibrations[0].target
        return target if all(camera.target is target for camera in self.calibrations) else None

    @property
    def estimated(self) -> tuple[NDArray[np.bool_], ...]:
        """`estimated_parameters` of each camera."""
        return tuple(estimated_parameters(calibration) for calibration in self.calibrations)

    @property
    def times(self) -> list[Array] | None:
        """Stated times of each camera's views, (V_c,); None if some are not known."""
        times = [calibration.points.view_times for calibration in self.calibrations]
        known = [one for one in times if one is not None]
        return known if len(known) == len(times) else None

    @property
    def n_rig(self) -> int:
        """Number of unknowns of the rig itself."""
        return (6 if self.motion is None else 7) * (len(self.cameras) - 1)

    @property
    def estimated_shared(self) -> NDArray[np.bool_]:
        """(n_shared,) which unknowns that all views share are estimated; those of the rig always are."""
        return np.concatenate([*self.estimated, np.ones(self.n_rig, dtype=bool)])

    @cached_property
    def paired_right(self) -> NDArray[np.intp]:
        """(P,) of two cameras: the views of the right one that are paired, by index."""
        return np.flatnonzero(self.together[self.observations[1].view])

    @cached_property
    def paired(self) -> NDArray[np.intp]:
        """(P,) their frames."""
        return self.observations[1].view[self.paired_right]

    @cached_property
    def paired_left(self) -> NDArray[np.intp]:
        """(P,) their partners among the views of the left camera, by index."""
        of_frame = np.zeros(len(self.scale), dtype=np.intp)
        of_frame[self.observations[0].view] = np.arange(len(self.names[0]))
        return of_frame[self.paired]

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Left and right names of the paired views of two cameras."""
        left, right = self.names
        return [(left[a], right[b]) for a, b in zip(self.paired_left, self.paired_right, strict=True)]

    @cached_property
    def spread(self) -> Array:
        """(P, 5, 3) local: the centre of each pair's target, and points on its two longest axes.

        They are one rms extent from the centre.
        """
        along = self.basis[self.paired] * self.extent[self.paired][:, None, :]  # (P, 3, axis)
        long, across = along[:, :, 0], along[:, :, 1]
        return np.stack([np.zeros_like(long), long, -long, across, -across], axis=1)

    def of_two(self, first: int, second: int) -> RigProblem:
        """The problem of two of the cameras."""
        sides = first, second
        return replace(
            self._of_frames(np.arange(len(self.scale)), [self.observations[side] for side in sides]),
            calibrations=tuple(self.calibrations[side] for side in sides),
            cameras=tuple(self.cameras[side] for side in sides),
            own_normal=tuple(self.own_normal[side] for side in sides),
            motion=None,
            penalties={},
        )

    def _of_frames(self, frames: NDArray[np.intp], seen: Sequence[Observations]) -> RigProblem:
        """With other frames, by their index among the present ones, as far as these observations show any."""
        kept = np.zeros(len(frames), dtype=bool)
        for observed in seen:
            kept[observed.view] = True
        place, frames = np.cumsum(kept) - 1, frames[kept]
        return replace(
            self,
            observations=tuple(replace(observed, view=place[observed.view]) for observed in seen),
            centre=self.centre[frames],
            scale=self.scale[frames],
            basis=self.basis[frames],
            extent=self.extent[frames],
            is_flat=self.is_flat[frames],
            motion=None if self.motion is None else self.motion.of(frames),
        )

    def detached(self, views: Sequence[NDArray[np.bool_]]) -> RigProblem:
        """With frames of their own for some views of each camera, (V_c,); these do not determine the rig."""
        frames, observations = np.arange(len(self.scale)), []
        for observed, apart in zip(self.observations, views, strict=True):
            view = observed.view.copy()
            frames = np.concatenate([frames, view[apart]])
            view[apart] = np.arange(len(frames) - int(apart.sum()), len(frames))
            observations.append(replace(observed, view=view))
        return self._of_frames(frames, observations)

    def start(self, others: Sequence[Pose]) -> RigState:
        """The calibrated cameras, and the poses of the first camera that saw each frame.

        `others` are the poses X_c = R_c X_first + t_c of all cameras but the first.
        """
        rig = [Pose(np.eye(3), np.zeros(3)), *others]
        R, t = np.stack([pose.R for pose in rig]), np.stack([pose.t for pose in rig]) / self.unit
        view_R, view_t = np.empty((len(self.scale), 3, 3)), np.empty((len(self.scale), 3))
        for c in reversed(range(len(rig))):
            camera, view = self.cameras[c], self.observations[c].view
            through = self.together[view][:, None]
            back = (camera.t - t[c] * (self.unit / self.scale[view])[:, None]) @ R[c]
            view_R[view] = np.where(through[..., None], R[c].T @ camera.R, camera.R)
            view_t[view] = np.where(through, back, camera.t)
        delay = np.zeros(len(rig))
        return RigState(self.cameras, R, t, view_R, view_t, delay, self.motion is not None)

    def poses(self, state: RigState) -> list[Pose]:
        """The poses of all cameras, X_c = R_c X_first + t_c, in world units."""
        return [Pose(R, t * self.unit) for R, t in zip(state.R, state.t, strict=True)]

    def camera(self, state: RigState, side: int) -> CameraState:
        """One camera with the poses of its own views."""
        view = self.observations[side].view
        R, t = self._at_its_time(state, side)
        if side:
            both = self.together[view][:, None]
            baseline = state.t[side] * (self.unit / self.scale[view])[:, None]
            R = np.where(both[..., None], state.R[side] @ R, R)
            t = np.where(both, t @ state.R[side].T + baseline, t)
        return replace(state.cameras[side], R=R, t=t)

    def _at_its_time(self, state: RigState, side: int) -> tuple[Array, Array]:
        """Poses of the frames when one camera took its views, (V_c, 3, 3) and (V_c, 3)."""
        view = self.observations[side].view
        R, t = state.view_R[view], state.view_t[view]
        if self.motion is None:
            return R, t
        moved, _ = self.motion.at(self._elapsed(state, side), view)
        return rotation_step(moved[:, :3]) @ R, t + moved[:, 3:]

    def _elapsed(self, state: RigState, side: int) -> Array:
        """(V_c,) time between each frame and one camera's view of it; 0 if it saw the frame alone."""
        assert self.motion is not None
        view = self.observations[side].view
        return np.asarray(np.where(self.together[view], self.motion.lag[side] + state.delay[side], 0.0))

    def world_poses(self, state: RigState, side: int) -> tuple[Array, Array]:
        """(V_c, 3, 3) and (V_c, 3) poses of one camera's views in this camera, in world units."""
        camera = self.camera(state, side)
        return camera.R, translations(self.observations[side].views, camera)

    def normal(self, state: RigState) -> tuple[Arrowhead, bool]:
        """Normal equations of all unknowns with whitened residuals; the own ones are those of the frames.

        Also returns whether all points are in front of their cameras, where the distortions are monotonic.
        """
        found = self.blocks(state)
        views = self.view_equations(state, [blocks for blocks, _ in found])
        return self.gathered(views), all(bool(fine.all()) for _, fine in found)

    def penalised(self, normal: Arrowhead, state: RigState) -> Arrowhead:
        """The normal equations with the penalties, whose residuals are as large as whitened ones."""
        shared = normal.shared.copy()
        for side, penalty in self.penalties.items():
            place = state.columns.cameras[side]
            by_camera, missing = penalty(state.cameras[side])
            rows = np.column_stack([by_camera, missing])
            place = np.append(place, -1)
            shared[place[:, None], place] += rows.T @ rows
        return replace(normal, shared=shared)

    def blocks(
        self, state: RigState, stretches: Array | None = None
    ) -> list[tuple[Array, NDArray[np.bool_]]]:
        """`normal_blocks` of each camera."""
        return [
            normal_blocks(observed.views.batches, self.camera(state, side), stretches)
            for side, observed in enumerate(self.observations)
        ]

    def view_equations(self, state: RigState, blocks: Sequence[Array]) -> list[ViewEquations]:
        """Whitened normal equations of each camera's views, from its blocks (V_c, 12 + K + m, 12 + K + m).

        The m columns before the residual's are those of m further unknowns that all views share, the last
        ones.
        """
        columns, found = state.columns, []
        for side, (observed, N) in enumerate(zip(self.observations, blocks, strict=True)):
            K = len(state.cameras[side].k)
            more = np.arange(11 + K, N.shape[-1])  # and the residual
            of_rig, by_rig, by_pose = self.pose_steps(state, side)
            further = columns.n_shared + np.arange(len(more))
            place = np.concatenate([columns.cameras[side], of_rig, further])
            at = 5 + K + len(of_rig)
            T = np.zeros((len(N), N.shape[-1], len(place) + 6))
            T[:, camera_columns(K), np.arange(5 + K)] = 1.0
            T[:, POSE, 5 + K : at] = by_rig
            T[:, more, at + np.arange(len(more))] = 1.0
            T[:, POSE, -6:] = by_pose
            M = observed.weight * (np.swapaxes(T, 1, 2) @ N @ T)
            found.append(ViewEquations(place, observed.view, M))
        return found

    def gathered(self, views: Sequence[ViewEquations]) -> Arrowhead:
        """The sum over all views."""
        s, V = int(views[0].place[-1]), len(self.scale)
        shared, own, cross = np.zeros((s + 1, s + 1)), np.zeros((V, 6, 6)), np.zeros((V, 6, s + 1))
        for one in views:
            place, m = one.place, len(one.place)
            shared[np.ix_(place, place)] += one.M[:, :m, :m].sum(axis=0)
            own[one.frame] += one.M[:, m:, m:]
            cross[np.ix_(one.frame, np.arange(6), place)] += one.M[:, m:, :m]
        return Arrowhead(shared, own, cross)

    def pose_steps(self, state: RigState, side: int) -> tuple[NDArray[np.intp], Array, Array]:
        """Derivatives of the poses in one camera by the rig, with its columns (r,), and by the frames' poses.

        They are (V_c, 6, r) and (V_c, 6, 6); the rig's are 0 for views of this camera alone.
        """
        columns, view = state.columns, self.observations[side].view
        through = self.together[view]
        of_rig = np.concatenate([columns.rigs[side], columns.delays[side]])
        by_pose = np.zeros((len(view), 6, 6))
        by_pose[:] = np.eye(6)
        by_rig = np.zeros((len(view), 6, len(of_rig)))
        if side == 0 and self.motion is None:
            return of_rig, by_rig, by_pose
        R, t = self._at_its_time(state, side)
        turn = state.R[side]
        step, of_frame = steps_through(turn, t[through] @ turn.T, self.unit / self.scale[view[through]])
        by_pose[through] = of_frame
        if self.motion is not None:
            # The step of a rotation comes before the turn of the time between.
            turned = R[through] @ np.swapaxes(state.view_R[view[through]], 1, 2)
            by_pose[through, :3, :3] = turn @ turned
        if of_rig.size:
            by_rig[through, :, :6] = step
        if of_rig.size > 6:
            assert self.motion is not None
            _, speed = self.motion.at(self._elapsed(state, side)[through], view[through])
            by_rig[through, :, 6] = speed @ of_frame.T
        return of_rig, by_rig, by_pose


def steps_through(R: Array, centre: Array, unit: Array) -> tuple[Array, Array]:
    """Derivatives (P, 6, 6) of w', tau' by w, tau, and those by w_k, tau_k, of the shape of R (..., 3, 3).

    `centre` (P, 3) are R t_k, and `unit` (P,) is the rig's unit of length in that of each view.
    """
    by_rig, by_pose = np.zeros((len(unit), 6, 6)), np.zeros((*R.shape[:-2], 6, 6))
    by_rig[:, :3, :3] = np.eye(3)
    by_rig[:, 3:] = by_motion(centre, unit)
    by_pose[..., :3, :3] = by_pose[..., 3:, 3:] = R
    return by_rig, by_pose

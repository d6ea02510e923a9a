"""Bundle adjustment of the cameras of one rig: the reprojection error (3), its derivatives and its minimum.

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

`rig_problem` makes one normalised problem of the calibrations, with common frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import FLOOR, OPTIONS
from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.common_noise import weighed
from neurocal_cli.adjustment.levenberg_marquardt import minimise
from neurocal_cli.adjustment.normal_equations import ROUNDING, Arrowhead, SharedAndOwn, solve_scaled
from neurocal_cli.adjustment.reprojection import (
    POSE,
    POSE_COLUMNS,
    camera_columns,
    free_columns,
    normal_blocks,
)
from neurocal_cli.adjustment.views import PointBatches, Views, batches_of
from neurocal_cli.calibration.calibration import Calibration, estimated_parameters
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, median, orthonormalised, rotation_step
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState

# A state, its normal equations, and those of the unknowns that move.
_Linearised = tuple["RigState", Arrowhead, Arrowhead]
_DAMPING = 1e-6  # each camera was adjusted alone before, so the first step is nearly undamped
# Smaller noise, as a share of the other camera's and in normalised pixels, is rounding in data without noise;
# test_without_noise_the_truth_comes_back checks such data.
_LEAST_SHARE = 1e-3
_LEAST_NOISE = 1e-12
_LEVEL = 3.09  # standard deviations of a normal variable, exceeded by chance once in 1000

Frames = Sequence[NDArray[np.intp]]
"""Of each camera, the frame (V_c,) of each of its views; views of one moment have one frame."""


@frozen_dataclass(eq=False)
class Observations:
    """Observations of one camera."""

    batches: PointBatches  # its views in the local coordinates of their frames, with normalised pixels
    view: NDArray[np.intp]  # (V_c,) frame of each of its views
    pixel_centre: Array  # (2,) [px]
    pixel_scale: float  # S1 [px]
    weight: float  # of a squared normalised residual, (pixel_scale / sigma)^2, so that residuals are whitened
    n_equations: float  # two for most points; one where a point was measured in one direction only

    @property
    def equations_by_view(self) -> Array:
        """(V_c,) number of equations."""
        counts = self.batches.counts
        return np.asarray(counts * (self.n_equations / counts.sum()))

    def in_pixels(self, entries: Array) -> Array:
        """(5,) entries of A [px] from normalised ones."""
        entries = entries * self.pixel_scale
        entries[3:] += self.pixel_centre
        return entries


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
            replace(
                camera.with_entries(camera.entries + shared[None, place[:5]]), k=camera.k + shared[place[5:]]
            )
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
class ViewEquations:
    """Normal equations of one camera's views, in the shared unknowns that it has and the frames' poses."""

    place: NDArray[np.intp]  # (m,) columns of the shared unknowns and the residual, the last one
    frame: NDArray[np.intp]  # (V_c,) of each view
    M: Array  # (V_c, m + 6, m + 6)


@frozen_dataclass(eq=False)
class RigProblem:
    """Observations of C cameras in V common frames, and the poses in each camera alone."""

    calibrations: tuple[Calibration, ...]  # each camera alone
    names: tuple[tuple[str, ...], ...]  # views of each camera, in the order of its observations
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

    @cached_property
    def together(self) -> NDArray[np.bool_]:
        """(V,) frames of several cameras, which have their pose in the first camera of the rig."""
        views = np.concatenate([observed.view for observed in self.observations])
        return np.bincount(views, minlength=len(self.scale)) > 1

    @property
    def estimated(self) -> tuple[NDArray[np.bool_], ...]:
        """`estimated_parameters` of each camera."""
        return tuple(estimated_parameters(calibration) for calibration in self.calibrations)

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
        seen = [self.observations[side] for side in sides]
        kept = np.zeros(len(self.scale), dtype=bool)
        for observed in seen:
            kept[observed.view] = True
        place = np.cumsum(kept) - 1
        return replace(
            self.of_frames(np.flatnonzero(kept)),
            calibrations=tuple(self.calibrations[side] for side in sides),
            names=tuple(self.names[side] for side in sides),
            observations=tuple(replace(observed, view=place[observed.view]) for observed in seen),
            cameras=tuple(self.cameras[side] for side in sides),
            own_normal=tuple(self.own_normal[side] for side in sides),
            motion=None,
        )

    def of_frames(self, frames: NDArray[np.intp]) -> RigProblem:
        """With other frames, by their index (V,) among the present ones; the views keep theirs."""
        return replace(
            self,
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
        kept = np.zeros(len(frames), dtype=bool)
        for observed in observations:
            kept[observed.view] = True
        place = np.cumsum(kept) - 1
        seen = tuple(replace(observed, view=place[observed.view]) for observed in observations)
        return replace(self.of_frames(frames[kept]), observations=seen)

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
        view, camera = self.observations[side].view, self.camera(state, side)
        turned = (camera.R @ self.centre[view][..., None])[..., 0]
        return camera.R, camera.t * self.scale[view][:, None] - turned

    def normal(self, state: RigState) -> tuple[Arrowhead, bool]:
        """Normal equations of all unknowns with whitened residuals; the own ones are those of the frames.

        Also returns whether all points are in front of their cameras, where the distortions are monotonic.
        """
        found = self.blocks(state)
        views = self.view_equations(state, [blocks for blocks, _ in found])
        return self.gathered(views), all(bool(fine.all()) for _, fine in found)

    def blocks(self, state: RigState) -> list[tuple[Array, NDArray[np.bool_]]]:
        """`normal_blocks` of each camera."""
        return [
            normal_blocks(observed.batches, self.camera(state, side))
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
    by_rig[:, 3:, :3] = -cross_matrix(centre)
    by_rig[:, 3:, 3:] = np.eye(3) * unit[:, None, None]
    by_pose[..., :3, :3] = by_pose[..., 3:, 3:] = R
    return by_rig, by_pose


def rig_problem(calibrations: Sequence[Calibration], frames: Frames) -> RigProblem:
    """Combine calibrations with one world unit; the frames are numbered from 0, without gaps."""
    # Covariances of the points count as far as the residuals confirm them.
    arranged = [weighed(camera.points, evaluate_camera(camera).residuals) for camera in calibrations]
    V = 1 + max(int(frame.max()) for frame in frames)
    centre, scale = np.empty((V, 3)), np.empty(V)
    basis, extent, is_flat = np.empty((V, 3, 3)), np.empty((V, 3)), np.empty(V, dtype=bool)
    for own, frame in reversed(list(zip(arranged, frames, strict=True))):
        centre[frame], scale[frame] = own.centre, own.scale
        basis[frame], extent[frame], is_flat[frame] = own.basis, own.extent, own.nearly_flat
    sides = [
        _side(camera, own, centre[which], scale[which], which)
        for camera, own, which in zip(calibrations, arranged, frames, strict=True)
    ]
    seen, states, normals, noise = zip(*sides, strict=True)
    real = [observed.pixel_scale * s for observed, s in zip(seen, noise, strict=True)]
    weights = [
        1.0 / (s * max(1.0, _LEAST_SHARE * max(real) / own)) ** 2 for s, own in zip(noise, real, strict=True)
    ]
    return RigProblem(
        calibrations=tuple(calibrations),
        names=tuple(own.names for own in arranged),
        centre=centre,
        scale=scale,
        unit=float(median(scale)),
        observations=tuple(replace(one, weight=weight) for one, weight in zip(seen, weights, strict=True)),
        cameras=states,
        own_normal=tuple(weight * normal for weight, normal in zip(weights, normals, strict=True)),
        basis=basis,
        extent=extent,
        is_flat=is_flat,
    )


def stereo_problem(left: Calibration, right: Calibration, pairs: Sequence[tuple[str, str]]) -> RigProblem:
    """Combine two calibrations, of which some views are paired by their names."""
    place = {name: k for k, name in enumerate(left.points.view_names)}
    partner = {b: place[a] for a, b in pairs}
    frame, end = [], len(place)
    for name in right.points.view_names:
        frame.append(partner.get(name, end))
        end += name not in partner
    return rig_problem((left, right), (np.arange(len(place)), np.array(frame)))


def free_parameters(calibration: Calibration) -> NDArray[np.bool_]:
    """(5 + K,) which of A's entries and the distortion coefficients a common fit may move.

    With a distortion from straight lines none is, as camera and distortion belong together.
    """
    return estimated_parameters(calibration) & (calibration.straight_lines is None)


def _side(
    calibration: Calibration, views: Views, centre: Array, scale: Array, frame: NDArray[np.intp]
) -> tuple[Observations, CameraState, Array, float]:
    """Normalised observations of one camera (without weight), its state, normal matrices and noise.

    `centre` (V_c, 3) and `scale` (V_c,) are those of the views' frames.
    """
    local = views.local * np.repeat(views.scale / scale, views.counts)[:, None]
    local += np.repeat((views.centre - centre) / scale[:, None], views.counts, axis=0)
    batches = batches_of(local, views.pixels, views.whitening, views.index, views.n_views)
    entries = calibration.K[ENTRIES]
    entries[3:] -= views.pixel_centre
    poses = [calibration.views[name].pose for name in views.names]
    R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
    state = CameraState(
        entries[None] / views.pixel_scale,
        R,
        ((R @ centre[..., None])[..., 0] + t) / scale[:, None],
        calibration.distortion_model,
        np.array(calibration.distortion, dtype=float),
        calibration.square_pixels,
    )
    normal, free = normal_blocks(batches, state)[0], free_parameters(calibration)
    spare = views.n_equations - int(free.sum()) - 6 * views.n_views
    noise = max(float(np.sqrt(cost_alone(normal, free) / max(spare, 1))), _LEAST_NOISE)
    observed = Observations(batches, frame, views.pixel_centre, views.pixel_scale, 1.0, views.n_equations)
    return observed, state, normal, noise


def cost_alone(normal: Array, free: NDArray[np.bool_]) -> float:
    """Sum of squares of one camera at its own minimum, to which one step leads.

    `normal` (V, 12 + K, 12 + K) are its `normal_blocks` in any poses near it, such as those of a common fit,
    and `free` (5 + K,) are its parameters that move.
    """
    reduced, _ = Arrowhead.of(normal, free_columns(free), POSE_COLUMNS).reduced()
    gained = reduced[-1, :-1] @ solve_scaled(reduced[:-1, :-1], reduced[:-1, -1:], ROUNDING)[:, 0]
    return max(float(reduced[-1, -1] - np.nan_to_num(gained)), 0.0)


@frozen_dataclass(eq=False)
class RigFit:
    """A problem, and what the common bundle adjustment made of it."""

    problem: RigProblem
    free: NDArray[np.bool_]  # (n_shared,) which parameters of the cameras and the rig moved
    state: RigState
    normal: Arrowhead  # of all unknowns
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squared whitened residuals."""
        return self.normal.cost

    @property
    def variance(self) -> float:
        """Of the whitened residuals; 1 where both cameras alone leave no less."""
        equations = sum(observed.n_equations for observed in self.problem.observations)
        unknowns = int(self.free.sum()) + 6 * len(self.problem.scale)
        return self.cost / max(equations - unknowns, 1)


def scatter(fit: RigFit) -> tuple[float, int]:
    """Sum of squares of the views' poses about one rig, over that of noise, and its degrees of freedom.

    It is what the common fit leaves beyond each camera alone.
    """
    problem = fit.problem
    alone = sum(map(cost_alone, problem.own_normal, problem.estimated))
    views = sum(len(observed.view) for observed in problem.observations)
    degrees = 6 * (views - len(problem.scale)) - problem.n_rig
    return max(fit.cost - alone, 0.0), max(degrees, 0)


def is_significant(squares: float, degrees: int) -> bool:
    """Whether a sum of squares is larger than by chance: a chi-squared test at the level of 0.001.

    Examples
    --------
    >>> is_significant(70.0, 54), is_significant(100.0, 54)
    (False, True)
    """
    return degrees > 0 and bool(squares / degrees > exceeded_by_chance(degrees, _LEVEL))


def adjust_rig(problem: RigProblem, start: RigState, free: NDArray[np.bool_]) -> RigFit:
    """Minimise the reprojection error of both cameras from a start near the minimum.

    All points must be in front of their cameras at the start. `free` (n_shared,) are the parameters of the
    cameras and the rig that move; the poses always do.
    """
    shared, columns = np.flatnonzero(free), start.columns

    def linearised(state: RigState) -> tuple[_Linearised, bool]:
        normal, sensible = problem.normal(state)
        return (state, normal, normal.only(shared)), sensible

    def moved(before: _Linearised, by_shared: Array, by_own: Array) -> tuple[_Linearised, bool]:
        # Valid if all points are in front of their cameras and the distortions are monotonic.
        step = np.zeros(columns.n_shared)
        step[shared] = by_shared
        after, sensible = linearised(before[0].moved(step, by_own))
        positive = all(camera.entries[0, [0, 2]].min() > 0 for camera in after[0].cameras)
        return after, sensible and positive

    error = SharedAndOwn(linearised(start)[0], lambda at: at[2], moved)
    floor = FLOOR**2 * sum(observed.n_equations * observed.weight for observed in problem.observations)
    outcome = minimise(error, replace(OPTIONS, damping=_DAMPING), floor)
    state, normal, _ = error.state
    state = replace(state, R=orthonormalised(state.R), view_R=orthonormalised(state.view_R))
    return RigFit(problem, free, state, normal, int(outcome.iterations[0]), bool(outcome.settled[0]))

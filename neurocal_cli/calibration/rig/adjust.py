"""Bundle adjustment of two cameras on one rig: the reprojection error (3), its derivatives and its minimum.

A view of both cameras has one pose, in the left camera's frame. Its pose in the right camera is R'_k = R R_k
and t'_k = R t_k + t. A view of one camera alone has the pose in that camera and does not determine the rig.
The derivatives of each camera are those of `adjustment.reprojection`. Those of the right camera are
transformed by the chain rule:

    R -> exp(w) R,  t -> t + tau,  R_k -> exp(w_k) R_k,  t_k -> t_k + tau_k   give
    w' = w + R w_k,  tau' = w x (R t_k) + R tau_k + tau

`rig_problem` makes one normalised problem of two calibrations, with common frames of the views.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import FLOOR, OPTIONS
from neurocal_cli.adjustment.common_noise import weighed
from neurocal_cli.adjustment.levenberg_marquardt import minimise
from neurocal_cli.adjustment.normal_equations import SharedAndOwn
from neurocal_cli.adjustment.reprojection import POSE, camera_columns, normal_blocks
from neurocal_cli.adjustment.views import PointBatches, Views, batches_of
from neurocal_cli.calibration.calibration import Calibration, estimated_parameters
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.calibration.rig.pairing import ViewPairs
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, median, orthonormalised, rotation_step
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState

_Linearised = tuple["RigState", Array]  # a state and its normal matrices
_DAMPING = 1e-6  # each camera was adjusted alone before, so the first step is nearly undamped
# Smaller noise, as a share of the other camera's and in normalised pixels, is rounding in data without noise;
# test_without_noise_the_truth_comes_back checks such data.
_LEAST_SHARE = 1e-3
_LEAST_NOISE = 1e-12


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
class Columns:
    """Columns of the unknowns in the normal matrices: A's entries and coefficients, and steps w, tau."""

    left: NDArray[np.intp]  # (5 + K,)
    right: NDArray[np.intp]
    rig: NDArray[np.intp]  # (6,)
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


@frozen_dataclass(eq=False)
class RigState:
    """Two cameras, the rig X_right = R X_left + t, and the poses Xc / scale = R_k local + t_k; normalised."""

    cameras: tuple[CameraState, CameraState]  # only their entries and distortion are used
    R: Array  # (3, 3)
    t: Array  # (3,) in units of `RigProblem.unit`
    view_R: Array  # (V, 3, 3) of each frame, in the left camera or, for its single views, in the right one
    view_t: Array  # (V, 3)

    @cached_property
    def columns(self) -> Columns:
        """Columns of the unknowns for the distortion models of both cameras."""
        ends = np.cumsum([0, *(5 + len(camera.k) for camera in self.cameras), 6, 6])
        return Columns(*(np.arange(a, b) for a, b in pairwise(ends.tolist())))

    def moved(self, shared: Array, own: Array) -> RigState:
        """The state after a step: shared (columns.n_shared,), own (V, 6)."""
        left, right = (
            replace(camera, entries=camera.entries + shared[None, place[:5]], k=camera.k + shared[place[5:]])
            for camera, place in zip(self.cameras, self.columns.cameras, strict=True)
        )
        w, tau = np.split(shared[self.columns.rig], 2)
        return RigState(
            (left, right),
            rotation_step(w) @ self.R,
            self.t + tau,
            rotation_step(own[:, :3]) @ self.view_R,
            self.view_t + own[:, 3:],
        )


@frozen_dataclass(eq=False)
class RigProblem:
    """Observations of both cameras in common frames, and the poses in each camera alone.

    The V frames are those of the left camera's views, in their order, then of the views of the right camera
    alone. P of them are paired. Tuples of two are of the left and of the right camera.
    """

    calibrations: tuple[Calibration, Calibration]  # each camera alone
    names: tuple[tuple[str, ...], tuple[str, ...]]  # views of each camera, in the order of its observations
    centre: Array  # (V, 3) world = centre + scale * local
    scale: Array  # (V,)
    unit: float  # of the rig's translation [world unit]
    observations: tuple[Observations, Observations]
    cameras: tuple[CameraState, CameraState]  # as calibrated alone, with the poses of the views
    own_normal: tuple[Array, Array]  # (V_c, 12 + K, 12 + K) whitened `normal_blocks` in each camera alone
    paired: NDArray[np.intp]  # (P,) frames of both cameras
    paired_right: NDArray[np.intp]  # (P,) their indices among the right camera's views
    # (P, 5, 3) local: the target's centre, and points one rms extent from it along its two longest axes.
    spread: Array
    axes: Array  # (P, 3, 3) principal axes of the target as columns, the longest first
    flat: NDArray[np.bool_]  # (P,)

    @property
    def estimated(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """`estimated_parameters` of the left and of the right camera."""
        left, right = self.calibrations
        return estimated_parameters(left), estimated_parameters(right)

    @property
    def estimated_shared(self) -> NDArray[np.bool_]:
        """(n_shared,) which unknowns that all views share are estimated; the six of the rig always are."""
        return np.concatenate([*self.estimated, np.ones(6, dtype=bool)])

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Left and right names of the paired views."""
        left, right = self.names
        return [(left[a], right[b]) for a, b in zip(self.paired, self.paired_right, strict=True)]

    def start(self, rig: Pose) -> RigState:
        """The calibrated cameras with the left one's poses, and the right one's for its single views."""
        left, right = self.cameras
        R = np.concatenate([left.R, np.zeros((len(self.scale) - len(left.R), 3, 3))])
        t = np.concatenate([left.t, np.zeros((len(R) - len(left.t), 3))])
        view = self.observations[1].view
        alone = view >= len(left.R)
        R[view[alone]], t[view[alone]] = right.R[alone], right.t[alone]
        return RigState(self.cameras, rig.R.copy(), rig.t / self.unit, R, t)

    def camera(self, state: RigState, side: int) -> CameraState:
        """One camera with the poses of its own views."""
        view = self.observations[side].view
        R, t = state.view_R[view], state.view_t[view]
        if side == 1:
            both = (view < len(self.names[0]))[:, None]
            baseline = state.t * (self.unit / self.scale[view])[:, None]
            R, t = np.where(both[..., None], state.R @ R, R), np.where(both, t @ state.R.T + baseline, t)
        return replace(state.cameras[side], R=R, t=t)

    def world_poses(self, state: RigState, side: int) -> tuple[Array, Array]:
        """(V_c, 3, 3) and (V_c, 3) poses of one camera's views in this camera, in world units."""
        view, camera = self.observations[side].view, self.camera(state, side)
        turned = (camera.R @ self.centre[view][..., None])[..., 0]
        return camera.R, camera.t * self.scale[view][:, None] - turned

    def normal(self, state: RigState) -> tuple[Array, bool]:
        """Products of derivatives and whitened residuals, summed over each view's points in both cameras.

        Returns (V, D, D) matrices in the order of the columns, and whether all points are in front of their
        cameras, where the distortions are monotonic.
        """
        D = state.columns.width
        normal, sensible = np.zeros((len(self.scale), D, D)), True
        for side, observed in enumerate(self.observations):
            blocks, fine = normal_blocks(observed.batches, self.camera(state, side))
            T = self.jacobian(state, side)
            normal[observed.view] += observed.weight * (np.swapaxes(T, 1, 2) @ blocks @ T)
            sensible = sensible and bool(fine.all())
        return normal, sensible

    def jacobian(self, state: RigState, side: int) -> Array:
        """Derivatives of the columns of one camera by the columns of the rig, (V_c, 12 + K, D)."""
        columns, views = state.columns, self.observations[side].view
        place = columns.cameras[side]
        own = camera_columns(len(place) - 5)
        T = np.zeros((len(views), len(own) + 7, columns.width))
        T[:, own, place] = 1.0
        T[:, -1, -1] = 1.0
        pose = np.arange(POSE.start, POSE.stop)
        through = (views < len(self.names[0])) & (side == 1)
        alone, which = np.flatnonzero(~through), np.flatnonzero(through)[:, None, None]
        T[alone[:, None], pose, columns.pose] = 1.0
        view = views[through]
        by_rig, by_pose = steps_through(state.R, state.view_t[view] @ state.R.T, self.unit / self.scale[view])
        T[which, pose[:, None], columns.rig] = by_rig
        T[which, pose[:, None], columns.pose] = by_pose
        return T


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


def rig_problem(left: Calibration, right: Calibration, views: ViewPairs) -> RigProblem:
    """Combine two calibrations with one world unit."""
    cameras = left, right
    # Covariances of the points count as far as the residuals confirm them.
    arranged = [weighed(camera.points, evaluate_camera(camera).residuals) for camera in cameras]
    names = arranged[0].names, arranged[1].names
    place = {b: names[0].index(a) for a, b in views.both}
    n_left = len(names[0])
    frame = np.array([place.get(name, -1) for name in names[1]])
    alone, paired_right = np.flatnonzero(frame < 0), np.flatnonzero(frame >= 0)
    paired = frame[paired_right]
    frame[alone] = n_left + np.arange(len(alone))
    centre = np.concatenate([arranged[0].centre, arranged[1].centre[alone]])
    scale = np.concatenate([arranged[0].scale, arranged[1].scale[alone]])
    sides = [
        _side(camera, own, centre[which], scale[which], which)
        for camera, own, which in zip(cameras, arranged, (np.arange(n_left), frame), strict=True)
    ]
    seen, states, normals, noise = zip(*sides, strict=True)
    real = [observed.pixel_scale * s for observed, s in zip(seen, noise, strict=True)]
    weights = [
        1.0 / (s * max(1.0, _LEAST_SHARE * max(real) / own)) ** 2 for s, own in zip(noise, real, strict=True)
    ]
    first = arranged[0]
    along = first.basis[paired] * first.extent[paired][:, None, :]  # (P, 3, axis)
    long, across = along[:, :, 0], along[:, :, 1]
    return RigProblem(
        calibrations=cameras,
        names=names,
        centre=centre,
        scale=scale,
        unit=float(median(scale)),
        observations=(replace(seen[0], weight=weights[0]), replace(seen[1], weight=weights[1])),
        cameras=(states[0], states[1]),
        own_normal=(weights[0] * normals[0], weights[1] * normals[1]),
        paired=paired,
        paired_right=paired_right,
        spread=np.stack([np.zeros_like(long), long, -long, across, -across], axis=1),
        axes=first.basis[paired],
        flat=first.nearly_flat[paired],
    )


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
    )
    normal = normal_blocks(batches, state)[0]
    spare = views.n_equations - int(free_parameters(calibration).sum()) - 6 * views.n_views
    noise = max(float(np.sqrt(normal[:, -1, -1].sum() / max(spare, 1))), _LEAST_NOISE)
    observed = Observations(batches, frame, views.pixel_centre, views.pixel_scale, 1.0, views.n_equations)
    return observed, state, normal, noise


@frozen_dataclass(eq=False)
class RigFit:
    """A problem, and what the common bundle adjustment made of it."""

    problem: RigProblem
    free: NDArray[np.bool_]  # (n_shared,) which parameters of the cameras and the rig moved
    state: RigState
    normal: Array  # (V, D, D) from `RigProblem.normal`
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.normal[:, -1, -1].sum())

    @property
    def variance(self) -> float:
        """Of the whitened residuals; 1 where both cameras alone leave no less."""
        equations = sum(observed.n_equations for observed in self.problem.observations)
        unknowns = int(self.free.sum()) + 6 * len(self.problem.scale)
        return self.cost / max(equations - unknowns, 1)


def adjust_rig(problem: RigProblem, start: RigState, free: NDArray[np.bool_]) -> RigFit:
    """Minimise the reprojection error of both cameras from a start near the minimum.

    All points must be in front of their cameras at the start. `free` (n_shared,) are the parameters of the
    cameras and the rig that move; the poses always do.
    """
    shared, columns = np.flatnonzero(free), start.columns

    def moved(before: _Linearised, by_shared: Array, by_own: Array) -> tuple[_Linearised, bool]:
        # Valid if all points are in front of their cameras and the distortions are monotonic.
        step = np.zeros(columns.n_shared)
        step[shared] = by_shared
        state = before[0].moved(step, by_own)
        normal, sensible = problem.normal(state)
        positive = all(camera.entries[0, [0, 2]].min() > 0 for camera in state.cameras)
        return (state, normal), sensible and positive

    at_start = start, problem.normal(start)[0]
    error = SharedAndOwn(at_start, lambda at: at[1], moved, shared, columns.pose)
    floor = FLOOR**2 * sum(observed.n_equations * observed.weight for observed in problem.observations)
    outcome = minimise(error, replace(OPTIONS, damping=_DAMPING), floor)
    state, normal = error.state
    state = replace(state, R=orthonormalised(state.R), view_R=orthonormalised(state.view_R))
    return RigFit(problem, free, state, normal, int(outcome.iterations[0]), bool(outcome.settled[0]))

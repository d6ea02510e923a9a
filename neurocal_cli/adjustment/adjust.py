"""Bundle adjustment: minimise the reprojection error (3) with exact rotations.

    E = sum_k sum_i |m_ki - pi(A (R_k M_i + t_k))|^2

The unknowns are the free entries of A and the distortion coefficients, shared by all views, and one pose for
each view. Rotations are updated as R -> exp(omega) R, so they stay rotations. `levenberg_marquardt`
runs the descent. Views that share unknowns form one group; its poses are eliminated view by view (Schur
complement), so the work grows linearly with the number of views. Views that share nothing are a group each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, minimise
from neurocal_cli.adjustment.normal_equations import Arrowhead, damped_step
from neurocal_cli.adjustment.reprojection import POSE, POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.adjustment.views import PointBatches
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, orthonormalised
from neurocal_cli.camera.state import CameraState

# A share of 1e-9 of the cost is 2e-4 standard deviations of one of ten unknowns for a thousand equations.
# test_adjust.py holds the minimum against SciPy's.
OPTIONS = DescentOptions(damping=1e-4, tolerance=1e-9, flat=1e-6, max_iterations=200)
NEARBY = 30
"""Most steps to a minimum that is near: of the same camera for other data, or with other unknowns."""
FLOOR = 1e-13  # rms in normalised pixels that rounding alone can cause

# Extra equations on the shared camera, such as a prior: Jacobian (m, 5 + K) and residuals (m,).
Penalty = Callable[[CameraState], tuple[Array, Array]]


@frozen_dataclass(eq=False)
class Adjusted:
    """Result of `adjust`."""

    state: CameraState
    normal: Array  # (V, 12 + K, 12 + K) from `reprojection.normal_blocks`
    cost: Array  # (V,) sum of squared (whitened) residuals of each view
    iterations: int
    # Whether each independent problem converged; a single value if all views are one problem.
    each_settled: NDArray[np.bool_]
    # Sum of squared (whitened) residuals of all views at the start, with the penalty's.
    before: float = np.nan
    second: SecondPoses | None = None  # if they have been looked for

    @property
    def converged(self) -> bool:
        """Whether all problems converged."""
        return bool(self.each_settled.all())

    def of_views(self, which: NDArray[np.bool_]) -> Adjusted:
        """Some of the views, if each is a problem of its own."""
        state = replace(self.state, R=self.state.R[which], t=self.state.t[which])
        return Adjusted(
            state, self.normal[which], self.cost[which], self.iterations, self.each_settled[which]
        )


@frozen_dataclass(eq=False)
class SecondPoses:
    """Flat targets tilted the other way that fit nearly as well, with the camera as it is."""

    at: CameraState  # the camera and the first poses
    views: NDArray[np.intp]  # (n,)
    posed: Adjusted  # of these views


def adjust(
    batches: PointBatches,
    start: CameraState,
    free: NDArray[np.bool_],
    free_pose: bool = True,
    max_iterations: int = OPTIONS.max_iterations,
    penalty: Penalty | None = None,
    damping: float = OPTIONS.damping,
) -> Adjusted:
    """Minimise the reprojection error (3) from a start near the minimum.

    At the start, all points must lie in front of the camera. `free` (5 + K,) tells which entries of A and
    distortion coefficients are estimated. If none is, or if each view has its own camera, the views are
    independent problems, solved side by side, each with its own damping. The penalty gives extra residuals on
    the shared camera, whose squares are added to those of the pixels; the result's `normal` and `cost`
    contain the pixels alone. Less `damping` at the start saves steps from a start close to the minimum.
    """
    problem = _Reprojection(batches, start, free, free_pose, penalty)
    options = replace(OPTIONS, max_iterations=max_iterations, damping=damping)
    before = float(problem.normal[:, -1, -1].sum())
    outcome = minimise(problem, options, problem.by_group(2.0 * FLOOR**2 * batches.counts.astype(float)))
    state, normal = replace(problem.state, R=orthonormalised(problem.state.R)), problem.normal
    if penalty is not None:
        normal, _ = normal_blocks(batches, problem.state)
    iterations = int(outcome.iterations.max())
    return Adjusted(state, normal, normal[:, -1, -1].copy(), iterations, outcome.settled, before)


_Step = tuple[Array, Array]  # of the cameras (1 or V, 5 + K) and of the poses (V, 6)
_Trial = tuple[CameraState, Array]  # a state and its normal matrices


class _Reprojection:
    """The reprojection error as a `LeastSquaresProblem`.

    All views together are one group if they share unknowns; otherwise each view is a group.
    """

    def __init__(
        self,
        batches: PointBatches,
        start: CameraState,
        free: NDArray[np.bool_],
        free_pose: bool,
        penalty: Penalty | None,
    ) -> None:
        self.batches, self.state, self.penalty = batches, start, penalty
        # Columns of the camera's parameters, and indices of the free ones among them.
        self.camera = camera_columns(start.k.shape[-1])
        self.free, self.free_pose = np.flatnonzero(free), free_pose
        self.shared = self.camera[self.free]
        self.columns = np.concatenate([self.shared, POSE_COLUMNS]) if free_pose else self.shared
        self.together = len(start.entries) == 1 and bool(self.free.size) and batches.n_views > 1
        self.normal, _ = self._blocks(start)

    @property
    def cost(self) -> Array:
        """Sum of squares of each group."""
        return self.by_group(self.normal[:, -1, -1])

    def by_group(self, by_view: Array) -> Array:
        """Sums over the views of each group."""
        return by_view.sum(keepdims=True) if self.together else by_view

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[_Step, Array]:
        """Steps of the cameras and the poses, and their predicted gains."""
        if not self.together:
            return self._solve_apart(self.normal, damping, active)
        own = POSE_COLUMNS if self.free_pose else POSE_COLUMNS[:0]
        step, by_own, gain = Arrowhead.of(self.normal, self.shared, own).step(float(damping[0]))
        by_camera, by_pose = np.zeros((1, len(self.camera))), np.zeros((self.batches.n_views, 6))
        by_camera[0, self.free], by_pose[:, : len(own)] = step, by_own
        return (by_camera, by_pose), np.array([gain])

    def move(self, step: _Step, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """The state after a step, its costs, and whether it is valid.

        A state is valid if all points lie in front of their cameras, where the distortion is monotonic.
        """
        trial = self.state.moved(*step)
        normal, by_view = self._blocks(trial)
        sensible = np.array([by_view.all()]) if self.together else by_view
        sensible &= (trial.entries[:, [0, 2]] > 0).all(axis=1)
        cost = self.by_group(normal[:, -1, -1])
        if len(active) < len(cost):
            cost, sensible = cost[active], sensible[active]
        return (trial, normal), cost, sensible

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial for the groups that improved."""
        if not better.any():
            return
        state, normal = trial
        if better.all() and (self.together or len(active) == len(self.normal)):
            self.state, self.normal = state, normal
            return
        views, old = active[better], self.state
        R, t = old.R.copy(), old.t.copy()
        R[views], t[views] = state.R[views], state.t[views]
        entries, k = old.entries, old.k
        if len(entries) > 1:
            entries = entries.copy()
            entries[views] = state.entries[views]
        if k.ndim > 1:
            k = k.copy()
            k[views] = state.k[views]
        self.state = replace(old, entries=entries, R=R, t=t, k=k)
        self.normal[views] = normal[views]

    def _blocks(self, state: CameraState) -> tuple[Array, NDArray[np.bool_]]:
        normal, sensible = normal_blocks(self.batches, state)
        if self.penalty is not None:
            by_camera, missing = self.penalty(state)
            rows = np.zeros((len(missing), normal.shape[-1]))
            rows[:, self.camera], rows[:, -1] = by_camera, missing
            normal[0] += rows.T @ rows  # any view will do, because all share the camera
        return normal, sensible

    def _solve_apart(self, N: Array, damping: Array, active: NDArray[np.intp]) -> tuple[_Step, Array]:
        """Steps of groups with unknowns of their own; groups that have ended do not move."""
        columns, moving = self.columns, N if len(active) == len(N) else N[active]
        H, g = moving[:, columns[:, None], columns], moving[:, columns, -1]
        step, promised = damped_step(H, g, damping)
        whole = np.zeros((len(N), N.shape[1]))
        whole[active[:, None], columns] = step
        by_camera = whole[:, self.camera] if self.free.size else np.zeros((1, len(self.camera)))
        return (by_camera, whole[:, POSE]), promised

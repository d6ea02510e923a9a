"""The last step of training: the true pixel error (3), with exact rotations.

    E = sum_k sum_i |m_ki - pi(A (R_k M_i + t_k))|^2

over the free entries of A and the lens's coefficients, shared by all views, and one pose for each
view. Rotations move by R -> exp(omega) R, so they stay rotations. Levenberg-Marquardt; the poses
are eliminated view by view (Schur complement), so the cost grows linearly with the views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.point_batches import PointBatches
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, camera_columns, normal_blocks
from neurocal_cli.geometry import Array, orthonormalised
from neurocal_cli.least_squares.schur_complement import schur_step, solve_scaled

__all__ = ["Adjusted", "Restraint", "adjust"]

_TOLERANCE = 1e-9  # a step that would lower E by a smaller share is the last
_FLOOR = 1e-13  # rms in normalised pixels that rounding alone accounts for
_LARGEST_DAMPING = 1e10
_FLAT_SHARE = 1e-6  # a rejected step that promised less than this share: the bottom


# Equations on the camera beside those of the points: derivatives (m, 5 + K), and what is missing (m,).
Restraint = Callable[[CameraState], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Result of `adjust`.

    Attributes
    ----------
    state : CameraState
    normal : (V, 12 + K, 12 + K) array
        From `pixel_error.normal_blocks`.
    cost : (V,) array
        Sum of squared (whitened) residuals of each view.
    iterations : int
    each_settled : bool array
        Whether it converged: of each independent problem, or one for all views together.
    """

    state: CameraState
    normal: Array
    cost: Array
    iterations: int
    each_settled: NDArray[np.bool_]

    @property
    def converged(self) -> bool:
        """Whether all did."""
        return bool(self.each_settled.all())


def adjust(
    batches: PointBatches,
    start: CameraState,
    free: NDArray[np.bool_],
    free_pose: bool = True,
    max_iterations: int = 200,
    restraint: Restraint | None = None,
) -> Adjusted:
    """Minimise the pixel error (3) from a start that is already near.

    Parameters
    ----------
    batches : PointBatches
    start : CameraState
        With all points in front of the camera.
    free : (5 + K,) bool array
        Which entries of A and coefficients of the lens move. With none free, or with a camera for
        each view, the views are independent problems, solved side by side, each with its own damping.
    free_pose : bool
        Whether the poses move.
    max_iterations : int
    restraint : callable, optional
        Of a camera that is shared: squares to be added to those of the pixels; the result's `normal` and
        `cost` are of the pixels alone.
    """
    descent = _Descent(batches, start, free, free_pose, restraint)
    iterations = 0
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        while iterations < max_iterations and not descent.done.all():
            descent.step()
            iterations += 1
    state, normal = replace(descent.state, R=orthonormalised(descent.state.R)), descent.normal
    if restraint is not None:
        normal, _ = normal_blocks(batches, descent.state)
    return Adjusted(state, normal, normal[:, -1, -1].copy(), iterations, descent.settled)


class _Descent:
    """Levenberg-Marquardt over groups: all views together when they share what is sought, else one each."""

    def __init__(
        self,
        batches: PointBatches,
        start: CameraState,
        free: NDArray[np.bool_],
        free_pose: bool,
        restraint: Restraint | None,
    ) -> None:
        self.batches, self.state, self.restraint = batches, start, restraint
        # Columns of the free camera parameters, and their places among all of them.
        self.camera = camera_columns(start.k.shape[-1])
        self.free, self.free_pose = np.flatnonzero(free), free_pose
        self.together = len(start.entries) == 1 and bool(self.free.size) and batches.n_views > 1
        groups = 1 if self.together else batches.n_views
        self.normal, _ = self._blocks(start)
        self.cost = self._by_group(self.normal[:, -1, -1])
        self.damping = np.full(groups, 1e-4)
        self.growth = np.full(groups, 2.0)
        self.floor = self._by_group(batches.counts * 2.0 * _FLOOR**2)
        self.settled = self.cost <= self.floor
        self.done = self.settled.copy()

    def _blocks(self, state: CameraState) -> tuple[Array, NDArray[np.bool_]]:
        normal, sensible = normal_blocks(self.batches, state)
        if self.restraint is not None:
            by_camera, missing = self.restraint(state)
            rows = np.zeros((len(missing), normal.shape[-1]))
            rows[:, self.camera], rows[:, -1] = by_camera, missing
            normal[0] += rows.T @ rows  # of any view: the camera is that of all
        return normal, sensible

    def _by_group(self, by_view: NDArray[Any]) -> Array:
        return by_view.sum(keepdims=True) if self.together else by_view

    def step(self) -> None:
        """One step of every group that is not done; the others stay."""
        by_camera, by_pose, predicted = self._solve()
        trial = self.state.moved(by_camera, by_pose)
        normal, by_view = self._blocks(trial)
        sensible = by_view.all(keepdims=True) if self.together else by_view
        sensible = sensible & (trial.entries[:, [0, 2]] > 0).all(axis=1)
        after = self._by_group(normal[:, -1, -1])
        better = sensible & (after < self.cost) & ~self.done
        small = predicted < _TOLERANCE * self.cost
        stuck = ~better & (self.damping > _LARGEST_DAMPING)
        bottom = ~better & sensible & (predicted < _FLAT_SHARE * self.cost)
        ratio = (self.cost - after) / predicted
        self._accept(trial, normal, after, better)
        settled = (better & small) | bottom | (self.cost <= self.floor)
        self.settled |= settled & ~self.done
        self.done |= settled | stuck
        gained = np.minimum(2 * ratio - 1, 2.0)
        shrink = np.maximum(0.01, 1 - gained * gained * gained)
        self.damping = np.maximum(self.damping * np.where(better, shrink, self.growth), 1e-14)
        self.growth = np.where(better, 2.0, 2 * self.growth)

    def _accept(self, trial: CameraState, normal: Array, cost: Array, better: NDArray[np.bool_]) -> None:
        if better.all():
            self.state, self.normal, self.cost = trial, normal, cost
        elif better.any():
            keep, old = better[:, None, None], self.state
            entries = old.entries
            if len(entries) > 1:
                entries = np.where(better[:, None], trial.entries, entries)
            R = np.where(keep, trial.R, old.R)
            t = np.where(better[:, None], trial.t, old.t)
            self.state = replace(old, entries=entries, R=R, t=t)
            self.normal = np.where(keep, normal, self.normal)
            self.cost = np.where(better, cost, self.cost)

    def _solve(self) -> tuple[Array, Array, Array]:
        """Steps of the camera (1 or V, 5 + K) and poses (V, 6), and what each group should gain."""
        if not self.together:
            return self._solve_apart(self.normal)
        if not self.free_pose:
            by_camera, _, predicted = self._solve_apart(self.normal.sum(axis=0, keepdims=True))
            return by_camera, np.zeros((self.batches.n_views, 6)), predicted
        return self._solve_together()

    def _solve_apart(self, N: Array) -> tuple[Array, Array, Array]:
        """Each group has its own unknowns."""
        pose = np.arange(POSE.start, POSE.stop) if self.free_pose else np.arange(0)
        columns = np.concatenate([self.camera[self.free], pose])
        H, g = N[:, columns[:, None], columns], N[:, columns, -1]
        ridge = self.damping[:, None] * (np.diagonal(H, axis1=1, axis2=2) + 1e-300)
        H[:, range(len(columns)), range(len(columns))] += ridge
        step = solve_scaled(H, g[..., None])[..., 0]
        predicted = (step * (g + ridge * step)).sum(axis=1)
        step[self.done] = 0.0
        whole = np.zeros((len(N), N.shape[1]))
        whole[:, columns] = step
        by_camera = whole[:, self.camera] if self.free.size else np.zeros((1, len(self.camera)))
        return by_camera, whole[:, POSE], predicted

    def _solve_together(self) -> tuple[Array, Array, Array]:
        """One A, a pose for each view: the poses are eliminated by the Schur complement."""
        own = np.arange(POSE.start, POSE.stop)
        damping = float(self.damping[0])
        step, by_pose, gain = schur_step(self.normal, self.camera[self.free], own, damping)
        by_camera = np.zeros((1, len(self.camera)))
        by_camera[0, self.free] = step
        return by_camera, by_pose, np.array([gain])

"""The last step of training: the true pixel error (3), with exact rotations.

    E = sum_k sum_i |m_ki - pi(A (R_k M_i + t_k))|^2

over the free entries of A, shared by all views, and one pose for each view. Rotations move by
R -> exp(omega) R, so they stay rotations. Levenberg-Marquardt; the poses are eliminated view by
view (Schur complement), so the cost grows linearly with the views.

All quantities are normalised: pixels by S1, the world by each view's own S2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array, orthonormalised, rotation_step
from neurocal_cli.tiles import Tiles

__all__ = ["ENTRIES", "CameraState", "Refined", "normal_blocks", "refine"]

# Rows and columns of A's free entries, in the order of every vector of intrinsics here:
# A11, A12, A22, A13, A23.
ENTRIES = (np.array([0, 0, 1, 0, 1]), np.array([0, 1, 1, 2, 2]))

_N = 5  # intrinsic entries, the first columns of the derivatives
_POSE = slice(_N, _N + 6)  # omega, tau
_R = _N + 6  # the residual, the last column
_TOLERANCE = 1e-9  # a step that would lower E by a smaller share is the last
_FLOOR = 1e-13  # rms in normalised pixels that rounding alone accounts for
_LARGEST_DAMPING = 1e10
_FLAT_SHARE = 1e-6  # a rejected step that promised less than this share: the bottom


@dataclass(frozen=True, eq=False)
class CameraState:
    """Intrinsics and poses in normalised units.

    Attributes
    ----------
    entries : (1, 5) or (V, 5) array
        A11, A12, A22, A13, A23 of the camera that all views share, or of a camera for each.
    R : (V, 3, 3) array
    t : (V, 3) array
    """

    entries: Array
    R: Array
    t: Array

    def moved(self, by_entries: Array, by_pose: Array) -> CameraState:
        """The state after a step; by_pose (V, 6) holds omega and tau."""
        return CameraState(
            self.entries + by_entries, rotation_step(by_pose[:, :3]) @ self.R, self.t + by_pose[:, 3:]
        )


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of `refine`.

    Attributes
    ----------
    state : CameraState
    normal : (V, 12, 12) array
        Products of the columns (5 entries, 6 pose, residual) summed over each view's points.
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


def refine(
    tiles: Tiles,
    start: CameraState,
    free: NDArray[np.bool_],
    free_pose: bool = True,
    max_iterations: int = 200,
) -> Refined:
    """Minimise the pixel error (3) from a start that is already near.

    Parameters
    ----------
    tiles : Tiles
    start : CameraState
        With all points in front of the camera.
    free : (5,) bool array
        Which entries of A move. With none free, or with a camera for each view, the views are
        independent problems, solved side by side, each with its own damping.
    free_pose : bool
        Whether the poses move.
    max_iterations : int
    """
    descent = _Descent(tiles, start, free, free_pose)
    iterations = 0
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        while iterations < max_iterations and not descent.done.all():
            descent.step()
            iterations += 1
    state = descent.state
    state = CameraState(state.entries, orthonormalised(state.R), state.t)
    normal = descent.normal
    return Refined(state, normal, normal[:, _R, _R].copy(), iterations, descent.settled)


def normal_blocks(tiles: Tiles, state: CameraState) -> tuple[Array, NDArray[np.bool_]]:
    """Products of derivatives and residuals summed over each view's points.

    Returns
    -------
    normal : (V, 12, 12) array
        Columns: by A11, A12, A22, A13, A23, omega (3), tau (3), and the residual.
    in_front : (V,) bool array
        Whether all the view's points have positive depth.
    """
    n_tiles, n = len(tiles.view), tiles.local.shape[2]
    by_tile = np.empty((n_tiles, _R + 1, _R + 1))
    in_front = np.empty(n_tiles, dtype=bool)
    buffer: Array | None = None
    for chunk in tiles.chunks():
        view = tiles.view[chunk]
        if buffer is None or len(buffer) != len(view):
            buffer = np.zeros((len(view), _R + 1, 2, n))
        whitening = None if tiles.whitening is None else tiles.whitening[chunk]
        in_front[chunk] = _derivatives(
            tiles.local[chunk],
            tiles.pixels[chunk],
            whitening,
            state.entries if len(state.entries) == 1 else state.entries[view],
            state.R[view],
            state.t[view],
            buffer,
        )
        J = buffer.reshape(len(view), _R + 1, 2 * n)
        np.matmul(J, np.swapaxes(J, 1, 2), out=by_tile[chunk])
    if n_tiles == tiles.n_views:
        return by_tile, in_front
    return tiles.sum_by_view(by_tile), np.logical_and.reduceat(in_front, tiles.first)


def _derivatives(
    local: Array, pixels: Array, whitening: Array | None, entries: Array, R: Array, t: Array, out: Array
) -> NDArray[np.bool_]:
    """Fill out (T, 12, 2, n) with the derivatives of the pixels and the residuals.

    Around the centroid, Xc = exp(omega) R M + t + tau: with Y = R M,
    d Xc = omega x Y + tau, and (x, y) = (Xc_1, Xc_2) / Xc_3.
    """
    # One camera: plain numbers are quicker than columns of one.
    a, s, b, u0, v0 = entries[0] if len(entries) == 1 else entries.T[..., None]
    Y = R @ local
    q = Y[:, 2] + t[:, 2, None]
    in_front = np.asarray(q.min(axis=1) > 0)
    np.divide(1.0, q, out=q)
    x, y = (Y[:, 0] + t[:, 0, None]) * q, (Y[:, 1] + t[:, 1, None]) * q
    Y *= q[:, None]
    Y1, Y2, Y3 = Y[:, 0], Y[:, 1], Y[:, 2]
    u, v = out[:, :, 0], out[:, :, 1]
    u[:, 0], u[:, 1], u[:, 3] = x, y, 1.0
    v[:, 2], v[:, 4] = y, 1.0
    by_omega = (-x * Y2, -Y3 - y * Y2), (Y3 + x * Y1, y * Y1), (-Y2, Y1)
    plain = np.ndim(s) == 0 and s == 0.0  # no skew, as in most cameras
    for column, (dx, dy) in zip((5, 6, 7, 10), (*by_omega, (-x * q, -y * q)), strict=True):
        np.multiply(a, dx, out=u[:, column])
        np.multiply(b, dy, out=v[:, column])
        if not plain:
            u[:, column] += s * dy
    u[:, 8], v[:, 8] = a * q, 0.0
    u[:, 9], v[:, 9] = s * q, b * q
    u[:, _R] = pixels[:, 0] - (a * x + s * y + u0)
    v[:, _R] = pixels[:, 1] - (b * y + v0)
    if whitening is not None:
        # The buffer is used again: entries that stay 0 above must be 0 before whitening mixes rows.
        u[:, 2] = u[:, 4] = v[:, 0] = v[:, 1] = v[:, 3] = 0.0
        v_rows = v * whitening[:, None, 2]
        u *= whitening[:, None, 0]
        u += v * whitening[:, None, 1]
        v[...] = v_rows
    return in_front


class _Descent:
    """Levenberg-Marquardt over groups: all views together when they share what is sought, else one each."""

    def __init__(self, tiles: Tiles, start: CameraState, free: NDArray[np.bool_], free_pose: bool) -> None:
        self.tiles, self.state = tiles, start
        self.free, self.free_pose = np.flatnonzero(free), free_pose
        self.together = len(start.entries) == 1 and bool(self.free.size) and tiles.n_views > 1
        groups = 1 if self.together else tiles.n_views
        self.normal, _ = normal_blocks(tiles, start)
        self.cost = self._by_group(self.normal[:, _R, _R])
        self.damping = np.full(groups, 1e-4)
        self.growth = np.full(groups, 2.0)
        self.floor = self._by_group(tiles.counts * 2.0 * _FLOOR**2)
        self.settled = self.cost <= self.floor
        self.done = self.settled.copy()

    def _by_group(self, by_view: NDArray[Any]) -> Array:
        return by_view.sum(keepdims=True) if self.together else by_view

    def step(self) -> None:
        """One step of every group that is not done; the others stay."""
        by_entries, by_pose, predicted = self._solve()
        trial = self.state.moved(by_entries, by_pose)
        normal, in_front = normal_blocks(self.tiles, trial)
        sensible = in_front.all(keepdims=True) if self.together else in_front
        sensible = sensible & (trial.entries[:, [0, 2]] > 0).all(axis=1)
        after = self._by_group(normal[:, _R, _R])
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
            self.state = CameraState(entries, R, np.where(better[:, None], trial.t, old.t))
            self.normal = np.where(keep, normal, self.normal)
            self.cost = np.where(better, cost, self.cost)

    def _solve(self) -> tuple[Array, Array, Array]:
        """Steps of the entries (1 or V, 5) and poses (V, 6), and the decrease by group they should bring."""
        if not self.together:
            return self._solve_apart(self.normal)
        if not self.free_pose:
            by_entries, _, predicted = self._solve_apart(self.normal.sum(axis=0, keepdims=True))
            return by_entries, np.zeros((self.tiles.n_views, 6)), predicted
        return self._solve_together()

    def _solve_apart(self, N: Array) -> tuple[Array, Array, Array]:
        """Each group has its own unknowns."""
        pose = np.arange(_N, _R) if self.free_pose else np.arange(0)
        columns = np.concatenate([self.free, pose])
        H, g = N[:, columns[:, None], columns], N[:, columns, _R]
        ridge = self.damping[:, None] * (np.diagonal(H, axis1=1, axis2=2) + 1e-300)
        H[:, range(len(columns)), range(len(columns))] += ridge
        step = _solve_scaled(H, g[..., None])[..., 0]
        predicted = (step * (g + ridge * step)).sum(axis=1)
        step[self.done] = 0.0
        whole = np.zeros((len(N), _R))
        whole[:, columns] = step
        return whole[:, :_N] if self.free.size else np.zeros((1, _N)), whole[:, _N:], predicted

    def _solve_together(self) -> tuple[Array, Array, Array]:
        """One A, a pose for each view: the poses are eliminated by the Schur complement."""
        N, f, damping = self.normal, self.free, float(self.damping[0])
        total = N[:, :_N].sum(axis=0)
        U, g = total[f[:, None], f], total[f, _R]
        g_pose = N[:, _POSE, _R]
        ridge = damping * (np.diagonal(U) + 1e-300)
        B = N[:, _POSE, _POSE].copy()
        ridge_pose = damping * (np.diagonal(B, axis1=1, axis2=2) + 1e-300)
        B[:, range(6), range(6)] += ridge_pose
        C = N[:, f, _POSE]  # (V, f, 6)
        solved = _solve_scaled(B, np.concatenate([np.swapaxes(C, 1, 2), g_pose[..., None]], axis=2))
        # (f, 6 V) times (6 V, f + 1): one product sums over views and poses.
        flat_C = np.swapaxes(C, 0, 1).reshape(len(f), -1)
        eliminated = flat_C @ solved.reshape(-1, len(f) + 1)
        S = U + np.diag(ridge) - eliminated[:, :-1]
        step = _solve_scaled(S, (g - eliminated[:, -1])[:, None])[:, 0]
        by_pose = solved[:, :, -1] - solved[:, :, :-1] @ step
        gain = (by_pose * (g_pose + ridge_pose * by_pose)).sum() + step @ (g + ridge * step)
        by_entries = np.zeros((1, _N))
        by_entries[0, f] = step
        return by_entries, by_pose, np.array([gain])


def _solve_scaled(H: Array, rhs: Array) -> Array:
    """Solve symmetric systems scaled to a unit diagonal; a singular one yields nan."""
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(H, axis1=-2, axis2=-1)) + 1e-300)
    scaled = H * scale[..., :, None] * scale[..., None, :]
    try:
        return scale[..., :, None] * np.linalg.solve(scaled, scale[..., :, None] * rhs)
    except np.linalg.LinAlgError:
        return np.full(rhs.shape, np.nan)

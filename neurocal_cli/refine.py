"""The last step of training: the true pixel error (3), with exact rotations.

    E = sum_k sum_i |m_ki - pi(A (R_k M_i + t_k))|^2

over the free entries of A, shared by all views, and one pose for each view. Rotations move by
R -> exp(omega) R, so they stay rotations. Levenberg-Marquardt; the poses are eliminated view by
view (Schur complement), so the cost grows linearly with the views.

All quantities are normalised: pixels by S1, the world by each view's own S2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array, nearest_rotation, rotation_exp
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
    entries : (5,) array
        A11, A12, A22, A13, A23.
    R : (V, 3, 3) array
    t : (V, 3) array
    """

    entries: Array
    R: Array
    t: Array

    def moved(self, by_entries: Array, by_pose: Array) -> CameraState:
        """The state after a step; by_pose (V, 6) holds omega and tau."""
        return CameraState(
            self.entries + by_entries, rotation_exp(by_pose[:, :3]) @ self.R, self.t + by_pose[:, 3:]
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
    converged : bool
    """

    state: CameraState
    normal: Array
    cost: Array
    iterations: int
    converged: bool


def refine(
    tiles: Tiles,
    start: CameraState,
    free: NDArray[np.bool_],
    free_pose: bool = True,
    max_iterations: int = 60,
) -> Refined:
    """Minimise the pixel error (3) from a start that is already near.

    Parameters
    ----------
    tiles : Tiles
    start : CameraState
        With all points in front of the camera.
    free : (5,) bool array
        Which entries of A move. With none free the views are independent problems, solved side by
        side, each with its own damping.
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
    state = CameraState(state.entries, nearest_rotation(state.R), state.t)
    normal = descent.normal
    return Refined(state, normal, normal[:, _R, _R].copy(), iterations, bool(descent.settled.all()))


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
            tiles.local[chunk], tiles.pixels[chunk], whitening, state.entries, state.R[view], state.t[view], buffer
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
    a, s, b, u0, v0 = entries
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
    rows = ((-x * Y2, -Y3 - y * Y2), (Y3 + x * Y1, y * Y1), (-Y2, Y1), (q, None), (None, q), (-x * q, -y * q))
    for column, (dx, dy) in enumerate(rows, start=_N):
        if dx is None:
            np.multiply(s, dy, out=u[:, column])
        elif dy is None:
            np.multiply(a, dx, out=u[:, column])
        elif s == 0.0:
            np.multiply(a, dx, out=u[:, column])
        else:
            np.add(a * dx, s * dy, out=u[:, column])
        if dy is not None:
            np.multiply(b, dy, out=v[:, column])
        else:
            v[:, column] = 0.0
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
    """Levenberg-Marquardt over one group (all views share A) or a group for each view."""

    def __init__(self, tiles: Tiles, start: CameraState, free: NDArray[np.bool_], free_pose: bool) -> None:
        self.tiles, self.state = tiles, start
        self.free = np.flatnonzero(free)
        self.free_pose = free_pose
        self.groups = 1 if self.free.size else tiles.n_views
        self.normal, in_front = normal_blocks(tiles, start)
        self.damping = np.full(self.groups, 1e-4)
        self.growth = np.full(self.groups, 2.0)
        self.floor = self._by_group(2.0 * tiles.counts) * _FLOOR**2
        self.settled = self.cost <= self.floor
        self.done = self.settled.copy()

    @property
    def cost(self) -> Array:
        """Cost of each group."""
        return self._by_group(self.normal[:, _R, _R])

    def _by_group(self, by_view: Array) -> Array:
        return by_view.sum(keepdims=True) if self.groups == 1 else by_view

    def step(self) -> None:
        """One step of every group that is not done; views of finished groups stay."""
        by_entries, by_pose, predicted = self._solve()
        if self.groups > 1:
            by_pose[self.done] = 0.0
        trial = self.state.moved(by_entries, by_pose)
        normal, in_front = normal_blocks(self.tiles, trial)
        sensible = in_front.all(keepdims=True) if self.groups == 1 else in_front
        if trial.entries[0] <= 0 or trial.entries[2] <= 0:
            sensible = np.zeros_like(sensible)
        before, after = self.cost, self._by_group(normal[:, _R, _R])
        better = sensible & (after < before) & ~self.done
        self._accept(trial, normal, better)
        small = predicted < _TOLERANCE * before
        stuck = ~better & (self.damping > _LARGEST_DAMPING)
        bottom = ~better & sensible & (predicted < _FLAT_SHARE * before)
        settled = (better & small) | bottom | (self.cost <= self.floor)
        self.settled |= settled & ~self.done
        self.done |= settled | stuck
        ratio = (before - after) / predicted
        shrink = np.clip(1 - np.clip(2 * ratio - 1, -1, 2) ** 3, 0.01, 2.0)
        self.damping = np.clip(self.damping * np.where(better, shrink, self.growth), 1e-14, None)
        self.growth = np.where(better, 2.0, 2 * self.growth)

    def _accept(self, trial: CameraState, normal: Array, better: NDArray[np.bool_]) -> None:
        if self.groups == 1:
            if better[0]:
                self.state, self.normal = trial, normal
            return
        keep = better[:, None, None]
        self.state = CameraState(
            self.state.entries,
            np.where(keep, trial.R, self.state.R),
            np.where(better[:, None], trial.t, self.state.t),
        )
        self.normal = np.where(keep, normal, self.normal)

    def _solve(self) -> tuple[Array, Array, Array]:
        """Step by entries (5,) and by pose (V, 6), and the decrease it should bring, by group."""
        N, f = self.normal, self.free
        damping = self.damping if self.groups > 1 else np.repeat(self.damping, len(N))
        by_entries, by_pose = np.zeros(_N), np.zeros((len(N), 6))
        g_pose = N[:, _POSE, _R]
        U = N[:, f[:, None], f].sum(axis=0)
        g = N[:, f, _R].sum(axis=0)
        U_diagonal = np.diagonal(U) + 1e-300
        if not self.free_pose:
            lam = float(self.damping[0])
            by_entries[f] = _solve_scaled(U + lam * np.diag(U_diagonal), g[:, None])[:, 0]
            gain = by_entries[f] @ g + lam * (U_diagonal * by_entries[f] ** 2).sum()
            return by_entries, by_pose, np.array([gain])
        B = N[:, _POSE, _POSE].copy()
        diagonal = np.diagonal(B, axis1=1, axis2=2) + 1e-300
        B[:, range(6), range(6)] += damping[:, None] * diagonal
        C = N[:, f[:, None], range(_N, _N + 6)]  # (V, f, 6)
        solved = _solve_scaled(B, np.concatenate([np.swapaxes(C, 1, 2), g_pose[..., None]], axis=2))
        if f.size:
            lam = float(self.damping[0])
            S = U + lam * np.diag(U_diagonal) - (C @ solved[:, :, :-1]).sum(axis=0)
            rhs = g - (C @ solved[:, :, -1:])[..., 0].sum(axis=0)
            by_entries[f] = _solve_scaled(S, rhs[:, None])[:, 0]
        by_pose = solved[:, :, -1] - solved[:, :, :-1] @ by_entries[f]
        gain = (by_pose * (g_pose + damping[:, None] * diagonal * by_pose)).sum(axis=1)
        predicted = self._by_group(gain)
        if f.size:
            lam = float(self.damping[0])
            predicted = predicted + by_entries[f] @ g + lam * (U_diagonal * by_entries[f] ** 2).sum()
        return by_entries, by_pose, predicted


def _solve_scaled(H: Array, rhs: Array) -> Array:
    """Solve symmetric systems scaled to a unit diagonal; a singular one yields nan."""
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(H, axis1=-2, axis2=-1)) + 1e-300)
    scaled = H * scale[..., :, None] * scale[..., None, :]
    try:
        return scale[..., :, None] * np.linalg.solve(scaled, scale[..., :, None] * rhs)
    except np.linalg.LinAlgError:
        return np.full(rhs.shape, np.nan)

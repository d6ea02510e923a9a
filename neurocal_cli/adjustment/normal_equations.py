"""Stacks of normal equations: solved, damped and inverted, always scaled to a unit diagonal.

With unknowns shared by all blocks (cameras) and unknowns of each block's own (the poses of views), the normal
matrix is an arrowhead: the own unknowns of different blocks are coupled only through the shared ones. The
Schur complement eliminates each block's own unknowns and leaves a small system, so the work grows linearly
with the number of blocks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

NOTHING = 1e-300  # avoids a division by 0 for a zero diagonal
ROUNDING = 1e-14  # a ridge that regularises a singular system and is negligible in a regular one
_ABSENT = 1e-30  # an eigenvalue of the scaled matrix below this counts as 0

Columns = NDArray[np.intp]
State = TypeVar("State")


def unit_diagonal(H: Array) -> tuple[Array, Array]:
    """Matrices (..., n, n) with rows and columns scaled to a unit diagonal, and the scales (..., n)."""
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(H, axis1=-2, axis2=-1)) + NOTHING)
    return H * scale[..., :, None] * scale[..., None, :], scale


def solve_scaled(H: Array, rhs: Array, ridge: float = 0.0) -> Array:
    """Solve systems H (..., n, n), rhs (..., n, m) scaled to a unit diagonal; a singular one yields nan.

    `ridge` is added to the unit diagonal; `ROUNDING` keeps undetermined unknowns finite.
    """
    scaled, scale = unit_diagonal(H)
    if ridge:
        scaled += ridge * np.eye(H.shape[-1])
    try:
        return scale[..., :, None] * np.linalg.solve(scaled, scale[..., :, None] * rhs)
    except np.linalg.LinAlgError:
        if H.ndim > 2:  # solve one by one, so that a singular system does not spoil the others
            return np.stack([solve_scaled(one, right, ridge) for one, right in zip(H, rhs, strict=True)])
        return np.full(rhs.shape, np.nan)


def damped_step(H: Array, g: Array, damping: Array) -> tuple[Array, Array]:
    """Marquardt's step (H + lambda diag H) d = g of each group, and its predicted gain.

    H (G, n, n) are the Gauss-Newton matrices J^T J, which are damped in place. g (G, n) is J^T r with
    r = observed - predicted: downhill. Returns the steps (G, n), nan where the system is singular, and the
    predicted drops of the sum of squares (G,), 2 g.d - d.H d = d.(g + lambda diag(H) d).
    """
    places = range(H.shape[1])
    ridge = damping[:, None] * (np.diagonal(H, axis1=1, axis2=2) + NOTHING)
    H[:, places, places] += ridge
    step = solve_scaled(H, g[..., None])[..., 0]
    return step, (step * (g + ridge * step)).sum(axis=1)


def inverse_scaled(H: Array, reference: Array) -> tuple[Array, float]:
    """Inverse of symmetric matrices (..., n, n), and their smallest eigenvalue in units of the reference.

    The unit is the diagonal of `reference`. The inverse is nan and the eigenvalue 0 if a matrix is singular.
    """
    scale = 1.0 / np.sqrt(np.diagonal(reference, axis1=-2, axis2=-1) + NOTHING)
    outer = scale[..., :, None] * scale[..., None, :]
    scaled = H * outer
    if not np.isfinite(scaled).all():
        return np.full_like(H, np.nan), 0.0
    values, vectors = np.linalg.eigh(scaled)
    smallest = float(values.min(initial=1.0))
    if smallest < _ABSENT:
        return np.full_like(H, np.nan), 0.0
    inverse = (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return inverse * outer, smallest


def eliminate(N: Array, kept: Columns, own: Columns, ridge: float = 0.0) -> tuple[Array, Array]:
    """Eliminate a block's own unknowns from its normal matrix N (..., D, D) (Schur complement).

    `own` (p,) are the columns of these unknowns, and `kept` (k,) those that stay; include the residual's
    column to keep the right side and the sum of squares. `ridge` is as for `solve_scaled`. Returns the
    reduced matrix N_kk - N_ko N_oo^-1 N_ok (..., k, k), and N_oo^-1 N_ok (..., p, k): the response of the own
    unknowns to the others; in the residual's column, their step.
    """
    cross = N[..., own[:, None], kept]
    solved = solve_scaled(N[..., own[:, None], own], cross, ridge)
    return N[..., kept[:, None], kept] - np.swapaxes(cross, -1, -2) @ solved, solved


@frozen_dataclass(eq=False)
class Arrowhead:
    """Normal equations of unknowns that all blocks share, and of each block's own, summed over the blocks.

    The last row and column of `shared` and the last column of `cross` belong to the residuals.
    """

    shared: Array  # (s + 1, s + 1)
    own: Array  # (V, p, p)
    cross: Array  # (V, p, s + 1)

    @classmethod
    def of(cls, N: Array, shared: Columns, own: Columns) -> Arrowhead:
        """From the products N (V, D, D) of each block's derivatives and, in the last column, residuals.

        `shared` (s,) and `own` (p,) are the columns of the unknowns.
        """
        p = len(own)
        columns = np.concatenate([own, shared, [N.shape[-1] - 1]])
        M = N[:, columns[:, None], columns]
        return cls(M[:, p:, p:].sum(axis=0), M[:, :p, :p], M[:, :p, p:])

    @classmethod
    def alone(cls, H: Array, g: Array, cost: float) -> Arrowhead:
        """Of shared unknowns alone, from their matrix (s, s), right side (s,) and the sum of squares."""
        shared = np.block([[H, g[:, None]], [g, np.array(cost)]])
        return cls(shared, np.zeros((0, 0, 0)), np.zeros((0, 0, len(shared))))

    @property
    def cost(self) -> float:
        """The sum of squares."""
        return float(self.shared[-1, -1])

    def only(self, kept: Columns) -> Arrowhead:
        """Only these of the shared unknowns (f,); the others stay as they are."""
        columns = np.append(kept, len(self.shared) - 1)
        return Arrowhead(self.shared[np.ix_(columns, columns)], self.own, self.cross[:, :, columns])

    def around(self, right: Array, by_shared: Array, more: float) -> Arrowhead:
        """The same around other values of further unknowns, or of some of the own ones, after a move of -d.

        `right` (V, p) is their coupling to the own unknowns times d, `by_shared` (s + 1,) likewise that to
        the shared ones and their right side, and `more` is d^T H d.
        """
        shared, cross = self.shared.copy(), self.cross.copy()
        shared[-1] += by_shared
        shared[:, -1] += by_shared
        shared[-1, -1] += more
        cross[:, :, -1] += right
        return Arrowhead(shared, self.own, cross)

    def reduced(self, ridge: float = 0.0) -> tuple[Array, Array]:
        """The own unknowns eliminated: the Schur complement (s + 1, s + 1), and their response (V, p, s + 1).

        The response to the shared unknowns has the opposite sign; in the residual's column it is their step.
        `ridge` is as for `solve_scaled`.
        """
        solved = solve_scaled(self.own, self.cross, ridge)
        s = len(self.shared)
        return self.shared - self.cross.reshape(-1, s).T @ solved.reshape(-1, s), solved

    @property
    def follow(self) -> Array:
        """(V, p, s) how the own unknowns follow the shared ones."""
        return -solve_scaled(self.own, self.cross[:, :, :-1])

    def step(self, damping: float) -> tuple[Array, Array, float]:
        """Damped Gauss-Newton step; `damping` is the share of the diagonal that is added to it (Marquardt).

        Returns the steps of the shared (s,) and of the own unknowns (V, p), nan where the system is singular,
        and the predicted drop of the sum of squares.
        """
        # Eliminate the own unknowns first, then solve the reduced system of the shared ones.
        B, C, f = self.own.copy(), self.cross, len(self.shared) - 1
        diagonal = np.einsum("vii->vi", B)  # a view
        ridge_own = damping * (diagonal + NOTHING)
        diagonal += ridge_own
        solved = solve_scaled(B, C)
        # (f, V p) times (V p, f + 1): one product sums over blocks and own unknowns.
        flat = C.reshape(-1, f + 1)
        S = self.shared[:-1].copy()
        g = S[:, -1].copy()
        diagonal = np.einsum("ii->i", S[:, :-1])
        ridge = damping * (diagonal + NOTHING)
        S -= flat[:, :-1].T @ solved.reshape(-1, f + 1)
        diagonal += ridge
        step = solve_scaled(S[:, :-1], S[:, -1:])[:, 0]
        by_own = solved[:, :, -1] - solved[:, :, :-1] @ step
        gain = (by_own * (C[:, :, -1] + ridge_own * by_own)).sum() + step @ (g + ridge * step)
        return step, by_own, float(gain)

    def covariance(self, variance: float = 1.0, shared: Array | None = None) -> Covariance:
        """Inverse of the normal matrix times the variance of the residuals: the Cramer-Rao bound.

        If the covariance `shared` (s, s) of the shared unknowns comes from elsewhere, the own ones follow it.
        """
        U, C = self.shared[:-1, :-1], self.cross[:, :, :-1]
        B_inverse, smallest = inverse_scaled(self.own, self.own)
        follow = -B_inverse @ C
        if shared is None:
            inverse, of_shared = inverse_scaled(U + (np.swapaxes(C, 1, 2) @ follow).sum(axis=0), U)
            shared, smallest = variance * inverse, min(smallest, of_shared)
        return Covariance(shared, variance * B_inverse, follow, smallest)


@frozen_dataclass(eq=False)
class Covariance:
    """Covariance of unknowns that all blocks share, and of each block's own.

    The own unknowns follow the shared ones, so that all that makes these more uncertain changes `shared`
    alone.
    """

    shared: Array  # (s, s)
    alone: Array  # (V, p, p) of the own unknowns for known shared ones
    follow: Array  # (V, p, s) how the own unknowns follow the shared ones
    smallest: float  # smallest eigenvalue of the eliminated matrices scaled to a unit diagonal; 0 if singular

    @cached_property
    def own(self) -> Array:
        """(V, p, p) covariance of the own unknowns."""
        return np.asarray(self.alone + self.follow @ self.cross)

    @cached_property
    def cross(self) -> Array:
        """(V, s, p) covariance between the shared unknowns and each block's own."""
        return np.asarray(self.shared @ np.swapaxes(self.follow, 1, 2))

    def with_own(self, own: Array) -> Covariance:
        """The same with another covariance of the own unknowns (V, p, p) at the present shared ones."""
        return replace(self, alone=self.alone + own - self.own)

    def extended(self, columns: Columns, added: Array, follow: Array) -> Covariance:
        """With m more shared unknowns after the others, and a covariance (k, k) added to these columns (k,).

        `follow` (V, p, m) is how the own unknowns follow the new ones.
        """
        s = len(self.shared)
        shared = np.zeros((s + follow.shape[2],) * 2)
        shared[:s, :s] = self.shared
        shared[np.ix_(columns, columns)] += added
        return replace(self, shared=shared, follow=np.concatenate([self.follow, follow], axis=2))


class SharedAndOwn(Generic[State]):
    """A sum of squares of such unknowns as a `LeastSquaresProblem` of one group.

    `blocks` returns the normal equations at a state, of the unknowns that move. `moved` returns the state
    after a step of the shared (f,) and of the own (V, p) unknowns, and whether it is valid.
    """

    def __init__(
        self,
        start: State,
        blocks: Callable[[State], Arrowhead],
        moved: Callable[[State, Array, Array], tuple[State, bool]],
    ) -> None:
        self.state, self.blocks, self.moved = start, blocks, moved

    @property
    def cost(self) -> Array:
        """(1,) sum of squares."""
        return np.array([self.blocks(self.state).cost])

    def solve(self, damping: Array, active: Columns) -> tuple[tuple[Array, Array], Array]:
        """Steps of the shared and of the own unknowns, and the predicted gain."""
        by_shared, by_own, gain = self.blocks(self.state).step(float(damping[0]))
        return (by_shared, by_own), np.array([gain])

    def move(self, step: tuple[Array, Array], active: Columns) -> tuple[State, Array, NDArray[np.bool_]]:
        """The state after a step, its cost, and whether it is valid."""
        trial, valid = self.moved(self.state, *step)
        return trial, np.array([self.blocks(trial).cost]), np.array([valid])

    def accept(self, trial: State, better: NDArray[np.bool_], active: Columns) -> None:
        """Accept the trial."""
        if better[0]:
            self.state = trial

"""Least squares with unknowns shared by all blocks and unknowns of each block's own.

The normal matrix is an arrowhead: the own unknowns of different blocks (the poses of views) are coupled only
through the shared ones (the cameras). The Schur complement eliminates each block's own unknowns and leaves a
small system, so the work grows linearly with the number of blocks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import NOTHING, inverse_scaled, solve_scaled
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

Columns = NDArray[np.intp]
State = TypeVar("State")


@frozen_dataclass(eq=False)
class SchurCovariance:
    """Blocks of the inverse of an arrowhead matrix."""

    shared: Array  # (f, f)
    own: Array  # (V, p, p)
    cross: Array  # (V, f, p) between the shared unknowns and each block's own
    smallest: float  # smallest eigenvalue of the eliminated matrices scaled to a unit diagonal; 0 if singular


def schur_step(N: Array, shared: Columns, own: Columns, damping: float) -> tuple[Array, Array, float]:
    """Damped Gauss-Newton step.

    N (V, D, D) are the products of the derivatives and, in the last column, the residuals of each block.
    `shared` (f,) and `own` (p,) are the columns of the unknowns, and `damping` is the share of the diagonal
    that is added to it (Marquardt). Returns the steps of the shared (f,) and of the own unknowns (V, p), nan
    where the system is singular, and the predicted drop of the sum of squares.
    """
    # Eliminate the own unknowns first, then solve the reduced system of the shared ones.
    p, f = len(own), len(shared)
    columns = np.concatenate([own, shared, [N.shape[-1] - 1]])
    M = N[:, columns[:, None], columns]
    B, C = M[:, :p, :p], M[:, :p, p:]  # C (V, p, f + 1), with the right side
    diagonal = np.einsum("vii->vi", B)  # a view
    ridge_own = damping * (diagonal + NOTHING)
    diagonal += ridge_own
    solved = solve_scaled(B, C)
    # (f, V p) times (V p, f + 1): one product sums over blocks and own unknowns.
    flat = C.reshape(-1, f + 1)
    S = M[:, p:-1, p:].sum(axis=0)
    g = S[:, -1].copy()
    diagonal = np.einsum("ii->i", S[:, :-1])
    ridge = damping * (diagonal + NOTHING)
    S -= flat[:, :-1].T @ solved.reshape(-1, f + 1)
    diagonal += ridge
    step = solve_scaled(S[:, :-1], S[:, -1:])[:, 0]
    by_own = solved[:, :, -1] - solved[:, :, :-1] @ step
    gain = (by_own * (C[:, :, -1] + ridge_own * by_own)).sum() + step @ (g + ridge * step)
    return step, by_own, float(gain)


class SharedAndOwn(Generic[State]):
    """A sum of squares of such unknowns as a `LeastSquaresProblem` of one group.

    `blocks` returns the products (V, D, D) of derivatives and residuals at a state, as for `schur_step`.
    `moved` returns the state after a step of the shared (f,) and of the own (V, p) unknowns, and whether it
    is valid. `shared` (f,) and `own` (p,) are the columns of the unknowns.
    """

    def __init__(
        self,
        start: State,
        blocks: Callable[[State], Array],
        moved: Callable[[State, Array, Array], tuple[State, bool]],
        shared: Columns,
        own: Columns,
    ) -> None:
        self.state, self.blocks, self.moved, self.shared, self.own = start, blocks, moved, shared, own

    @property
    def cost(self) -> Array:
        """(1,) sum of squares."""
        return self.blocks(self.state)[:, -1, -1].sum(keepdims=True)

    def solve(self, damping: Array, active: Columns) -> tuple[tuple[Array, Array], Array]:
        """Steps of the shared and of the own unknowns, and the predicted gain."""
        *step, gain = schur_step(self.blocks(self.state), self.shared, self.own, float(damping[0]))
        return (step[0], step[1]), np.array([gain])

    def move(self, step: tuple[Array, Array], active: Columns) -> tuple[State, Array, NDArray[np.bool_]]:
        """The state after a step, its cost, and whether it is valid."""
        trial, valid = self.moved(self.state, *step)
        return trial, self.blocks(trial)[:, -1, -1].sum(keepdims=True), np.array([valid])

    def accept(self, trial: State, better: NDArray[np.bool_], active: Columns) -> None:
        """Accept the trial."""
        if better[0]:
            self.state = trial


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


def schur_covariance(N: Array, shared: Columns, own: Columns) -> SchurCovariance:
    """Inverse of the normal matrix, block by block; see `schur_step` for the parameters.

    Times the residual variance it is the Cramer-Rao bound at the estimate.
    """
    U = N[:, shared[:, None], shared].sum(axis=0)
    B_inverse, smallest = inverse_scaled(B := N[:, own[:, None], own], B)
    C = N[:, shared[:, None], own]
    gain = C @ B_inverse
    S = U - (gain @ np.swapaxes(C, 1, 2)).sum(axis=0)
    S_inverse, smallest_shared = inverse_scaled(S, U)
    cross = -S_inverse @ gain
    covariance_own = B_inverse - np.swapaxes(gain, 1, 2) @ cross
    return SchurCovariance(S_inverse, covariance_own, cross, min(smallest, smallest_shared))

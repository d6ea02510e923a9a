"""Leave groups of data out of a least-squares fit without fitting again.

At the minimum the error of each group g is nearly a quadratic in the unknowns p that the groups share,

    E_g(p + d) = c_g - 2 g_g . d + d^T S_g d,

with the group's own unknowns eliminated (Schur complement). With S and g summed over all groups, the minimum
without a set F of groups is d = (S - S_F)^-1 (g - g_F). It and its error on the groups left out follow from
these few small matrices: exactly if the problem is linear, otherwise to second order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_REGULAR = 1e-12  # smallest eigenvalue of a matrix scaled to a unit diagonal that is not mere rounding

P = ParamSpec("P")
T = TypeVar("T")


def quietly(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function whose undetermined unknowns become inf or nan, for which its results are tested."""
    # One for each function: the same `errstate` twice in a call loses NumPy's state before it.
    return np.errstate(over="ignore", invalid="ignore", divide="ignore")(function)


@frozen_dataclass(eq=False)
class Quadratics:
    """Squared errors of G groups as quadratic functions of the f unknowns that they share."""

    S: Array  # (G, f, f)
    g: Array  # (G, f)
    cost: Array  # (G,)

    @quietly
    def at(self, step: Array) -> Array:
        """(G,) error of each group after a step (f,), or a step of its own (G, f)."""
        step = np.broadcast_to(step, self.g.shape)
        square = (step * (self.S @ step[..., None])[..., 0]).sum(axis=-1)
        return np.asarray(self.cost - 2 * (self.g * step).sum(axis=-1) + square)

    def centred(self) -> Quadratics:
        """The same with the scores g at the minimum of the sum."""
        return replace(self, g=self.g - self.S @ solve_or_nan(self.S.sum(axis=0), self.g.sum(axis=0)))

    def summed(self, member: Array) -> tuple[Array, Array]:
        """S (F, f, f) and g (F, f) of sets of groups; member (F, G) is 1 where a group belongs to a set."""
        of_S = member @ self.S.reshape(len(self.S), -1)
        return of_S.reshape(len(member), *self.S.shape[1:]), member @ self.g

    @quietly
    def steps(self, member: Array, penalty: tuple[Array, Array] | None = None) -> Array:
        """Steps (F, f) to the minimum over F sets of groups; nan where a set does not determine the unknowns.

        `member` (F, G) is 1 where a group belongs to a set, 0 elsewhere. `penalty` is a prior, (f, f) and
        (f,), added to the matrix and to the right side.
        """
        S, g = self.summed(member)
        return solve_or_nan(S, g) if penalty is None else solve_or_nan(S + penalty[0], g + penalty[1])

    @quietly
    def held_out(self, fold: NDArray[np.intp], penalty: tuple[Array, Array] | None = None) -> Array:
        """(G,) error of each group with the unknowns estimated from all groups outside its fold (G,)."""
        member = (fold == np.arange(int(fold.max()) + 1)[:, None]).astype(float)
        return self.at(self.steps(1.0 - member, penalty)[fold])

    @quietly
    def moves_without_each(self) -> Array:
        """(G, f) how far the unknowns move when one group is left out."""
        return solve_or_nan(self.S.sum(axis=0) - self.S, self.g.sum(axis=0) - self.g)

    @quietly
    def cost_without_each(self) -> Array:
        """(G,) error of all other groups, fitted again without the group."""
        gained = ((self.g.sum(axis=0) - self.g) * self.moves_without_each()).sum(axis=-1)
        return np.asarray(self.cost.sum() - self.cost - gained)


def folds_of(n_groups: int, n_folds: int) -> NDArray[np.intp]:
    """(G,) fold of each group, assigned in turn; with at most `n_folds` groups each is a fold of its own."""
    return np.arange(n_groups) % n_folds if n_groups > n_folds else np.arange(n_groups)


def solve_or_nan(S: Array, g: Array) -> Array:
    """S^-1 g of a stack (..., f, f), (..., f); nan where S is singular to rounding."""
    return _solved(S, g[..., None])[..., 0]


def inverse_or_nan(S: Array) -> Array:
    """S^-1 of symmetric matrices (..., n, n); nan where they are singular to rounding."""
    return _solved(S, np.broadcast_to(np.eye(S.shape[-1]), S.shape))


@quietly
def _solved(S: Array, right: Array) -> Array:
    """S^-1 times right sides (..., f, m)."""
    if right.size == 0:
        return np.zeros(right.shape)
    scaled, scale = unit_diagonal(S)
    usable = np.asarray(np.isfinite(scaled).all(axis=(-2, -1)))
    if usable.any():
        usable[usable] = np.linalg.eigvalsh(scaled[usable])[..., 0] > _REGULAR
    solved = np.full(right.shape, np.nan)
    if usable.any():
        scale = scale[..., None]
        solved[usable] = scale[usable] * np.linalg.solve(scaled[usable], (scale * right)[usable])
    return solved


def least_by_precision(M: Array, values: Array, along: Array) -> Callable[[Array], tuple[Array, Array]]:
    """Minimum (k,) and log determinant (k,) of a quadratic, by precisions (k,) of independent unknowns.

    M (f + 1, f + 1) is the quadratic in the common unknowns, bordered by the right side and the cost. Besides
    these there are K unknowns with the information `values` (K,) and the coupling `along` (K, f + 1) to M,
    and a normal prior of the given precision. The log determinant is over that of the prior.
    """
    f = len(M) - 1

    def least(precision: Array) -> tuple[Array, Array]:
        left = values + precision[:, None]
        N = M - (along.T / left[:, None]) @ along
        S, g = N[:, :f, :f], N[:, :f, f]
        cost = N[:, f, f] - (g * np.linalg.solve(S, g[..., None])[..., 0]).sum(axis=1)
        return cost, np.log(left / precision[:, None]).sum(axis=1) + np.linalg.slogdet(S)[1]

    return least

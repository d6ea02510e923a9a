"""Standard deviations that count views, where residuals of one view err together.

The inverse normal matrix takes every residual for independent. On a board that is not quite flat, with a
focus that moves, or under a lens that is not quite as modelled, whole views err together, and the parameters
scatter more from view to view than the residuals say. The jackknife sees that: each view is left out in one
step, d_v = -(S - S_v)^-1 g_v with the poses eliminated, and

    covariance = (V - 1) / V  sum_v (d_v - mean) (d_v - mean)^T.

With few views it is a rough measure. Taken always, it would make the std of clean data a third too large at
five views, and a quarter at ten. So it is taken only where views contradict each other more than chance
allows, and nowhere below the normal matrix's; and on boards that bend anew in each view, which hides that,
where it is far larger. Views that repeat a pose (`repeated_poses`) are one view here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.covariance import Covariance
from neurocal_cli.bundle_adjustment.cross_validation import reduced
from neurocal_cli.bundle_adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.bundle_adjustment.reprojection import POSE, camera_columns
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.chi_squared import exceeded_by_chance
from neurocal_cli.least_squares.leave_out import Quadratics, inverse_or_nan, solve_or_nan
from neurocal_cli.least_squares.normal_equations import solve_scaled, unit_diagonal

_CHANCE = 1.645  # sigmas: one clean set in twenty
_TOLD = 1e-10  # least eigenvalue of a normal matrix with a unit diagonal that rounding leaves alone
# Variance by the jackknife over that of the normal matrix, from which on it is believed where boards bend
# anew in each view: at most 11.5 in 63 sets of tests/test_simulated_targets.py, and 21 to 73 in photographs.
_GROWN = 15.0
_FEWEST = 3  # poses, of which one can be left out and two still differ


# What nothing determines is infinite or nan, and told so by the results.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def counting_views(
    found: Covariance,
    normal: Array,
    free: NDArray[np.bool_],
    free_poses: bool,
    n_residuals: float,
    repeated: RepeatedPoses,
    moves_without: Callable[[NDArray[np.intp]], Array | None] | None = None,
    bends: bool = False,
) -> Covariance:
    """Covariances as far as views, not residuals, are independent.

    Parameters
    ----------
    found : Covariance
        Of the normal matrix.
    normal, free, free_poses, n_residuals
        As for `covariance.covariance`.
    repeated : RepeatedPoses
    moves_without : callable, optional
        How far the free parameters move without the views of each pose, given each view's pose, where the
        normal matrices do not tell.
    bends : bool
        Whether each view has bends of its own. Other causes for which views contradict each other end in
        these bends, too, and only the jackknife shows that.

    Returns
    -------
    Covariance
        The one given where views contradict each other no more than residuals do.
    """
    if not free.any() or not np.isfinite(found.entries).all():
        return found
    unknowns = int(free.sum()) + (6 * len(normal) if free_poses else 0)
    variance = float(normal[:, -1, -1].sum()) / max(n_residuals - unknowns, 1)
    whole = reduced(normal, free, free_poses)
    told = _determined(whole.S.sum(axis=0))
    if told is not None:
        whole = Quadratics(told.into.T @ whole.S @ told.into, whole.g @ told.into, whole.cost)
    q = _by_pose(whole, repeated)
    entries = before = found.entries if told is None else told.back @ found.entries @ told.back.T
    if not repeated.none:
        entries = _of_copies(q, repeated.variance, variance)
    enough = len(q.cost) >= _FEWEST
    contradict = enough and _contradict(q, repeated.variance, variance)
    if contradict or (bends and enough):
        moves = None if moves_without is None else moves_without(repeated.group)
        if moves is not None and told is not None:
            moves = moves @ told.back.T
        jackknife = _jackknife(q.moves_without_each() if moves is None else moves)
        if contradict or _grown(jackknife, entries) > _GROWN:
            entries = _at_least(jackknife, entries)
    if entries is before or not np.isfinite(entries).all():
        return found
    if told is not None:
        entries = found.entries + told.into @ (entries - before) @ told.into.T
    return replace(found, entries=entries, poses=_followed(found, normal, free, free_poses, entries))


@frozen_dataclass(eq=False)
class _Determined:
    """Directions of the unknowns that the points tell: p = into z, z = back p."""

    into: Array
    back: Array


def _determined(S: Array) -> _Determined | None:
    """Without the directions in which rounding has the say; None where there are none.

    The coefficients of a rational model hardly tell themselves apart, though what they project is certain.
    """
    scaled, scale = unit_diagonal(S)
    try:
        values, vectors = np.linalg.eigh(scaled)
    except np.linalg.LinAlgError:
        return None
    kept = values > _TOLD
    if kept.all() or not kept.any():
        return None
    vectors = vectors[:, kept]
    return _Determined(scale[:, None] * vectors, vectors.T / scale)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def scores_of_poses(
    normal: Array, free: NDArray[np.bool_], free_poses: bool, repeated: RepeatedPoses
) -> Quadratics:
    """Quadratics of the different poses at their minimum, weighed so that cov(g) is variance times S.

    The parameters are those of `reduced`.
    """
    return _weighed(_by_pose(reduced(normal, free, free_poses), repeated), repeated.variance)


def _weighed(q: Quadratics, times: Array) -> Quadratics:
    S, g = q.S / times[:, None, None], q.g / times[:, None]
    return Quadratics(S, g - S @ solve_or_nan(S.sum(axis=0), g.sum(axis=0)), q.cost / times)


def _by_pose(q: Quadratics, repeated: RepeatedPoses) -> Quadratics:
    """Of groups of views, with the scores at the minimum of all, which a restraint may keep one from."""
    if not repeated.none:
        q = Quadratics(repeated.summed(q.S), repeated.summed(q.g), repeated.summed(q.cost))
    step = q.steps(np.ones((1, len(q.cost))))[0]
    return Quadratics(q.S, q.g - q.S @ step, q.cost)


def _of_copies(q: Quadratics, times: Array, variance: float) -> Array:
    """S^-1 (sum of the variances of the poses' scores) S^-1."""
    S_inverse = inverse_or_nan(q.S.sum(axis=0))
    return np.asarray(variance * S_inverse @ np.tensordot(times, q.S, 1) @ S_inverse)


def _contradict(q: Quadratics, times: Array, variance: float) -> bool:
    """Whether the poses' scores g are larger than noise has them, with cov(g) = times variance S of each.

    The statistic is sum g^T S^-1 g. Of noise it is a sum of squares with the covariance W_v - W_v W_w between
    views v and w, W_v being S^-1/2 S_v S^-1/2: its mean and variance follow, and Satterthwaite's (1946)
    chi-squared has the same.
    """
    weighed = _weighed(q, times)
    S, g = weighed.S, weighed.g
    scaled, scale = unit_diagonal(S.sum(axis=0))
    try:
        root = np.linalg.inv(np.linalg.cholesky(scaled)) * scale
    except np.linalg.LinAlgError:
        return False
    W = root @ S @ root.T
    W2 = W @ W
    Q = W2.sum(axis=0)
    mean = len(Q) - float(np.trace(Q))
    spread = float(np.trace(W2, axis1=1, axis2=2).sum() - 2 * (W * W2).sum() + (Q * Q).sum())
    if not (mean > 0 and spread > 0 and variance > 0):
        return False
    statistic = float(((g @ root.T) ** 2).sum()) / variance / mean
    return bool(statistic > exceeded_by_chance(mean**2 / spread, _CHANCE))


def _jackknife(moves: Array) -> Array:
    """(f, f) from the moves (P, f) without each pose; nan where views cannot be left out."""
    moves = moves - moves.mean(axis=0)
    return np.asarray((len(moves) - 1) / len(moves) * moves.T @ moves)


def _grown(jackknife: Array, entries: Array) -> float:
    """Mean of the variances by the jackknife over the other ones, in all directions; 0 where unknown."""
    grown = float(np.trace(solve_or_nan(entries, jackknife))) / len(entries)
    return grown if np.isfinite(grown) else 0.0


def _at_least(jackknife: Array, entries: Array) -> Array:
    """The jackknife's covariance, in no direction below the other one."""
    scaled, scale = unit_diagonal(entries)
    try:
        root = np.linalg.cholesky(scaled) / scale[:, None]
        inverse = np.linalg.inv(root)
        values, vectors = np.linalg.eigh(inverse @ jackknife @ inverse.T)
    except np.linalg.LinAlgError:  # nan among them too
        return entries
    if not np.isfinite(values).all():
        return entries
    axes = root @ vectors
    return np.asarray(axes * np.maximum(values, 1.0) @ axes.T)


def _followed(
    found: Covariance, normal: Array, free: NDArray[np.bool_], free_poses: bool, entries: Array
) -> Array:
    """The poses' covariances, which follow the shared parameters."""
    if not free_poses:
        return found.poses
    f = camera_columns(len(free) - 5)[np.flatnonzero(free)]
    gain = solve_scaled(normal[:, POSE, POSE], np.swapaxes(normal[:, f, POSE], 1, 2))  # (V, 6, f)
    return np.asarray(found.poses + gain @ (entries - found.entries) @ np.swapaxes(gain, 1, 2))

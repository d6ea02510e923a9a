"""Jackknife covariance over views, for residuals that are correlated within a view.

The inverse normal matrix treats all residuals as independent. But if the board is not quite flat, the focus
moves or the distortion model is not quite right, the errors of a view are correlated, and the parameters
scatter more from view to view than the residuals suggest. The jackknife measures that: each view is left out
by one step, d_v = -(S - S_v)^-1 g_v with the poses eliminated, and

    covariance = (V - 1) / V  sum_v (d_v - mean) (d_v - mean)^T.

With few views it is imprecise: used always, it would make the std of clean data a third too large with five
views, and a quarter with ten. So it is used only if the views contradict each other more than chance allows,
and it never goes below the covariance of the normal matrix. If each view has bends of its own, they hide such
contradictions; then it is used if it is far larger than noise lets one expect. Views that repeat a pose
(`repeated_poses`) count as one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.covariance import Covariance, residual_variance
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.leave_out import Quadratics, inverse_or_nan, quietly, solve_or_nan
from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.reprojection import free_columns, pose_response
from neurocal_cli.camera.geometry import Array

_CHANCE = 1.645  # sigmas: one clean set in twenty
_TOLD = 1e-10  # least eigenvalue of a normal matrix with unit diagonal that is not dominated by rounding
# Ratio of the jackknife's variance to the expected one from which on it is used for boards with a bend in
# each view: above it in one (4.4) of the 143 such sets of test_simulated_targets.py, and 4.7 to 32 in
# photographs (figures, "The board estimated with the camera").
_GROWN = 3.0
_FEWEST = 3  # fewest poses: with one left out, two must still differ


@quietly
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
    """Covariances for residuals that are independent between views only.

    The result is `found`, the covariance from the normal matrix, if the views contradict each other no more
    than the residuals explain. `normal`, `free`, `free_poses` and `n_residuals` are as for
    `covariance.covariance`. `moves_without` takes the pose number of each view and returns the moves of the
    free parameters when the views of each pose are left out; it is needed if they do not follow from the
    normal matrices. `bends` tells whether each view has bends of its own: they absorb contradictions between
    views that have other causes, and only the jackknife reveals those.
    """
    if not free.any() or not np.isfinite(found.entries).all():
        return found
    variance = residual_variance(normal, free, free_poses, n_residuals)
    whole = reduced(normal, free, free_poses)
    entries = found.entries
    told = _determined(whole.S.sum(axis=0))
    if told is not None:
        into, back = told
        whole = Quadratics(into.T @ whole.S @ into, whole.g @ into, whole.cost)
        entries = back @ entries @ back.T
    before, q = entries, _by_pose(whole, repeated)
    if not repeated.none:  # S^-1 (sum of the variances of the poses' scores) S^-1
        S_inverse = inverse_or_nan(q.S.sum(axis=0))
        entries = variance * S_inverse @ np.tensordot(repeated.variance, q.S, 1) @ S_inverse
    enough = len(q.cost) >= _FEWEST
    contradict = enough and _contradict(q if repeated.none else _weighed(q, repeated.variance), variance)
    if contradict or (bends and enough):
        moves = None if moves_without is None else moves_without(repeated.group)
        if moves is not None and told is not None:
            moves = moves @ back.T
        jackknife = _jackknife(q.moves_without_each() if moves is None else moves)
        noise = _expected(q, repeated.variance, variance)
        if contradict or _size(jackknife, entries) > _GROWN * _size(noise, entries):
            entries = _at_least(jackknife, entries)
    if entries is before or not np.isfinite(entries).all():
        return found
    if told is not None:
        entries = found.entries + into @ (entries - before) @ into.T
    poses = found.poses
    if free_poses:
        gain = pose_response(normal, free_columns(free))
        poses = poses + gain @ (entries - found.entries) @ np.swapaxes(gain, 1, 2)
    return replace(found, entries=entries, poses=poses)


def _determined(S: Array) -> tuple[Array, Array] | None:
    """Directions z of the unknowns p that are not dominated by rounding; None if these are all or none.

    Two matrices, (f, r) and (r, f), with p = into z and z = back p. Coefficients of a rational model are
    almost degenerate, although the projection is well determined.
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
    return scale[:, None] * vectors, vectors.T / scale


def _weighed(q: Quadratics, times: Array) -> Quadratics:
    return Quadratics(q.S / times[:, None, None], q.g / times[:, None], q.cost / times).centred()


def _by_pose(q: Quadratics, repeated: RepeatedPoses) -> Quadratics:
    """Quadratics summed over repeated views, with the scores at their own minimum (without a penalty)."""
    if not repeated.none:
        q = Quadratics(repeated.summed(q.S), repeated.summed(q.g), repeated.summed(q.cost))
    return q.centred()


def _contradict(q: Quadratics, variance: float) -> bool:
    """Whether the scores g of the poses are larger than noise explains, where cov(g) = variance S.

    The statistic is sum g^T S^-1 g. For noise it is a sum of squares with the covariance W_v - W_v W_w
    between views v and w, where W_v = S^-1/2 S_v S^-1/2. Its mean and variance follow, and it is compared
    with a chi-squared distribution of the same mean and variance (Satterthwaite 1946).
    """
    scaled, scale = unit_diagonal(q.S.sum(axis=0))
    try:
        root = np.linalg.inv(np.linalg.cholesky(scaled)) * scale
    except np.linalg.LinAlgError:
        return False
    W = root @ q.S @ root.T
    W2 = W @ W
    Q = W2.sum(axis=0)
    mean = len(Q) - float(np.trace(Q))
    spread = float(np.trace(Q) - 2 * (W * W2).sum() + (Q * Q).sum())
    if not (mean > 0 and spread > 0 and variance > 0):
        return False
    statistic = float(((q.g @ root.T) ** 2).sum()) / variance / mean
    return bool(statistic > exceeded_by_chance(mean**2 / spread, _CHANCE))


def _jackknife(moves: Array) -> Array:
    """(f, f) jackknife covariance from the moves (P, f) without each pose; nan if a pose is indispensable."""
    moves = moves - moves.mean(axis=0)
    return np.asarray((len(moves) - 1) / len(moves) * moves.T @ moves)


def _expected(q: Quadratics, times: Array, variance: float) -> Array:
    """(f, f) jackknife covariance that noise alone lets one expect, where cov(g) = times variance S.

    It is larger than the covariance of the parameters: a view with a large share of the information moves
    them far when it is left out.
    """
    S, own = q.S.sum(axis=0), times[:, None, None] * q.S
    share = inverse_or_nan(S) @ q.S
    by_share = own @ share
    # At the minimum, g of each pose has lost its share of the sum.
    scores = own - by_share - np.swapaxes(by_share, 1, 2)
    scores += np.swapaxes(share, 1, 2) @ own.sum(axis=0) @ share
    gain = inverse_or_nan(S - q.S)
    return np.asarray((len(own) - 1) / len(own) * variance * (gain @ scores @ gain).sum(axis=0))


def _size(jackknife: Array, entries: Array) -> float:
    """Mean ratio of a jackknife's variances to the others over all directions; nan if unknown."""
    return float(np.trace(solve_or_nan(entries, jackknife))) / len(entries)


def _at_least(jackknife: Array, entries: Array) -> Array:
    """The jackknife's covariance, raised to the other one in every direction in which it is smaller."""
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

"""Covariance of the estimated parameters: from the normal matrix, or by the jackknife over views.

The inverse normal matrix times the residual variance is the Cramer-Rao bound at the estimate, for Gaussian
noise. The block of the intrinsics comes from the
Schur complement over the views. The block of each pose is that of its own view plus the part propagated from
the intrinsics.

The pose of a view follows an error of the camera as d pose = -B^-1 C d camera, where B and C are the blocks
of the view's normal matrix for its pose and for its pose and the camera. So if a camera with the covariance S
was given (type 3), each pose has the additional covariance B^-1 C S C^T B^-1. It does not fall with the
number of points.

The estimators work with A's entries in normalised pixels and with poses about the centre of their target.
Users want standard deviations of the paper's parameters, in pixels, radians and world units.

The inverse normal matrix treats all residuals as independent. But if the board is not quite flat, the focus
moves or the distortion model is not quite right, the errors of a view are correlated, and the parameters
scatter more from view to view than the residuals suggest. The jackknife measures that: each view is left out
by one step, d_v = -(S - S_v)^-1 g_v with the poses eliminated, and

    covariance = (V - 1) / V  sum_v (d_v - mean) (d_v - mean)^T.

With few views it is imprecise: used always, it would make the std of clean data a third too large with five
views, and a quarter with ten. So it is used only if the views contradict each other more than chance allows,
and it never goes below the covariance of the normal matrix. A target that was estimated with bends of each
view, or from few views, hides such contradictions; then it is used if it is far larger than noise lets one
expect. Views that repeat a pose (`repeated_poses`) count as one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.cross_validation import (
    Minimum,
    Quadratics,
    inverse_or_nan,
    quietly,
    solve_or_nan,
)
from neurocal_cli.adjustment.normal_equations import Arrowhead, Covariance, unit_diagonal
from neurocal_cli.adjustment.reprojection import POSE_COLUMNS, camera_columns, normal_blocks
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, euler_jacobian
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, Intrinsics
from neurocal_cli.camera.state import CameraState

_TOLD_APART = 2.0  # standard deviations from which on a coefficient differs significantly from 0


@frozen_dataclass(eq=False)
class CovarianceBasis:
    """Input of a camera's covariance (`Minimum.covariance`, `counting_views`)."""

    minimum: Minimum
    # (f, f) covariance of A's free entries and the free distortion coefficients, normalised, if it does not
    # follow from the normal matrices.
    shared: Array | None
    n_equations: float  # number of equations minus the effective number of estimated unknowns of the target
    # (P, f) moves of the free parameters when the views of each pose are left out and the target is estimated
    # again, given the pose (V,) of each view. None if there are many poses: then the efficient scores give
    # the same.
    moves_without: Callable[[NDArray[np.intp]], Array | None] | None = None
    # (V, 6, 6) covariance of the poses, if it does not follow from the normal matrices.
    poses: Array | None = None


def entry_covariance(
    intrinsics: Intrinsics, model: str, names: Sequence[str], covariance: Array, pixel_scale: float
) -> Array:
    """(5 + K, 5 + K) covariance of A's entries in normalised pixels and of the distortion coefficients.

    `covariance` (n, n) is that of the parameters with these names; the others are exact.
    """
    every = (*INTRINSIC_NAMES, *coefficient_names(model))
    place = [every.index(name) for name in names]
    to_entries = np.eye(len(every))
    to_entries[:5, :5] = np.linalg.inv(intrinsics.entry_jacobian() * pixel_scale)
    return np.asarray(to_entries[:, place] @ covariance @ to_entries[:, place].T)


def covariance_by_camera(views: Views, state: CameraState, entries: Array) -> Array:
    """(V, 6, 6) covariance of omega and tau, normalised, that a camera's covariance causes.

    `entries` (5 + K, 5 + K) is as from `entry_covariance`, and `state` is normalised and at its minimum.
    """
    normal, _ = normal_blocks(views.batches, state)
    follow = Arrowhead.of(normal, camera_columns(state.k.shape[-1]), POSE_COLUMNS).follow
    return np.asarray(follow @ entries @ np.swapaxes(follow, 1, 2))


def parameter_covariance(
    intrinsics: Intrinsics,
    model: str,
    covariance: Array,
    pixel_scale: float,
    given: Collection[str],
    square: bool = False,
) -> tuple[Array, dict[str, float]]:
    """Covariance of the intrinsic parameters and the K distortion coefficients, and their std by name.

    `covariance` is that of A's entries A11, A12, A22, A13, A23 in normalised pixels and of the coefficients;
    it is 0 for given ones. Both covariances are (5 + K, 5 + K). `pixel_scale` is S1 [px], and the std of the
    `given` names is 0. With `square` pixels A22 follows A11.
    """
    names = (*INTRINSIC_NAMES, *coefficient_names(model))
    J = np.eye(len(names))
    J[:5, :5] = intrinsics.entry_jacobian() * pixel_scale
    if square:
        J[:, 0] += J[:, 2]
    block = J @ covariance @ J.T
    std = {name: 0.0 if name in given else float(np.sqrt(block[n, n])) for n, name in enumerate(names)}
    return block, std


def pose_std(R: Array, centre: Array, scale: Array, covariance: Array) -> Array:
    """Standard deviations (V, 6) of the angles and translations of poses with rotations R (V, 3, 3).

    `centre` (V, 3) is the centre of each target in the camera's axes, R c, and `scale` (V,) is S2, both in
    world units. `covariance` (V, 6, 6) is that of omega and tau about the centre, normalised.
    """
    # t = scale tau - R c: omega turns R c with it.
    J = np.zeros((len(R), 6, 6))
    J[:, :3, :3] = euler_jacobian(R)
    J[:, 3:, :3] = cross_matrix(centre)
    J[:, 3:, 3:] = np.eye(3) * scale[:, None, None]
    block = J @ covariance @ np.swapaxes(J, 1, 2)
    return np.asarray(np.sqrt(np.maximum(np.diagonal(block, axis1=1, axis2=2), 0.0)))


def with_scale(std: Array, t: Array, relative: float) -> Array:
    """Add the relative std of the target's scale, which scales the translations t (V, 3), to std (V, 6)."""
    return np.asarray(np.hypot(std, relative * np.abs(np.concatenate([np.zeros_like(t), t], axis=1))))


def coefficient_warnings(
    distortion: Distortion, std: Mapping[str, float], model_chosen: bool
) -> tuple[str, ...]:
    """Warn of coefficients that are not significantly different from 0.

    A model selected by cross-validation may well have such a coefficient, so no warning is given then.
    """
    noise = [
        f"{name} ({k:.2g} +- {std[name]:.2g})"
        for name, k in zip(coefficient_names(distortion.model), distortion.coefficients, strict=True)
        if not model_chosen and name[0] in "kpst" and 0 < abs(k) < _TOLD_APART * std[name]
    ]
    if not noise:
        return ()
    return (f"not significantly different from 0: {', '.join(noise)}; choose a simpler --distortion",)


CHANCE = 1.645
"""Standard deviations that one clean set in twenty exceeds."""
_TOLD = 1e-10  # least eigenvalue of a normal matrix with unit diagonal that is not dominated by rounding
_ROUNDING = 1e-15  # least eigenvalue of a covariance with unit diagonal
_FEWEST = 3  # fewest poses: with one left out, two must still differ


@quietly
def counting_views(
    found: Covariance,
    m: Minimum,
    n_equations: float,
    moves_without: Callable[[NDArray[np.intp]], Array | None] | None = None,
    grown: float = np.inf,
) -> Covariance:
    """Covariances for residuals that are independent between views only.

    The result is `found`, the covariance from the normal matrix, if the views, of which it is known which
    repeat a pose, contradict each other no more than the residuals explain. `moves_without` takes the pose
    number of each view and returns the moves of the free parameters when the views of each pose are left out;
    it is needed if they do not follow from the normal matrices. An estimated target may absorb contradictions
    between views that have other causes; only the jackknife reveals those, and is used as well from `grown`
    times the variance that noise explains on.
    """
    repeated = m.repeated
    assert repeated is not None
    if not m.free.any() or not np.isfinite(found.shared).all():
        return found
    variance, whole, entries = m.variance(n_equations), m.quadratics, found.shared
    told = _determined(whole.S.sum(axis=0))
    if told is not None:
        into, back = told
        whole = Quadratics(into.T @ whole.S @ into, whole.g @ into, whole.cost)
        entries = back @ entries @ back.T
    before, times = entries, repeated.variance
    weighed = q = whole.centred()  # the scores are at their own minimum, without a penalty
    if not repeated.none:  # S^-1 (sum of the variances of the poses' scores) S^-1
        q = Quadratics(*map(repeated.summed, (whole.S, whole.g, whole.cost))).centred()
        S_inverse = inverse_or_nan(q.S.sum(axis=0))
        entries = variance * S_inverse @ np.tensordot(times, q.S, 1) @ S_inverse
        weighed = Quadratics(q.S / times[:, None, None], q.g / times[:, None], q.cost / times).centred()
    enough = len(q.cost) >= _FEWEST
    contradict = enough and _contradict(weighed, variance)
    if contradict or (enough and np.isfinite(grown)):
        moves = None if moves_without is None else moves_without(repeated.group)
        if moves is not None and told is not None:
            moves = moves @ back.T
        found_by_views = jackknife(q.moves_without_each() if moves is None else moves)
        noise = _expected(q, times, variance)
        if contradict or _size(found_by_views, entries) > grown * _size(noise, entries):
            entries = not_smaller(entries, found_by_views)
    if entries is before or not np.isfinite(entries).all():
        return found
    if told is not None:
        entries = found.shared + into @ (entries - before) @ into.T
    return replace(found, shared=entries)


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
    return bool(statistic > exceeded_by_chance(mean**2 / spread, CHANCE))


def jackknife(moves: Array) -> Array:
    """(f, f) jackknife covariance from the moves (P, f) without each part; nan if one is indispensable."""
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


def not_smaller(least: Array, other: Array) -> Array:
    """The smallest covariance that is, in the axes that both share, nowhere smaller than either.

    It is the first one if the other is not finite.

    Examples
    --------
    >>> not_smaller(np.diag([1.0, 4.0]), np.diag([3.0, 1.0])).round(9)
    array([[3., 0.],
           [0., 4.]])
    """
    scaled, scale = unit_diagonal(least)
    try:
        values, axes = np.linalg.eigh(scaled)
        root = np.sqrt(np.maximum(values, _ROUNDING))
        inverse = axes / root * scale[:, None]
        values, turn = np.linalg.eigh(inverse.T @ other @ inverse)
    except np.linalg.LinAlgError:  # nan among them too
        return least
    if not np.isfinite(values).all():
        return least
    joint = (axes * root / scale[:, None]) @ turn
    return np.asarray(joint * np.maximum(values, 1.0) @ joint.T)

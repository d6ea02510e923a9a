"""Split the free products W V into one W and the poses by the orthogonality conditions (13).

Each view's network has learnt a product B_k = W V_k up to scale. All views share W, and the rotation part of
V_k is orthonormal, so the columns of W^-1 B_k must be perpendicular and of equal length. A view of a solid
target gives five conditions, a view of a flat board two (Zhang 2000). Levenberg-Marquardt solves them for W's
five entries from random values. W^-1 B_k is then the pose of its view.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, LevenbergMarquardt
from neurocal_cli.adjustment.problem import Problem, intrinsic_matrix
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, cross_matrix, nearest_rotation
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.view_networks import Group

# Bundle adjustment refines the result, so gains below 1e-4 of the loss are not worth a step. Starts are
# random, so the actual gain counts; test_orthogonality.py checks the share of starts that converge.
_OPTIONS = DescentOptions(
    damping=1e-2, shrink=0.1, by_ratio=False, least_damping=1e-12, largest_damping=1e8,
    tolerance=1e-4, by_promise=False, flat=0.0, max_iterations=50,
)  # fmt: skip
_ROWS, _COLUMNS = ENTRIES
_FLOOR = 1e-28  # loss that rounding alone can cause
_APART = 1e-2  # largest difference of any entry from which on two minima are different
_LONGEST = 2.0  # largest step of any entry; in the logarithm a factor of 7
_STARTS = 8  # random starts, trained side by side
_ENOUGH = 3  # starts at the same, lowest loss with which training ends
# Repeated by test_convergence.py: its 1300 scenes show how many local minima the conditions have, and
# which depths keep all points in front of the first camera.
_MOST_CANDIDATES = 4
_LEAST_VIEWS = 3  # whose products determine W without those of views that have no spare point
_NEAREST = 1.05  # depth of the centroid, relative to that at which the nearest point reaches the focal plane


def candidate_intrinsics(problem: Problem, groups: Sequence[Group], rng: np.random.Generator) -> Array:
    """Candidates for W's entries, the minima of the views' orthogonality conditions; best first (C, 1, 5).

    The product of a view without a spare point takes in all of its noise, so it is used only if few others
    are there.
    """
    spare = [problem.views.distinct[group.views] > (4 if group.flat else 6) for group in groups]
    enough = sum(int(some.sum()) for some in spare) >= max(_LEAST_VIEWS, problem.views.n_views / 2)
    flat, solid = np.zeros((0, 3, 2)), np.zeros((0, 3, 3))
    for group, some in zip(groups, spare, strict=True):
        product = group.product[some] if enough else group.product
        if group.flat:
            flat = product[:, :, :2]
        else:
            solid = product[:, :, :3]
    shared = shared_intrinsics(solid, flat, problem.normalised_entries, problem.free, rng)
    return shared.entries[:_MOST_CANDIDATES, None]


@frozen_dataclass(eq=False)
class SharedIntrinsics:
    """Candidates for W's entries, best first."""

    entries: Array  # (C, 5) W11, W12, W22, W13, W23 of each distinct minimum
    loss: Array  # (C,) half the sum of squared conditions
    agreed: int  # number of random starts that ended at the best minimum


def shared_intrinsics(
    solid: Array, flat: Array, given: Array, free: NDArray[np.bool_], rng: np.random.Generator
) -> SharedIntrinsics:
    """Estimate W from the products of all views.

    `solid` (K, 3, 3) are the first three columns of the products of solid targets, and `flat` (L, 3, 2) the
    first two of flat boards. `free` (5,) says which of W11, W12, W22, W13, W23 are estimated; the others have
    the values of `given` (5,). W11 and W22 stay positive.
    """
    conditions = _Conditions(solid, flat, free)
    p = np.where(free, rng.uniform(-1, 1, (_STARTS, 5)), given)
    # The logarithms of W11 and W22 keep them positive.
    random, known = np.log(np.abs(p[:, [0, 2]]) + 1e-3), np.log(np.maximum(given[[0, 2]], 1e-300))
    p[:, [0, 2]] = np.where(free[[0, 2]], random, known)
    starts = _Starts(conditions, p)
    descent = LevenbergMarquardt(starts, _OPTIONS, _FLOOR)
    with np.errstate(all="ignore"):
        while descent.active.size:
            descent.step()
            ended = np.abs(starts.loss - starts.loss.min()) <= _tie(starts.loss.min())
            ended[descent.active] = False
            if ended.sum() >= _ENOUGH:
                break
    loss = np.where(np.isfinite(starts.loss), starts.loss, np.inf)
    order = np.argsort(loss, kind="stable")
    p, loss = starts.p[order], loss[order]
    entries = p.copy()
    entries[:, [0, 2]] = np.exp(p[:, [0, 2]])
    agreed = int((np.abs(loss - loss[0]) <= _tie(loss[0])).sum())
    apart = np.abs(p[:, None] - p).max(axis=2) > _APART
    distinct = [0]
    for n in np.flatnonzero(apart[0] & np.isfinite(loss)).tolist():
        if apart[n, distinct].all():
            distinct.append(n)
    return SharedIntrinsics(entries[distinct], loss[distinct], agreed)


def _tie(loss: float) -> float:
    """Tolerance within which another loss equals this one."""
    return 1e-3 * loss + 1e-16


class _Conditions:
    """Residuals of the orthogonality conditions and their derivatives by W's free entries."""

    def __init__(self, solid: Array, flat: Array, free: NDArray[np.bool_]) -> None:
        self.free = np.flatnonzero(free)
        self.groups = [
            (_columns(group, pairs), pairs, group.shape[2])
            for group, pairs in ((solid, ((0, 1), (0, 2), (1, 2))), (flat, ((0, 1),)))
            if len(group)
        ]

    def __call__(self, p: Array) -> tuple[Array, Array]:
        """Residuals (B, m) and derivatives (B, f, m) of B parameter sets (B, 5)."""
        conic, by_p = _conic(p)
        by_p = by_p[:, self.free]
        residuals, derivatives = [], []
        for columns, pairs, n_columns in self.groups:
            product, by = conic @ columns, by_p @ columns[:, None]  # (q, B, K) and (q, B, f, K)
            by_length = 0.5 * by[:n_columns] / product[:n_columns, :, None]  # relative
            for n, (i, j) in enumerate(pairs, start=n_columns):
                one, two = product[i], product[j]
                length = np.sqrt(one * two)
                cosine = product[n] / length
                residuals += [cosine, 0.5 * np.log(one / two)]
                derivatives += [
                    by[n] / length[:, None] - cosine[:, None] * (by_length[i] + by_length[j]),
                    by_length[i] - by_length[j],
                ]
        return np.concatenate(residuals, axis=1), np.concatenate(derivatives, axis=2)


def _columns(group: Array, pairs: tuple[tuple[int, int], ...]) -> Array:
    """Outer products of the columns, which the conic turns into scalar products: squares, then the pairs.

    `group` (K, 3, c) are products W V of K views, and the result is (q, 9, K).
    """
    unit = group / np.linalg.norm(group, axis=(1, 2))[:, None, None]
    one, two = np.array([*((n, n) for n in range(group.shape[2])), *pairs]).T
    outer = unit[:, :, None, one] * unit[:, None, :, two]
    return np.ascontiguousarray(outer.reshape(len(group), 9, -1).transpose(2, 1, 0))


def _conic(p: Array) -> tuple[Array, Array]:
    """The image of the absolute conic, W^-T W^-1, gives the scalar products of columns W^-1 h.

    `p` (B, 5) is log W11, W12, log W22, W13, W23. Returns the conic (B, 9) and its derivatives by p
    (B, 5, 9).
    """
    log_a, s, log_b, u, v = p.T
    a, b = np.exp(log_a), np.exp(log_b)
    inverse = np.zeros((len(p), 3, 3))
    inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 0, 2] = 1 / a, -s / (a * b), (s * v / b - u) / a
    inverse[:, 1, 1], inverse[:, 1, 2], inverse[:, 2, 2] = 1 / b, -v / b, 1.0
    conic = np.swapaxes(inverse, 1, 2) @ inverse
    # Row i, column j of W changes the conic by -(h + h^T), h = (column i of the conic) (row j of W^-1).
    half = conic[:, _ROWS, :, None] * inverse[:, _COLUMNS, None]
    half[:, 0] *= a[:, None, None]
    half[:, 2] *= b[:, None, None]
    by_p = -(half + np.swapaxes(half, 2, 3))
    return conic.reshape(-1, 9), by_p.reshape(-1, 5, 9)


_Trial = tuple[Array, Array, Array, Array]  # parameters, their residuals, derivatives and losses


class _Starts:
    """The conditions as a `LeastSquaresProblem`: each of B parameter sets (B, 5) is a group."""

    def __init__(self, conditions: _Conditions, p: Array) -> None:
        self.conditions, self.p = conditions, p.copy()
        self.r, self.J = conditions(self.p)
        self.loss = 0.5 * (self.r * self.r).sum(axis=1)

    @property
    def cost(self) -> Array:
        """(B,) half the sum of squared conditions."""
        return self.loss

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Steps of limited length, damped by the mean of the diagonal, and their predicted gains."""
        J, f = self.J[active], len(self.conditions.free)
        H = J @ np.swapaxes(J, 1, 2)
        g = -(J @ self.r[active][..., None])
        diagonal = H.reshape(len(H), -1)[:, :: f + 1]  # a view
        ridge = damping * (diagonal.sum(axis=1) / f + 1e-12)
        diagonal += ridge[:, None]
        step = np.linalg.solve(H, g)
        step = np.minimum(np.maximum(step, -_LONGEST), _LONGEST)
        gain = step * (g - 0.5 * (H @ step - ridge[:, None, None] * step))
        return step[..., 0], gain[..., 0].sum(axis=1)

    def move(self, step: Array, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """The parameters after a step; all of them are valid."""
        trial = self.p[active]
        trial[:, self.conditions.free] += step
        r, J = self.conditions(trial)
        loss = 0.5 * (r * r).sum(axis=1)
        return (trial, r, J, loss), loss, np.ones(len(trial), dtype=bool)

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial for the starts that improved."""
        kept = active[better]
        self.p[kept], self.r[kept], self.J[kept], self.loss[kept] = (values[better] for values in trial)


def cameras_from_products(problem: Problem, groups: Sequence[Group], entries: Array) -> CameraState:
    """Poses of the trained views, given W's entries (1, 5); all points in front.

    Views that are in no group get the identity.
    """
    views = problem.views
    V = views.n_views
    R, t = np.tile(np.eye(3), (V, 1, 1)), np.tile([0.0, 0.0, 2.0], (V, 1))
    W = intrinsic_matrix(entries[0])
    for group in groups:
        rotation, t[group.views] = pose_from_product(W, group.product)
        if group.flat:
            rotation = rotation @ np.swapaxes(views.basis[group.views], 1, 2)
        R[group.views] = rotation
    return CameraState(entries, R, _in_front(views, R, t))


def pose_from_product(W: Array, product: Array) -> tuple[Array, Array]:
    """Poses R (K, 3, 3), t (K, 3) whose D = [R | t] is nearest to W^-1 times the products (K, 3, I).

    The products are those of solid targets (I = 4) or flat boards (I = 3; the third column of R is not
    observed and is r1 x r2), up to scale and sign. t_z is positive, because the normalised origin is the
    points' centroid, which lies in front.
    """
    D = cast("Array", np.linalg.solve(W, product))
    D = D * np.where(D[:, 2, -1] < 0, -1.0, 1.0)[:, None, None]
    M = D[:, :, :-1]
    scale: Array = np.sqrt((M**2).sum((1, 2)) / M.shape[2])
    if M.shape[2] == 2:
        third = cross_matrix(M[:, :, 0]) @ M[:, :, 1:] / scale[:, None, None]
        M = np.concatenate([M, third], axis=2)
    return nearest_rotation(M), D[:, :, -1] / scale[:, None]


def _in_front(views: Views, R: Array, t: Array) -> Array:
    """Move views that an inexact W puts partly behind the camera away along their ray; the new t."""
    # Local coordinates are at most 1, which gives a quick bound that nearly always suffices.
    if (t[:, 2] > np.abs(R[:, 2]).sum(axis=1)).all():
        return t
    depth = (views.local * np.repeat(R[:, 2], views.counts, axis=0)).sum(axis=1)
    lowest = np.minimum.reduceat(depth, views.first)
    return np.asarray(t * (np.maximum(t[:, 2], -_NEAREST * lowest) / t[:, 2])[:, None])

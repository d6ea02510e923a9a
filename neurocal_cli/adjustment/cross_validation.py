"""Leave data out of a fit without fitting again, and cross-validation of a calibration to second order.

At the minimum the error of each group g is nearly a quadratic in the unknowns p that the groups share,

    E_g(p + d) = c_g - 2 g_g . d + d^T S_g d,

with the group's own unknowns eliminated (Schur complement). With S and g summed over all groups, the minimum
without a set F of groups is d = (S - S_F)^-1 (g - g_F). It and its error on the groups left out follow from
these few small matrices: exactly if the problem is linear, otherwise to second order.

The normal matrices of the views are the quadratic model of the reprojection error (3) around its minimum.
With each view's pose eliminated they are `Quadratics` in the shared parameters. So the calibration without
some views, and its error on them (with their poses fitted, as in `evaluate_camera`), follow from the same few
small matrices. For a single view, or views that share nothing, points are left out instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import Arrowhead, Covariance, eliminate, unit_diagonal
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses, folds_of
from neurocal_cli.adjustment.reprojection import POSE, POSE_COLUMNS, free_columns, normal_blocks
from neurocal_cli.adjustment.views import Views, batches_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

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

    @classmethod
    def of(cls, blocks: Array) -> Quadratics:
        """From matrices (G, f + 1, f + 1) of the unknowns and, the last ones, the residuals."""
        return cls(blocks[..., :-1, :-1], blocks[..., :-1, -1], blocks[..., -1, -1])

    @property
    def blocks(self) -> Array:
        """(G, f + 1, f + 1) S bordered by g and the cost."""
        g = self.g[..., None]
        return np.block([[self.S, g], [np.swapaxes(g, 1, 2), self.cost[:, None, None]]])

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


FOLDS = 5
RIDGE = 1e-13
"""Added to the scaled diagonal, so that one undetermined pose does not spoil the other views."""
_GOLDEN = 0.6180339887498949
_Penalty = tuple[Array, Array]  # prior added to the normal matrix (f, f) and to the right side (f,)


@quietly
def reduced(normal: Array, free: NDArray[np.bool_], free_poses: bool) -> Quadratics:
    """Eliminate the poses from normal matrices (..., 12 + K, 12 + K) of `reprojection.normal_blocks`.

    `free` (5 + K,) tells which of A's entries and the distortion coefficients are estimated.
    """
    return _eliminated(normal, free, free_poses)[0]


def _eliminated(normal: Array, free: NDArray[np.bool_], free_poses: bool) -> tuple[Quadratics, Array]:
    """Quadratics, and the poses' response to the shared parameters with their own step; (..., 6, f + 1)."""
    kept = np.append(free_columns(free), normal.shape[-1] - 1)
    if free_poses:
        left, solved = eliminate(normal, kept, POSE_COLUMNS, RIDGE)
    else:
        left, solved = normal[..., kept[:, None], kept], np.zeros((*normal.shape[:-2], 6, len(kept)))
    return Quadratics.of(left), solved


@frozen_dataclass(eq=False)
class Minimum:
    """A calibration at its minimum, linearised."""

    views: Views
    state: CameraState
    # (V, 12 + K, 12 + K) from `adjust`; if the target was estimated, with the efficient scores of the free
    # parameters.
    normal: Array
    free: NDArray[np.bool_]  # (5 + K,) which of A's entries and the distortion coefficients are estimated
    free_poses: bool
    repeated: RepeatedPoses | None = None  # views that share their errors; they stay in the same fold

    @property
    def columns(self) -> NDArray[np.intp]:
        """Columns (f,) of the free parameters in the normal matrices."""
        return free_columns(self.free)

    @cached_property
    def arrow(self) -> Arrowhead:
        """Normal equations of the free parameters, and of the poses if these are free."""
        return Arrowhead.of(self.normal, self.columns, POSE_COLUMNS if self.free_poses else POSE_COLUMNS[:0])

    @cached_property
    def quadratics(self) -> Quadratics:
        """The error of each view, with its pose eliminated."""
        return reduced(self.normal, self.free, self.free_poses)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return int(self.free.sum()) + 6 * len(self.normal) * self.free_poses

    def variance(self, n_equations: float) -> float:
        """Variance of the residuals of so many equations: two for most points; see `measured_directions`."""
        return float(self.normal[:, -1, -1].sum()) / max(n_equations - self.unknowns, 1)

    def covariance(self, n_equations: float, shared: Array | None = None) -> Covariance:
        """From the normal matrices; for so many equations, and for `shared`, see there and `Arrowhead`."""
        return self.arrow.covariance(self.variance(n_equations), shared)


@quietly
def held_out(m: Minimum) -> Array:
    """Squared error of parts of the data when they are held out; (parts,).

    The parts are views, held out in five folds. If the other views do not determine the camera, the parts are
    folds of each view's points.
    """
    if m.views.n_views > 1 and m.free.any():
        lost = held_out_views(m)
        if np.isfinite(lost).all():
            return lost
    return held_out_points(m)


@quietly
def held_out_views(m: Minimum, penalty: _Penalty | None = None) -> Array:
    """Squared error of each view when it is held out; (V,), nan if the others do not determine the camera.

    The penalty is a prior, added to the normal matrix (f, f) of the shared parameters and to its right side
    (f,). Views that repeat a pose are held out together.
    """
    fold = folds_of(len(m.normal), FOLDS) if m.repeated is None else m.repeated.folds(FOLDS)
    return m.quadratics.held_out(fold, penalty)


@quietly
def held_out_points(m: Minimum, penalty: _Penalty | None = None) -> Array:
    """Squared error of the folds of each view's points when they are held out; (V * folds,).

    The folds are wedges of each view's image. Errors of a target are alike in neighbouring points, so random
    folds would reward a model that learns them.
    """
    normal = _by_fold(m.views, m.state, _wedges(m.views))  # (V, F, W, W)
    rest = normal.sum(axis=1, keepdims=True) - normal
    q, solved = _eliminated(rest, m.free, m.free_poses)
    S, g = q.S.sum(axis=0), q.g.sum(axis=0)
    camera = solve_or_nan(S, g) if penalty is None else solve_or_nan(S + penalty[0], g + penalty[1])  # (F, f)
    step = np.zeros((*normal.shape[:2], normal.shape[-1] - 1))
    step[..., m.columns] = camera
    step[..., POSE] = solved[..., -1] - (solved[..., :-1] @ camera[:, :, None])[..., 0]
    return Quadratics.of(normal).at(step).reshape(-1)


def _wedges(views: Views) -> NDArray[np.intp]:
    """(N,) fold of each point: five wedges of each view's image with equally many points."""
    centre = np.add.reduceat(views.pixels, views.first) / views.counts[:, None]
    du, dv = (views.pixels - np.repeat(centre, views.counts, axis=0)).T
    order = np.lexsort((np.arctan2(dv, du), views.index))
    fold = np.empty(len(order), dtype=np.intp)
    fold[order] = views.rank * FOLDS // np.repeat(views.counts, views.counts)
    return fold


def _by_fold(views: Views, state: CameraState, fold: NDArray[np.intp]) -> Array:
    """Normal matrices of each view's points by their fold; (V, F, W, W)."""
    key = views.index * FOLDS + fold
    order = np.argsort(key, kind="stable")
    present, group = np.unique(key[order], return_inverse=True)
    whitening = None if views.whitening is None else views.whitening[order]
    batches = batches_of(views.local[order], views.pixels[order], whitening, group, len(present))
    view = present // FOLDS
    found, _ = normal_blocks(batches, state.of_views(view))
    blocks = np.zeros((views.n_views * FOLDS, *found.shape[1:]))
    blocks[present] = found
    return blocks.reshape(views.n_views, FOLDS, *found.shape[1:])


@quietly
def disagreement(m: Minimum) -> tuple[Array, Array]:
    """Difference (f,) between the shared parameters of two halves of the data, and its covariance (f, f).

    The halves are alternate views (or alternate poses). If half of the views do not determine the camera,
    they are two parts of each view's points. The covariance is for residuals of unit variance; it is nan if a
    half does not determine the camera.
    """
    repeated = m.repeated
    pose = np.arange(m.views.n_views) if repeated is None else repeated.group
    if pose.max() >= 3:
        q = m.quadratics
        half = (pose % 2 == np.arange(2)[:, None]).astype(float)
        S, g = q.summed(half)
        step = solve_or_nan(S, g)
        if np.isfinite(step).all():
            cov = inverse_or_nan(S)
            if repeated is not None and not repeated.none:
                cov = cov @ q.summed(half * repeated.variance[pose])[0] @ cov
            return step[0] - step[1], cov.sum(axis=0)
    # Spread the folds over the target by an irrational stride, to avoid rows and columns.
    by_fold = _by_fold(m.views, m.state, (m.views.rank * _GOLDEN % 1.0 * FOLDS).astype(np.intp))
    two = np.stack([by_fold[:, :2].sum(axis=1), by_fold[:, 2:4].sum(axis=1)], axis=1)
    q = reduced(two, m.free, m.free_poses)
    S, g = q.S.sum(axis=0), q.g.sum(axis=0)
    step = solve_or_nan(S, g)
    if not np.isfinite(step).all():
        return step[0] - step[1], np.full(S.shape[1:], np.nan)
    return step[0] - step[1], inverse_or_nan(S).sum(axis=0)

"""Cross-validation of a calibration to second order, without calibrating again.

The normal matrices of the views are the quadratic model of the reprojection error (3) around its minimum.
With each view's pose eliminated they are the `Quadratics` of `adjustment.leave_out` in the shared
parameters. So the calibration without some views, and its error on them (with their poses fitted, as in
`evaluate_camera`), follow from the same few small matrices. For a single view, or views that share nothing,
points are left out instead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.leave_out import (
    Quadratics,
    folds_of,
    inverse_or_nan,
    quietly,
    solve_or_nan,
)
from neurocal_cli.adjustment.normal_equations import eliminate
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.reprojection import POSE, POSE_COLUMNS, free_columns, normal_blocks
from neurocal_cli.adjustment.views import Views, batches_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

FOLDS = 5
_RIDGE = 1e-13  # added to the scaled diagonal, so that one undetermined pose does not spoil the other views
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
        left, solved = eliminate(normal, kept, POSE_COLUMNS, _RIDGE)
    else:
        left, solved = normal[..., kept[:, None], kept], np.zeros((*normal.shape[:-2], 6, len(kept)))
    return Quadratics(left[..., :-1, :-1], left[..., :-1, -1], left[..., -1, -1]), solved


@frozen_dataclass(eq=False)
class Minimum:
    """A calibration at its minimum."""

    views: Views
    state: CameraState
    normal: Array  # (V, 12 + K, 12 + K) from `adjust`
    free: NDArray[np.bool_]  # (5 + K,) of A's entries and the distortion coefficients
    free_poses: bool
    repeated: RepeatedPoses | None = None  # views that repeat a pose; they stay in the same fold


@quietly
def held_out(m: Minimum) -> Array:
    """Squared error of parts of the data when they are held out; (parts,).

    The parts are views, held out in five folds. If the other views do not determine the camera, the parts are
    folds of each view's points.
    """
    if m.views.n_views > 1 and m.free.any():
        lost = held_out_views(m.normal, m.free, m.free_poses, repeated=m.repeated)
        if np.isfinite(lost).all():
            return lost
    return held_out_points(m.views, m.state, m.free, m.free_poses)


@quietly
def held_out_views(
    normal: Array,
    free: NDArray[np.bool_],
    free_poses: bool,
    penalty: _Penalty | None = None,
    repeated: RepeatedPoses | None = None,
) -> Array:
    """Squared error of each view when it is held out; (V,), nan if the others do not determine the camera.

    `normal`, `free` and `free_poses` are as for `reduced`. The penalty is a prior, added to the normal matrix
    (f, f) of the shared parameters and to its right side (f,). Views that repeat a pose are held out
    together.
    """
    q = reduced(normal, free, free_poses)
    fold = folds_of(len(q.cost), FOLDS) if repeated is None else repeated.folds(FOLDS)
    return q.held_out(fold, penalty)


@quietly
def held_out_points(
    views: Views,
    state: CameraState,
    free: NDArray[np.bool_],
    free_poses: bool,
    penalty: _Penalty | None = None,
) -> Array:
    """Squared error of the folds of each view's points when they are held out; (V * folds,).

    The folds are wedges of each view's image. Errors of a target are alike in neighbouring points, so random
    folds would reward a model that learns them.
    """
    normal = _by_fold(views, state, _wedges(views))  # (V, F, W, W)
    rest = normal.sum(axis=1, keepdims=True) - normal
    q, solved = _eliminated(rest, free, free_poses)
    S, g = q.S.sum(axis=0), q.g.sum(axis=0)
    camera = solve_or_nan(S, g) if penalty is None else solve_or_nan(S + penalty[0], g + penalty[1])  # (F, f)
    step = np.zeros((*normal.shape[:2], normal.shape[-1] - 1))
    step[..., free_columns(free)] = camera
    step[..., POSE] = solved[..., -1] - (solved[..., :-1] @ camera[:, :, None])[..., 0]
    return Quadratics(normal[..., :-1, :-1], normal[..., :-1, -1], normal[..., -1, -1]).at(step).reshape(-1)


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
        q = reduced(m.normal, m.free, m.free_poses)
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

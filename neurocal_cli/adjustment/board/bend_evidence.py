"""Evidence for bends of single views: their most probable size, and cross-validation.

The bends of a view are unknowns besides its pose (`information`), with a Gaussian prior of the same size in
all views. The size maximises the evidence, with cameras, poses and bends integrated out.

The bends must also predict points of views from which the camera was not estimated. In each held-out view,
half of the points determine the pose and, with the size of the bends as its prior, the bend; the other half
is predicted. The prediction must be better with bends than without. In addition, no view may bend far more
than the others, because a single odd view is no bending board, and the bends must not be common to all views.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from neurocal_cli.adjustment.board.information import Information, Sight, of_views, without_points
from neurocal_cli.adjustment.board.posterior import camera_step_of, log_evidence
from neurocal_cli.adjustment.leave_out import least_by_precision
from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.camera.geometry import Array

_LEAST, _MOST = 1e-6, 1.0  # range of the search, over the target's size, if all errors were noise
_GRID, _FINER = 12, (0.6, 0.3, 0.1)  # grid points, then half-widths of parabolic steps; in the logarithm
_FOLDS = 5
_FAR = 6.0  # largest bend of a view over the rms of the other views
_COMMON = 30.0  # largest common part over the mean square of the rest: exceeded in one random set of 200


def most_probable_precision(info: Information, size: float) -> float:
    """Prior precision of the bends with the highest evidence, in units of the noise precision.

    `info` is around the points that all views share, and `size` that of the target [world unit].
    """
    noise, of_precision = info.straight().cost / info.spare, evidence_by_precision(info)

    def evidence(log_size: Array) -> Array:
        return of_precision(noise * np.exp(-2 * log_size))

    grid = np.linspace(np.log(_LEAST * size), np.log(_MOST * size), _GRID)
    values = evidence(grid)
    best = int(np.argmax(values))
    x, highest = float(grid[best]), float(values[best])
    for width in _FINER:
        low, high = evidence(np.array([x - width, x + width])).tolist()
        curved = low - 2 * highest + high
        step = 0.5 * (low - high) / curved * width if curved < 0 else np.sign(high - low) * width
        x += float(np.clip(step, -width, width))
        highest = float(evidence(np.array([x]))[0])
    return float(noise * np.exp(-2 * x))


def evidence_by_precision(info: Information) -> Callable[[Array], Array]:
    """Log evidence (k,) of the given target as a function of prior precisions (k,) of the bends.

    With the poses eliminated, the three bend coefficients of each view are diagonalised once.
    """
    Q, X, B = info.pose[:, :6, :6], info.pose[:, :6, 6:], info.pose[:, 6:, 6:]
    root = np.linalg.inv(np.linalg.cholesky(Q))
    by_camera = np.concatenate([info.pose_camera, info.pose_right[..., None]], axis=2)
    rows, of_bends = root @ by_camera[:, :6], root @ X
    back = np.swapaxes(of_bends, 1, 2)
    values, vectors = np.linalg.eigh(B - back @ of_bends)
    values = np.maximum(values, 0.0).ravel()
    along = np.swapaxes(vectors, 1, 2) @ (by_camera[:, 6:] - back @ rows)
    f, flat, along = len(info.camera), rows.reshape(-1, rows.shape[2]), along.reshape(-1, rows.shape[2])
    M = np.empty((f + 1, f + 1))
    M[:f, :f], M[f, :f], M[:f, f], M[f, f] = info.camera, info.camera_right, info.camera_right, info.cost
    M -= flat.T @ flat
    logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
    least = least_by_precision(M, values, along)

    def evidence(precision: Array) -> Array:
        cost, by_bends = least(precision)
        both = zip(cost.tolist(), (logdet + by_bends).tolist(), strict=True)
        return np.array([log_evidence(info.spare, *one) for one in both])

    return evidence


def bends_are_valid(sight: Sight, bends: Array, precision: float) -> bool:
    """Whether the bends are consistent over the views and improve the prediction of held-out views.

    The sight is at the minimum for these bends (V, 3) [world unit]; `precision` is that of their prior, in
    units of the noise precision.
    """
    if not _consistent(bends):
        return False
    ratio = 0.0  # log ratio, so that a fold whose camera comes from few views does not outweigh the others
    n_folds = min(sight.views.n_views, _FOLDS)
    halves = [without_points(sight.of_points(sight.views.rank % 2 == half)) for half in (0, 1)]
    whole = halves[0] + halves[1]
    for fold in range(n_folds):
        out = np.arange(sight.views.n_views) % n_folds == fold
        rest, own = of_views(sight, whole, ~out), [of_views(sight, half, out) for half in halves]
        bent, straight = _lost(rest, own, precision), _lost(rest, own, None)
        if not min(bent, straight) > 0:  # rounding: a camera that fits nothing predicts nothing
            return False
        ratio += math.log(bent / straight)
    return bool(ratio < 0)


def _consistent(bends: Array) -> bool:
    """Whether no view is bent far more than the others, and the bends are not common to all views."""
    V, mean = len(bends), bends.mean(axis=0)
    squares = (bends**2).sum(axis=1)
    of_others = (squares.sum() - squares) / (V - 1)
    spread = ((bends - mean) ** 2).sum() / (V - 1)
    return bool((squares <= _FAR**2 * of_others).all() and V * (mean**2).sum() <= _COMMON * spread)


def _lost(others: Information, halves: list[Information], precision: float | None) -> float:
    """Squared error of both halves of the points, each predicted with poses and bends of the other half."""
    if precision is None:
        others, halves = others.straight(), [half.straight() for half in halves]
        held = others, *halves
    else:
        held = tuple(info.held(precision) for info in (others, *halves))
    camera, lost = camera_step_of(held[0]), 0.0
    for known, info in zip(held[1:], halves[::-1], strict=True):
        right = known.pose_right - known.pose_camera @ camera
        own = solve_scaled(known.pose, right[..., None])[..., 0]  # (P, p) steps of poses and bends
        by_own = info.pose_camera @ camera + 0.5 * (info.pose @ own[..., None])[..., 0] - info.pose_right
        by_camera = 0.5 * info.camera @ camera - info.camera_right
        lost += float(info.cost + 2 * (camera @ by_camera + (own * by_own).sum()))
    return lost

"""Whether an estimated target holds for held-out views: its points, and the bends of single views.

The bends of a view are unknowns besides its pose (`information`), with a Gaussian prior of the same size in
all views. The size maximises the evidence, with cameras, poses and bends integrated out.

The bends must also predict points of views from which the camera was not estimated. In each held-out view,
half of the points determine the pose and, with the size of the bends as its prior, the bend; the other half
is predicted. The prediction must be better with bends than without. In addition, no view may bend far more
than the others, because a single odd view is no bending board, and the bends must not be common to all views.

The evidence assumes independent noise of the stated size. If that is wrong, for example if the stated sigma
of a view is far too small, the offsets of the target can fit the errors of a few views. Therefore the offsets
estimated from the other views must lower the squared error of the held-out views in one of two tests. In the
first, the held-out views have cameras of their own; it is inconclusive if these absorb the stretch or
bend, as with one or two views of a board. In the second, all views share the cameras, and the increase of the
total squared error by the held-out views counts; it is less sensitive if few views determine cameras and
offsets only together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.information import (
    Information,
    Sight,
    joined,
    of_views,
    without_points,
)
from neurocal_cli.adjustment.board.posterior import camera_step, camera_step_of, log_evidence, minimum_of
from neurocal_cli.adjustment.board.prior import Prior, coordinates_of
from neurocal_cli.adjustment.board.system import (
    WithoutPoses,
    hold_untold,
    points_first,
    with_single_points,
)
from neurocal_cli.adjustment.cross_validation import FOLDS, least_by_precision
from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.camera.geometry import Array

_LEAST, _MOST = 1e-6, 1.0  # range of the search, over the target's size, if all errors were noise
_GRID, _FINER = 12, (0.6, 0.3, 0.1)  # grid points, then half-widths of parabolic steps; in the logarithm
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
    own, by_camera = info.cameras.own, info.cameras.cross
    root = np.linalg.inv(np.linalg.cholesky(own[:, :6, :6]))
    rows, of_bends = root @ by_camera[:, :6], root @ own[:, :6, 6:]
    back = np.swapaxes(of_bends, 1, 2)
    values, vectors = np.linalg.eigh(own[:, 6:, 6:] - back @ of_bends)
    values = np.maximum(values, 0.0).ravel()
    along = np.swapaxes(vectors, 1, 2) @ (by_camera[:, 6:] - back @ rows)
    flat, along = rows.reshape(-1, rows.shape[2]), along.reshape(-1, rows.shape[2])
    logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
    least = least_by_precision(info.cameras.shared - flat.T @ flat, values, along)

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
    n_folds = min(sight.views.n_views, FOLDS)
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
        step = np.append(camera, -1.0)
        own = solve_scaled(known.cameras.own, -(known.cameras.cross @ step)[..., None])  # of poses and bends
        by_own = 2 * (info.cameras.cross @ step)[..., None] + info.cameras.own @ own
        lost += float(step @ info.cameras.shared @ step + (own * by_own).sum())
    return lost


_FEWEST = 4  # fewest views, so that the others determine a camera


def folds_of(n_views: Sequence[int]) -> list[NDArray[np.intp]]:
    """The fold of each view (V,) of each camera; a single one if there are too few views for a test."""
    n_folds = min(max(n_views), FOLDS) if sum(n_views) >= _FEWEST else 1
    return [np.arange(n) % n_folds for n in n_views]


def passes_cross_validation(
    without: Sequence[WithoutPoses], prior: Prior, sizes: Mapping[str, float], variance: float
) -> bool:
    """Whether offsets estimated from the other views fit the held-out ones; True if that cannot be tested.

    The parts are the folds, in the whole offsets along each point's axes and with the prior of the bends of
    single views, if any. `variance` [px^2] is that of the noise.
    """
    if len(without) == 1:
        return True
    parts = [part.info for part in without]
    folds = np.arange(len(parts))
    try:
        estimated = [found for _, found in without_each(without, prior, sizes, variance)]
    except np.linalg.LinAlgError:
        return True
    tried = np.stack([np.zeros((len(parts[0].point), 3)), *estimated])
    # Costs minimised over cameras and poses: without offsets, and with those from all but each fold.
    terms = [np.stack(term) for term in zip(*(some.at(tried) for some in without), strict=True)]
    sums = [term.sum(axis=0) for term in terms]
    whole, out = _least(*sums), _least(*terms)
    rest = _least(*(total - term for total, term in zip(sums, terms, strict=True)))
    own = out[folds, 1 + folds], rest[folds, 1 + folds]
    alone = (own[0] - out[:, 0]).sum()
    together = (whole[1:] - own[1] + rest[:, 0]).sum() - len(parts) * whole[0]
    return bool(alone < 0 or together < 0)


def _least(S: Array, g: Array, cost: Array) -> Array:
    """Costs (..., k) minimised over the cameras."""
    return np.asarray(cost - (g * camera_step(S, g)).sum(axis=-2))


def without_each(
    parts: Sequence[WithoutPoses], prior: Prior, sizes: Mapping[str, float], variance: float
) -> list[tuple[Array, Array]]:
    """Step (f,) of the cameras and offsets (n, 3) from all parts but one, for each part left out.

    The parts are of different views of the same cameras, in the whole offsets along each point's axes, and
    `variance` [px^2] is that of the noise. Raises `numpy.linalg.LinAlgError` if the other parts do not
    determine the cameras.
    """
    if points_first(sum(part.info.cameras.cross[..., -1].size for part in parts), prior):
        rest = ([part.info for part in parts if part is not out] for out in parts)
        return [minimum_of(with_single_points(joined(some), prior), sizes, variance) for some in rest]
    f, whole = len(parts[0].info.cameras.shared) - 1, np.asarray(sum(part.matrix for part in parts))
    whole[f:-1, f:-1] += variance * coordinates_of(prior).precision(sizes)
    estimated = []
    for out in parts:
        M = whole - out.matrix
        hold_untold(M, f)
        step = np.asarray(np.linalg.solve(M[:-1, :-1], M[:-1, -1]))
        estimated.append((step[:f], step[f:].reshape(-1, 3)))
    return estimated

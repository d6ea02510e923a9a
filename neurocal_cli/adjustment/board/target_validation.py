"""Cross-validation of an estimated target: the offsets must explain held-out views.

The evidence assumes independent noise of the stated size. If that is wrong, for example if the stated sigma
of a view is far too small, the offsets of the target can fit the errors of a few views. Therefore the offsets
estimated from the other views must lower the squared error of the held-out views in one of two tests. In the
first, the held-out views have cameras of their own; it is inconclusive if these absorb the stretch or
bend, as with one or two views of a board. In the second, all views share the cameras, and the increase of the
total squared error by the held-out views counts; it is less sensitive if few views determine cameras and
offsets only together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.information import Information, joined, joined_without_each
from neurocal_cli.adjustment.board.posterior import camera_step, minimum_of
from neurocal_cli.adjustment.board.prior import Prior, coordinates_of
from neurocal_cli.adjustment.board.system import points_first
from neurocal_cli.adjustment.board.without_poses import WithoutPoses, sum_of
from neurocal_cli.camera.geometry import Array

_FEWEST = 4  # fewest views, so that the others determine a camera
_FOLDS = 5


def folds_of(n_views: Sequence[int]) -> list[NDArray[np.intp]]:
    """The fold of each view (V,) of each camera; a single one if there are too few views for a test."""
    n_folds = min(max(n_views), _FOLDS) if sum(n_views) >= _FEWEST else 1
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
    # A camera with fewer views than folds is missing in some folds.
    seen = [np.diagonal(part.camera) > 0 for part in parts]
    by_parts = all(some.all() for some in seen)
    try:
        if by_parts:
            estimated = [found for _, found in without_each(without, prior, sizes, variance)]
        else:
            others = [_seen(rest) for rest in joined_without_each(parts)]
            estimated = [minimum_of(some, prior, sizes, variance)[1] for some in others]
    except np.linalg.LinAlgError:
        return True
    tried = np.stack([np.zeros_like(parts[0].point_right), *estimated])
    # Costs minimised over cameras and poses: without offsets, and with those from all but each fold.
    if by_parts:
        terms = [np.stack(term) for term in zip(*(some.at(tried) for some in without), strict=True)]
        sums = [term.sum(axis=0) for term in terms]
        whole = _least(*sums)
        out = _least(*terms)
        rest = _least(*(total - term for total, term in zip(sums, terms, strict=True)))
    else:
        whole = _least(*WithoutPoses(joined(parts)).at(tried))
        out = np.stack([_least(*WithoutPoses(_seen(part)).at(tried)) for part in parts])
        rest = np.stack([_least(*WithoutPoses(other).at(tried)) for other in others])
    own = out[folds, 1 + folds], rest[folds, 1 + folds]
    alone = (own[0] - out[:, 0]).sum()
    together = (whole[1:] - own[1] + rest[:, 0]).sum() - len(parts) * whole[0]
    return bool(alone < 0 or together < 0)


def _seen(info: Information) -> Information:
    """Information without the cameras that have no views."""
    return info.of_cameras(np.diagonal(info.camera) > 0)


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
    if points_first(sum(part.info.pose_right.size for part in parts), prior):
        others = joined_without_each([part.info for part in parts])
        return [minimum_of(some, prior, sizes, variance) for some in others]
    matrices = [part.matrix for part in parts]
    f = len(parts[0].info.camera)
    whole = sum_of(matrices)
    whole[f:-1, f:-1] += variance * coordinates_of(prior).precision(sizes)
    estimated = []
    for out in matrices:
        M = whole - out
        x = np.asarray(np.linalg.solve(M[:-1, :-1], M[:-1, -1]))
        estimated.append((x[:f], x[f:].reshape(-1, 3)))
    return estimated

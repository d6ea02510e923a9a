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

from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information, Sight, information_of, joined
from neurocal_cli.target_shape.posterior import camera_step, minimum_of, prior_covariance
from neurocal_cli.target_shape.prior import Prior
from neurocal_cli.target_shape.system import WithoutPoses

_FEWEST = 4  # fewest views, so that the others determine a camera
_FOLDS = 5


def passes_cross_validation(
    sights: Sequence[Sight],
    prior: Prior,
    offsets: Array,
    sizes: Mapping[str, float],
    variance: float,
    precision: float = 1.0,
) -> bool:
    """Whether offsets estimated from the other views fit the held-out ones; True if that cannot be tested.

    The sights are at the minimum for the estimated target with these offsets (n, 3), along each point's axes,
    and `variance` [px^2] is that of the noise. `precision` is that of the prior of the bends of single views,
    if any, in units of the noise precision.
    """
    n_views = max(sight.views.n_views for sight in sights)
    if sum(sight.views.n_views for sight in sights) < _FEWEST:
        return True

    def information(folds: NDArray[np.intp]) -> Information:
        which = [np.isin(np.arange(sight.views.n_views) % n_folds, folds) for sight in sights]
        some = [sight.of_views(np.flatnonzero(w)) for sight, w in zip(sights, which, strict=True) if w.any()]
        info = information_of(some, len(offsets)).turned(prior.axes).around_given(offsets)
        return info.held(precision)

    n_folds = min(n_views, _FOLDS)
    parts = [information(np.array([fold])) for fold in range(n_folds)]
    # A camera with fewer views than folds is missing in some folds.
    by_parts = len({len(part.camera) for part in parts}) == 1
    folds = np.arange(n_folds)
    try:
        if by_parts:
            estimated = [found for _, found in without_each(parts, prior, sizes, variance)]
        else:
            others = [information(folds[folds != fold]) for fold in range(n_folds)]
            estimated = [minimum_of(some, prior, sizes, variance)[1] for some in others]
    except np.linalg.LinAlgError:
        return True
    tried = np.stack([np.zeros_like(offsets), *estimated])
    # Costs minimised over cameras and poses: without offsets, and with those from all but each fold.
    if by_parts:
        terms = [
            np.stack(term) for term in zip(*(WithoutPoses(part).at(tried) for part in parts), strict=True)
        ]
        sums = [term.sum(axis=0) for term in terms]
        whole = _least(*sums)
        out = _least(*terms)
        rest = _least(*(total - term for total, term in zip(sums, terms, strict=True)))
    else:
        whole = _least(*WithoutPoses(information(folds)).at(tried))
        out = np.stack([_least(*WithoutPoses(part).at(tried)) for part in parts])
        rest = np.stack([_least(*WithoutPoses(other).at(tried)) for other in others])
    own = out[folds, 1 + folds], rest[folds, 1 + folds]
    alone = (own[0] - out[:, 0]).sum()
    together = (whole[1:] - own[1] + rest[:, 0]).sum() - n_folds * whole[0]
    return bool(alone < 0 or together < 0)


def _least(S: Array, g: Array, cost: Array) -> Array:
    """Costs (..., k) minimised over the cameras."""
    return np.asarray(cost - (g * camera_step(S, g)).sum(axis=-2))


def without_each(
    parts: Sequence[Information], prior: Prior, sizes: Mapping[str, float], variance: float
) -> list[tuple[Array, Array]]:
    """Step (f,) of the cameras and offsets (n, 3) from all parts but one, for each part left out.

    The parts are of different views of the same cameras, in the whole offsets along each point's axes, and
    `variance` [px^2] is that of the noise. Raises `numpy.linalg.LinAlgError` if the other parts do not
    determine the cameras.
    """
    if 3 * len(prior.axes) > sum(part.pose_right.size for part in parts):
        others = (joined([part for part in parts if part is not out]) for out in parts)
        return [minimum_of(some, prior, sizes, variance) for some in others]
    matrices = [WithoutPoses(part).matrix() for part in parts]
    f = len(parts[0].camera)
    precision = np.zeros_like(matrices[0][:-1, :-1])
    precision[f:, f:] = variance * np.linalg.inv(prior_covariance(prior, sizes))
    whole = sum(matrices)
    estimated = []
    for out in matrices:
        M = whole - out
        x = np.asarray(np.linalg.solve(M[:-1, :-1] + precision, M[:-1, -1]))
        estimated.append((x[:f], x[f:].reshape(-1, 3)))
    return estimated

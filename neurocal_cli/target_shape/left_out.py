"""Whether a target that was found explains views that it was not found from.

The evidence takes errors for independent noise of the stated size. Where they are not, as with a view whose
stated sigma is far too small, offsets of the target can follow the errors of a few views. Views left out
tell: the offsets that the other views give must lower their squared error, alone or together with the
cameras that the other views give. Alone, beside cameras of their own: those of one or two views of a board
take in its stretch or its bend, and then this tells nothing. Together, by what the views left out add to the
squared error of the others: where a few views tell cameras and offsets only as a whole, this tells less.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information, Sight, information_of, joined
from neurocal_cli.target_shape.posterior import cost_at, known_sizes
from neurocal_cli.target_shape.prior import Prior

_FEWEST = 4  # views, so that the others determine a camera
_FOLDS = 5


def holds_for_views_left_out(
    sights: Sequence[Sight],
    prior: Prior,
    offsets: Array,
    sizes: Mapping[str, float],
    variance: float,
    precision: float = 1.0,
) -> bool:
    """See whether the offsets of the other views suit those left out; True where nobody can tell.

    Parameters
    ----------
    sights : sequence of Sight
        At the minimum for the target that was found.
    prior : Prior
    offsets : (n, 3) array
        Along each point's axes.
    sizes : dict of float by name [world unit]
    variance : float [px^2]
        Of the noise.
    precision : float
        Of bends of each view, in units of the noise's, where the target has some.
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
    # A camera with fewer views than there are folds is missing in some.
    by_parts = len({len(part.camera) for part in parts}) == 1

    def of(folds: list[int]) -> Information:
        return joined([parts[fold] for fold in folds]) if by_parts else information(np.array(folds))

    everything = list(range(n_folds))
    whole, nothing = of(everything), np.zeros_like(offsets)
    alone, together = 0.0, -n_folds * cost_at(whole, nothing)
    for fold, out in enumerate(parts):
        others = of(everything[:fold] + everything[fold + 1 :])
        try:
            told = known_sizes(others, prior, sizes, variance).offsets
        except np.linalg.LinAlgError:
            return True
        alone += cost_at(out, told) - cost_at(out, nothing)
        together += cost_at(whole, told) - cost_at(others, told) + cost_at(others, nothing)
    return alone < 0 or together < 0

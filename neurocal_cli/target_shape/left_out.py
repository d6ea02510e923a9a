"""Whether a target that was found explains views that it was not found from.

The evidence takes errors for independent noise of the stated size. Where they are not, as with a view whose
stated sigma is far too small, offsets of the target can follow the errors of a few views. Half of the views
tell: the offsets that one half gives must lower the squared error of the other one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Sight, information_of
from neurocal_cli.target_shape.posterior import cost_at, known_sizes
from neurocal_cli.target_shape.prior import Prior

__all__ = ["holds_for_views_left_out"]

_FEWEST = 4  # views, of which halves determine a camera


def holds_for_views_left_out(
    sights: Sequence[Sight], prior: Prior, offsets: Array, sizes: Mapping[str, float], variance: float
) -> bool:
    """See whether the offsets of each half of the views suit the other half; True where nobody can tell.

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
    """
    if sum(sight.views.n_views for sight in sights) < _FEWEST:
        return True
    halves = [[half for sight in sights if (half := _half(sight, k)) is not None] for k in (0, 1)]
    infos = [information_of(half, len(offsets)).turned(prior.axes).around_given(offsets) for half in halves]
    found = given = 0.0
    for mine, other in (infos, infos[::-1]):
        try:
            told = known_sizes(mine, prior, sizes, variance).offsets
        except np.linalg.LinAlgError:
            return True
        found += cost_at(other, told)
        given += cost_at(other, np.zeros_like(told))
    return found < given


def _half(sight: Sight, first: int) -> Sight | None:
    """Every other view of a camera."""
    some = np.arange(first, sight.views.n_views, 2)
    if not some.size:
        return None
    state = replace(sight.state, R=sight.state.R[some], t=sight.state.t[some])
    label = sight.label[np.isin(sight.views.index, some)]
    return replace(sight, views=sight.views.subset(some), state=state, label=label)

"""Which fits to believe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.batched_newton import BLUR, CONTRAST, MEAN, BatchFit
from neurocal_cli.detection.fitting.map_fit import median
from neurocal_cli.geometry import Array

__all__ = ["is_reliable", "is_typical"]

_LEAST_CONTRAST, _MOST_CONTRAST = 0.6, 1.6  # of what is expected
_MOST_BLUR = 2.0  # times what is expected, or its inverse
_MOST_BEYOND = 0.3
_LEAST_COUNT = 8
_LIMIT = 6.0  # standard deviations
_ROUGH = 0.5  # relative excess of chi2 that is never held against a fit
_LEAST_SHARE = 0.2  # of good fits; fewer are so by chance, and what they share is not the board's
_MOST_SPREAD = 0.5  # standard deviation of an offset, in sigma; more is a fit to noise
# The last step may have this many standard deviations, or be so long [px]: sharp pictures leave little
# noise, and less than what the model of their edges is good for.
_MOST_STEP, _MOST_MOVE = 1.0, 0.03


def is_typical(fit: BatchFit) -> NDArray[np.bool_]:
    """(E,) whether fits look like those of most of the board: enough to learn from them."""
    contrast = fit.values[:, CONTRAST] / median(fit.values[:, CONTRAST])
    rough = fit.chi2 / np.maximum(fit.count, 1)
    usual = median(rough)
    scatter = 1.4826 * median(np.abs(rough - usual)) + 0.2 * usual
    return (contrast > _LEAST_CONTRAST**2) & (rough < usual + 4 * scatter) & (fit.count >= _LEAST_COUNT)


def is_reliable(fit: BatchFit, departure: Array, beyond: Array) -> NDArray[np.bool_]:
    """(E,) whether fits agree with their pixels, the rest of the board, and the map.

    Parameters
    ----------
    fit : Fit
    departure : (E,) array
        Of the place from the map, in standard deviations.
    beyond : (E,) array
        Share of the pixels that lie outside the image.
    """
    contrast = fit.values[:, CONTRAST] / fit.prior.mean[:, CONTRAST]
    blur = fit.values[:, BLUR] / fit.prior.mean[:, BLUR]
    good = (contrast > _LEAST_CONTRAST) & (contrast < _MOST_CONTRAST)
    good &= (blur < _MOST_BLUR) & (blur > 1 / _MOST_BLUR)
    good &= (beyond <= _MOST_BEYOND) & (fit.count >= _LEAST_COUNT)
    # Offsets of the lines are every other value.
    offsets = range(0, fit.values.shape[1] + MEAN, 2)
    spread = fit.covariance[:, offsets, offsets]
    good &= (spread > 0).all(axis=1)
    moved = fit.step * np.sqrt(np.maximum(spread.max(axis=1), 0.0))
    good &= (fit.step < _MOST_STEP) | (moved < _MOST_MOVE)
    good &= spread.max(axis=1) < (_MOST_SPREAD * fit.values[:, BLUR]) ** 2
    good &= np.abs(departure) < _LIMIT
    rough = fit.chi2 / np.maximum(fit.count, 1)
    usual = median(rough[good]) if good.any() else 1.0
    scatter = 1.4826 * median(np.abs(rough[good] - usual)) if good.any() else 0.0
    chance = usual * np.sqrt(2 / np.maximum(fit.count, 1))
    good &= rough - usual < _LIMIT * np.maximum(scatter, chance) + _ROUGH * usual
    return good & (good.mean() > _LEAST_SHARE) if len(good) else good

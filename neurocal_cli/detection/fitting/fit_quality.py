"""Reject fits that disagree with their pixels, with the rest of the board, or with the map.

In: fits. Out: masks of the typical fits, from which common parameters are estimated, and of the reliable
fits, which are reported.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import BLUR, CONTRAST, MEAN, BatchFit
from neurocal_cli.detection.medians import MAD_TO_SIGMA, upper_median

# Insensitive as long as they admit a ratio of 1 to the prior, and fits of 8 pixels for the smallest squares.
# tests/test_measuring.py counts the fits of hidden edges that are accepted.
_LEAST_CONTRAST, _MOST_CONTRAST = 0.6, 1.6  # relative to the prior
# In a shadow or far from a lamp: least contrast relative to the board's median, and number of neighbours that
# have such a contrast, too.
_FAINTEST, _NEIGHBOURS = 0.12, 9
_MOST_BLUR = 2.0  # greatest ratio to the prior, or of the prior to it
_MOST_BEYOND = 0.3  # greatest share of the pixels outside the image
_LEAST_COUNT = 8  # pixels
_LIMIT = 6.0  # standard deviations, for the distance from the map and for chi2
_ROUGH = 0.5  # relative excess of chi2 that is always accepted
_LEAST_SHARE = 0.2  # least share of good fits; fewer may agree by chance
_MOST_SPREAD = 0.5  # sigma; greatest standard deviation of an offset
# A fit has converged if its last step is below the first limit [standard deviations] or the second [px]. The
# latter is for sharp images, whose noise is below the error of the edge model.
_MOST_STEP, _MOST_MOVE = 1.0, 0.03


def is_typical(fit: BatchFit, place: Array) -> NDArray[np.bool_]:
    """(E,) mask of fits at places (E, 2) [px] with contrast and chi2 like those of most fits of the board.

    Where the light is weaker, it is sufficient to have the contrast of the neighbours.
    """
    contrast = fit.values[:, CONTRAST]
    usual = upper_median(contrast)
    seen = contrast > _LEAST_CONTRAST**2 * usual
    faint = np.flatnonzero(~seen & (contrast > _FAINTEST * usual))
    if len(faint):
        away = ((place[faint, None] - place) ** 2).sum(axis=-1)
        near = np.argsort(away, axis=1)[:, :_NEIGHBOURS]
        seen[faint] = contrast[faint] > _LEAST_CONTRAST * np.median(contrast[near], axis=1)
    rough = fit.chi2_per_pixel
    usual = upper_median(rough)
    scatter = MAD_TO_SIGMA * upper_median(np.abs(rough - usual)) + 0.2 * usual
    return seen & (rough < usual + 4 * scatter) & (fit.count >= _LEAST_COUNT)


def is_reliable(fit: BatchFit, departure: Array, known: Array | None = None) -> NDArray[np.bool_]:
    """(E,) mask of fits that agree with their pixels, the rest of the board, and the map.

    `departure` (E,) is the distance from the map in standard deviations. `known` are values of chi2 per pixel
    of fits that are known to be reliable; without it, the fits are compared with each other.
    """
    contrast = fit.values[:, CONTRAST] / fit.prior.mean[:, CONTRAST]
    blur = fit.values[:, BLUR] / fit.prior.mean[:, BLUR]
    good = (contrast > _LEAST_CONTRAST) & (contrast < _MOST_CONTRAST)
    good &= (blur < _MOST_BLUR) & (blur > 1 / _MOST_BLUR)
    good &= (fit.pixels.beyond <= _MOST_BEYOND) & (fit.count >= _LEAST_COUNT)
    # The values before the levels are alternately the offset and the tilt of a line.
    offsets = range(0, fit.values.shape[1] + MEAN, 2)
    spread = fit.covariance[:, offsets, offsets]
    good &= (spread > 0).all(axis=1)
    moved = fit.step * np.sqrt(np.maximum(spread.max(axis=1), 0.0))
    good &= (fit.step < _MOST_STEP) | (moved < _MOST_MOVE)
    good &= spread.max(axis=1) < (_MOST_SPREAD * fit.values[:, BLUR]) ** 2
    good &= np.abs(departure) < _LIMIT
    rough = fit.chi2_per_pixel
    among = rough[good] if known is None else known
    usual = upper_median(among) if len(among) else 1.0
    scatter = MAD_TO_SIGMA * upper_median(np.abs(among - usual)) if len(among) else 0.0
    chance = usual * np.sqrt(2 / np.maximum(fit.count, 1))
    good &= rough - usual < _LIMIT * np.maximum(scatter, chance) + _ROUGH * usual
    return good & (good.mean() > _LEAST_SHARE) if len(good) else good

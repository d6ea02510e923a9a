"""First fits of a board's edges, each with its own levels, and the tests of these and later fits.

`fit_initial` gives the blur and the profile with which the later fits begin. Fits are rejected if they
disagree with their pixels, with the rest of the board, or with the map: common parameters are estimated from
the typical fits (`is_typical`), and the reliable ones are reported (`is_reliable`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import (
    BLUR,
    CONTRAST,
    MEAN,
    BatchFit,
    LevelPrior,
    ProfileShape,
    fit_batch,
)
from neurocal_cli.detection.fitting.common_parameters import reshaped
from neurocal_cli.detection.fitting.edge_fit import REACH, SHARP, edge_model, edge_pixels, usual_stride
from neurocal_cli.detection.fitting.edge_profile import RESPONSE_TERMS, box_kurtosis, half_widths
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.strips import GridImage, Lines
from neurocal_cli.detection.medians import MAD_TO_SIGMA, upper_median

# Insensitive, except for edges sharper than a pixel ("straight, psf 0.15" in tests/support/rendered.py).
# There, half of _FEW_STEPS raises errors by 50 %, and twice _CLEARLY, which never selects the box, makes them
# 8 times larger.
_SLACK = 0.5  # px, added to the strips because lines are not accurate yet
_FEW_STEPS, _STEPS = 3, 6  # Gauss-Newton steps before and after blur and shape are known
_CLEARLY = 0.97  # ratio of chi2 below which the smooth profile is preferred to the pixel's box
_WORSE = 1.2  # ratio of chi2 above which fits with the new blur are rejected
_BLUR_OFF = 0.2  # relative error of the blur above which the fits are repeated
_LOOSE_LEVEL, _LOOSE_BLUR = 0.2, 0.3  # prior standard deviations relative to contrast and blur

# Insensitive as long as they admit a ratio of 1 to the prior, and fits of 8 pixels for the smallest squares.
# test_measuring.py counts the fits of hidden edges that are accepted.
_LEAST_CONTRAST, _MOST_CONTRAST = 0.6, 1.6  # relative to the prior
# In a shadow or far from a lamp: least contrast relative to the board's median, and number of neighbours that
# have such a contrast, too.
_FAINTEST, _NEIGHBOURS = 0.12, 9
_MOST_BLUR = 2.0  # greatest ratio to the prior, or of the prior to it
_LEAST_COUNT = 8  # pixels
_LIMIT = 6.0  # standard deviations, for the distance from the map and for chi2
_ROUGH = 0.5  # relative excess of chi2 that is always accepted
# Standard deviations beyond which a pixel contradicts a rough fit, greatest share of such pixels, and rounds.
_CONTRADICTS, _MOST_CONTRADICTING, _ROUNDS = 4.0, 0.15, 3
_LEAST_SHARE = 0.2  # least share of good fits; fewer may agree by chance
_MOST_SPREAD = 0.5  # sigma; greatest standard deviation of an offset
# A fit has converged if its last step is below the first limit [standard deviations] or the second [px]. The
# latter is for sharp images, whose noise is below the error of the edge model.
_MOST_STEP, _MOST_MOVE = 1.0, 0.03


def fit_initial(
    grid_image: GridImage,
    lines: Lines,
    offset: Array,
    sigma: float,
    shading: Shading,
    levels: tuple[Array, Array],
    noise: float,
) -> BatchFit:
    """Fit edges with independent levels, from initial distances (E,) from their lines and blur [px].

    `levels` are mean level and half contrast of each edge, two arrays (E,), known roughly. `noise` [DN^2] is
    the variance of a pixel.
    """
    known = np.stack([*levels, np.full(len(offset), sigma)], axis=-1)
    start = np.concatenate([offset[:, None], np.zeros((len(offset), 1)), known], axis=1)
    started = _few_steps(grid_image, lines, start, known, shading, noise)
    typical = is_typical(started, lines.middle)
    found = upper_median(started.values[typical, BLUR]) if typical.any() else sigma
    # The effect of crossing lines on the pixels depends on the blur.
    if abs(found - sigma) > _BLUR_OFF * sigma or (found < SHARP) != (sigma < SHARP):
        known[:, 2] = found
        start = np.where(typical[:, None], started.values, start)
        start[:, BLUR] = found
        again = _with_best_profile(_few_steps(grid_image, lines, start, known, shading, noise), lines, found)
        if upper_median(again.chi2_per_pixel) < _WORSE * upper_median(started.chi2_per_pixel):
            return again
    return _with_best_profile(started, lines, sigma)


def _few_steps(
    grid_image: GridImage, lines: Lines, start: Array, known: Array, shading: Shading, noise: float
) -> BatchFit:
    """Fit with few steps, to estimate the blur; `known` (E, 3) are prior mean level, contrast and blur."""
    blur = known[:, 2]
    data = edge_pixels(grid_image, lines, blur, shading, REACH * blur + _SLACK, usual_stride(lines))
    data = data.weighed(np.full_like(data.root, 1 / noise))
    contrast = np.maximum(known[:, 1:2], noise)  # none where the board is covered
    spread = known * [0.0, 0.0, _LOOSE_BLUR] + contrast * [_LOOSE_LEVEL, _LOOSE_LEVEL, 0.0]
    prior = LevelPrior(known.copy(), (1 / spread**2)[:, :, None] * np.eye(3))
    shape = _blur_profiles(lines, float(blur[0]))[-1]
    return fit_batch(edge_model, data, start, prior, shape, _FEW_STEPS, 0)


def _with_best_profile(started: BatchFit, lines: Lines, sigma: float) -> BatchFit:
    """Continue the fits with each blur profile, and choose the one with the lower chi2."""
    results = []
    for shape in _blur_profiles(lines, sigma):
        fit = started
        if (shape.half is None) != (fit.shape.half is None):
            fit = fit.continued(shape, _FEW_STEPS, 0)
        fit = reshaped(fit, is_typical(fit, lines.middle))
        results.append(fit.continued(fit.shape, _STEPS))
    smooth, box = (upper_median(results[k].chi2_per_pixel) for k in (0, -1))
    # Prefer the pixel's box if they are about equal, as they are if all edges run along the pixels.
    return results[0] if smooth < _CLEARLY * box else results[-1]


def _blur_profiles(lines: Lines, sigma: float) -> list[ProfileShape]:
    """Initial profiles: the Gram-Charlier series and, for sharp images, the pixel's box."""
    none = np.zeros(RESPONSE_TERMS)
    tails = box_kurtosis(lines.normal, np.full(len(lines.normal), sigma))
    shapes = [ProfileShape(tails[:, None] * [1.0, 0.0], none)]
    if sigma < SHARP:
        # The series is tried, too, because sharpening in the camera changes the profile of the pixel's box.
        shapes.append(ProfileShape(np.zeros((len(tails), 2)), none, half_widths(lines.normal)))
    return shapes


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


def without_outlying_pixels(fit: BatchFit, steps: int) -> BatchFit:
    """Repeat fits that disagree with their pixels without the few pixels that contradict them.

    A wire may be before the board, or a program may have drawn lines into the image.
    """
    for _ in range(_ROUNDS):
        rough = fit.chi2_per_pixel
        off = fit.residual**2 > _CONTRADICTS**2 * upper_median(rough)
        few = np.count_nonzero(off, axis=1) < _MOST_CONTRADICTING * fit.count
        which = np.flatnonzero((rough > _roughest(fit, rough)) & few)
        if len(which):
            fit = fit.without(off[which], which, steps)
    return fit


def is_reliable(fit: BatchFit, departure: Array, known: Array | None = None) -> NDArray[np.bool_]:
    """(E,) mask of fits that agree with their pixels, the rest of the board, and the map.

    `departure` (E,) is the distance from the map in standard deviations. `known` are values of chi2 per pixel
    of fits that are known to be reliable; without it, the fits are compared with each other.
    """
    contrast = fit.values[:, CONTRAST] / fit.prior.mean[:, CONTRAST]
    blur = fit.values[:, BLUR] / fit.prior.mean[:, BLUR]
    good = (contrast > _LEAST_CONTRAST) & (contrast < _MOST_CONTRAST)
    good &= (blur < _MOST_BLUR) & (blur > 1 / _MOST_BLUR)
    good &= fit.count >= _LEAST_COUNT
    # The values before the levels are alternately the offset and the tilt of a line.
    offsets = range(0, fit.values.shape[1] + MEAN, 2)
    spread = fit.covariance[:, offsets, offsets]
    good &= (spread > 0).all(axis=1)
    moved = fit.step * np.sqrt(np.maximum(spread.max(axis=1), 0.0))
    good &= (fit.step < _MOST_STEP) | (moved < _MOST_MOVE)
    good &= spread.max(axis=1) < (_MOST_SPREAD * fit.values[:, BLUR]) ** 2
    good &= np.abs(departure) < _LIMIT
    rough = fit.chi2_per_pixel
    good &= rough < _roughest(fit, rough[good] if known is None else known)
    return good & (good.mean() > _LEAST_SHARE) if len(good) else good


def _roughest(fit: BatchFit, among: Array) -> Array:
    """(E,) greatest chi2 per pixel of fits that agree with their pixels, by that `among` others."""
    usual = upper_median(among) if len(among) else 1.0
    scatter = MAD_TO_SIGMA * upper_median(np.abs(among - usual)) if len(among) else 0.0
    chance = usual * np.sqrt(2 / np.maximum(fit.count, 1))
    return np.asarray((1 + _ROUGH) * usual + _LIMIT * np.maximum(scatter, chance))

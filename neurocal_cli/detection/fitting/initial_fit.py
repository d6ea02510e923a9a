"""First fits of a board's edges, each with its own levels, to estimate blur and profile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import BLUR, BatchFit, LevelPrior, ProfileShape, fit_batch
from neurocal_cli.detection.fitting.common_parameters import profile_shape
from neurocal_cli.detection.fitting.edge_fit import REACH, SHARP, edge_model, edge_pixels, usual_stride
from neurocal_cli.detection.fitting.edge_profile import RESPONSE_TERMS, box_kurtosis, half_widths
from neurocal_cli.detection.fitting.fit_quality import is_typical
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.strips import Lines
from neurocal_cli.detection.medians import upper_median

# Insensitive, except for edges sharper than a pixel ("straight, psf 0.15" in tests/rendered.py). There, half
# of _FEW_STEPS raises errors by 50 %, and twice _CLEARLY, which never selects the box, makes them 8 times
# larger.
_SLACK = 0.5  # px, added to the strips because lines are not accurate yet
_FEW_STEPS, _STEPS = 3, 6  # Gauss-Newton steps before and after blur and shape are known
_CLEARLY = 0.97  # ratio of chi2 below which the smooth profile is preferred to the pixel's box
_WORSE = 1.2  # ratio of chi2 above which fits with the new blur are rejected
_BLUR_OFF = 0.2  # relative error of the blur above which the fits are repeated
_LOOSE_LEVEL, _LOOSE_BLUR = 0.2, 0.3  # prior standard deviations relative to contrast and blur


def fit_initial(
    image: NDArray[np.generic],
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
    started = _few_steps(image, lines, start, known, shading, noise)
    typical = is_typical(started, lines.middle)
    found = upper_median(started.values[typical, BLUR]) if typical.any() else sigma
    # The effect of crossing lines on the pixels depends on the blur.
    if abs(found - sigma) > _BLUR_OFF * sigma or (found < SHARP) != (sigma < SHARP):
        known[:, 2] = found
        start = np.where(typical[:, None], started.values, start)
        start[:, BLUR] = found
        again = _with_best_profile(_few_steps(image, lines, start, known, shading, noise), lines, found)
        if upper_median(again.chi2_per_pixel) < _WORSE * upper_median(started.chi2_per_pixel):
            return again
    return _with_best_profile(started, lines, sigma)


def _few_steps(
    image: NDArray[np.generic], lines: Lines, start: Array, known: Array, shading: Shading, noise: float
) -> BatchFit:
    """Fit with few steps, to estimate the blur; `known` (E, 3) are prior mean level, contrast and blur."""
    blur = known[:, 2]
    data = edge_pixels(image, lines, blur, shading, REACH * blur + _SLACK, usual_stride(lines))
    data = data.weighed(np.full_like(data.root, 1 / noise))
    spread = known * [0.0, 0.0, _LOOSE_BLUR] + known[:, 1:2] * [_LOOSE_LEVEL, _LOOSE_LEVEL, 0.0]
    prior = LevelPrior(known.copy(), (1 / spread**2)[:, :, None] * np.eye(3))
    shape = _blur_profiles(lines, float(blur[0]))[-1]
    return fit_batch(edge_model, data, start, prior, shape, _FEW_STEPS, 0)


def _with_best_profile(started: BatchFit, lines: Lines, sigma: float) -> BatchFit:
    """Continue the fits with each blur profile, and choose the one with the lower chi2."""
    results = [_converged(started, lines, shape) for shape in _blur_profiles(lines, sigma)]
    smooth, box = (upper_median(results[k].chi2_per_pixel) for k in (0, -1))
    # Prefer the pixel's box if they are about equal, as they are if all edges run along the pixels.
    return results[0] if smooth < _CLEARLY * box else results[-1]


def _converged(fit: BatchFit, lines: Lines, shape: ProfileShape) -> BatchFit:
    if (shape.half is None) != (fit.shape.half is None):
        fit = fit.continued(shape, _FEW_STEPS, 0)
    return fit.continued(profile_shape(fit, is_typical(fit, lines.middle)), _STEPS)


def _blur_profiles(lines: Lines, sigma: float) -> list[ProfileShape]:
    """Initial profiles: the Gram-Charlier series and, for sharp images, the pixel's box."""
    none = np.zeros(RESPONSE_TERMS)
    tails = box_kurtosis(lines.normal, np.full(len(lines.normal), sigma))
    shapes = [ProfileShape(tails[:, None] * [1.0, 0.0], none)]
    if sigma < SHARP:
        # The series is tried, too, because sharpening in the camera changes the profile of the pixel's box.
        shapes.append(ProfileShape(np.zeros((len(tails), 2)), none, half_widths(lines.normal)))
    return shapes

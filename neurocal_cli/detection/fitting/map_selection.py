"""Selecting the model of the smooth map: the simplest one that the observations do not contradict.

In: a start and observations. Out: the fitted map of the selected model of the start's `models`.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.fitting.map_fit import (
    STEPS,
    MapFit,
    MapSolution,
    Observations,
    loss_of,
    robust_scale,
    solve_map,
    with_covariance,
)
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.geometry import Array

# A richer model must lower chi2 by this much for each of its parameters; chance alone gives 1. Residuals far
# above the noise come from an uneven board, which a polynomial must not follow: the price is higher then.
# Insensitive, as all constants here; tests/test_fit_parts.py selects known models.
_PRICE, _UNEVEN_PRICE = 2.25, 3.0
_FIRST_SHARE = 0.3  # of that price; what the first step must gain for a model to be fitted further
_FUTILE = 2  # richer models without gain, of the lens or the polynomial, after which no more are tried
_UNEVEN = 4.0  # residuals over noise from which a polynomial is tried although no lens model gained


def select_map(
    start: SmoothMap,
    observations: Observations,
    shift: Array,
    enough: float = 0.0,
    least: int = 0,
    most: int | None = None,
) -> MapFit:
    """Fit the simplest model that the observations do not contradict.

    Parameters
    ----------
    start : SmoothMap
        Of any model.
    observations : Observations
    shift : (K,) array [px]
    enough : float
        Chi2 per observation at which no richer model is tried.
    least, most : int
        Indices of the simplest and the richest model that are tried; the richest of all by default.
    """
    best: MapSolution | None = None
    now, paid, futile = start, 0, [0, 0]  # futile: lens models, polynomials
    informative, precision = observations.informative, 1 / np.sqrt(observations.variance)
    n_telling, scale = int(informative.sum()), 0.0
    for radial, degree in start.models[least : None if most is None else most + 1]:
        if futile[degree > 0] >= _FUTILE:
            continue
        now = now.with_model(radial, degree)
        if best is not None and len(now.free) + len(shift) > 0.5 * n_telling:
            break
        count = len(now.free)
        fit = solve_map(
            now, observations, shift, STEPS, _FIRST_SHARE * _price(scale) * scale**2 * (count - paid)
        )
        now, shift = fit.map, fit.shift
        z = fit.residual * precision
        scale = robust_scale(z[informative])
        loss = loss_of(z / scale)
        excess = max(1.0, loss / max(n_telling - count, 1))
        price = _price(scale) * excess * (count - paid)
        if best is None or loss_of(best.residual * precision / scale) - loss > price:
            best, paid, futile = fit, count, [0, 0]
        else:
            futile[degree > 0] += 1
        if loss * scale**2 + _PRICE * count < enough * len(observations.value):
            break
        # A board may be curved although no lens model fits.
        if futile[0] >= _FUTILE and scale < _UNEVEN:
            break
    assert best is not None
    return with_covariance(best, observations)


def _price(scale: float) -> float:
    """Chi2 that each parameter of a richer model must gain, in units of the squared scale."""
    chance = _PRICE / max(scale, 1.0) ** 2
    return max(chance, _UNEVEN_PRICE - chance)

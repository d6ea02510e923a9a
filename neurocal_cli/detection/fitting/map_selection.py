"""Choosing the form of the smooth map: as rich as the points ask for, and no richer."""

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
from neurocal_cli.detection.fitting.smooth_map import MAP_MODELS, SmoothMap
from neurocal_cli.geometry import Array

__all__ = ["select_map"]

# A richer form must lower the chi2 by so much for each of its parameters; chance alone gives 1. Residuals far
# above the noise are those of a board that is uneven by itself: its form is not smooth, and not for a
# polynomial to follow, so that more is asked.
_PRICE, _UNEVEN_PRICE = 2.25, 3.0
_FIRST_SHARE = 0.3  # of that price, which the first step must save for there to be more
_BARREN = 2  # richer forms without gain, of lenses or of polynomials, after which no more are tried
_UNEVEN = 4.0  # times the noise; residuals from which on a polynomial is tried when no lens has gained


def select_map(
    start: SmoothMap,
    observations: Observations,
    shift: Array,
    enough: float = 0.0,
    least: int = 0,
    most: int = len(MAP_MODELS) - 1,
) -> MapFit:
    """The map of the simplest form that the rows do not contradict.

    Parameters
    ----------
    start : SmoothMap
        Of any form.
    rows : Rows
    shift : (K,) array [px]
    enough : float
        Chi2 per row with which no richer form is tried.
    least, most : int
        Indices of the simplest and the richest form that is tried.
    """
    best: MapSolution | None = None
    now, paid, barren = start, 0, [0, 0]  # the latter of lenses, and of polynomials
    informative, precision = observations.informative, 1 / np.sqrt(observations.variance)
    n_telling, scale = int(informative.sum()), 0.0
    for radial, degree in MAP_MODELS[least : most + 1]:
        if barren[degree > 0] >= _BARREN:
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
            best, paid, barren = fit, count, [0, 0]
        else:
            barren[degree > 0] += 1
        if loss * scale**2 + _PRICE * count < enough * len(observations.value):
            break
        # Where no lens bends the board so, it may still be bent itself.
        if barren[0] >= _BARREN and scale < _UNEVEN:
            break
    assert best is not None
    return with_covariance(best, observations)


def _price(scale: float) -> float:
    """Chi2 that each parameter of a richer form must save, in units of the scale's square."""
    chance = _PRICE / max(scale, 1.0) ** 2
    return max(chance, _UNEVEN_PRICE - chance)

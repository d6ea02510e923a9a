"""Robust dense fit of the smooth map, and selection of its model.

This does not use the package's least-squares core, because the problem is different: a dense fit of 8 to 64
parameters to about a hundred observations, 0.5 ms each and eight times per grid. There are no blocks to
eliminate, Tukey's weights change from step to step, and a fit ends early if a model gains too little.

The selected model is the simplest one of the initial map's `models` that the observations do not contradict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.medians import upper_median

# Insensitive.
_STEPS = 25  # greatest number
_SHIFT_PRIOR = 1e-2  # 1/px^2; prior standard deviation of the shifts: 10 px
_TINY = 1e-300
_BELIEF = 20  # weight, in observations, of the prior that the given variances are true
_CREEPING = 5e-3  # relative gain of chi2 below which the iteration ends
_CONVERGED = 0.2  # the same for the gain in units of the squared scale
_DAMPING = 1e-4  # initial damping of the normal equations' scaled diagonal
_ROBUST = 1.5  # standard deviation over the median absolute value, about 1.4826
_TUKEY = 6.0  # standard deviations beyond which an observation is an outlier

# A richer model must lower chi2 by this much for each additional parameter; chance alone gives 1. Residuals
# far above the noise come from an uneven board, which a polynomial must not follow, so the price is higher
# then. Insensitive, like all constants here; test_fit_parts.py selects known models.
_PRICE, _UNEVEN_PRICE = 2.25, 3.0
_FIRST_SHARE = 0.3  # share of that price which the first step must gain for the fit to continue
_FUTILE = 2  # richer lens models, or polynomials, without gain, after which no more are tried
_UNEVEN = 4.0  # ratio of residuals to noise above which polynomials are tried although no lens model gained


@frozen_dataclass(eq=False)
class Observations:
    """N positions measured along one direction each: ``direction . p = value``."""

    grid: Array  # (N, 2) [squares]
    direction: Array  # (N, 2) unit vectors
    value: Array  # (N,) [px]
    variance: Array  # (N,) [px^2]
    shift: Array  # (N, K) derivatives of the values by additional unknowns, which are fitted with the map

    @classmethod
    def of_points(cls, grid: Array, pixels: Array, sigma: float, shifts: int = 0) -> Observations:
        """Observe both coordinates of points (N, 2)."""
        n = len(grid)
        return cls(
            np.tile(grid, (2, 1)),
            np.repeat(np.eye(2), n, axis=0),
            pixels.T.reshape(-1),
            np.full(2 * n, sigma**2),
            np.zeros((2 * n, shifts)),
        )

    @property
    def informative(self) -> NDArray[np.bool_]:
        """(N,) mask of the observations that determine the map; anchors do not, and may be more than half."""
        quarter = len(self.variance) // 4
        return np.asarray(self.variance < 100 * np.partition(self.variance, quarter)[quarter])

    def joined_with(self, other: Observations) -> Observations:
        """Join two sets of observations."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return Observations(*map(np.concatenate, pairs))


@frozen_dataclass(eq=False)
class MapFit:
    """A map fitted to N observations."""

    map: SmoothMap
    shift: Array  # (K,) [px] values of the additional unknowns; see `Observations.shift`
    shift_covariance: Array  # (K, K) [px^2]
    residual: Array  # (N,) [px] value minus map and shift
    weight: Array  # (N,) Tukey's weight, from 1 to 0 for outliers
    # Variance of the good and informative residuals relative to the given variances; shrunk towards 1 if it
    # may differ by chance, at most 1 then.
    excess: float

    @property
    def model_index(self) -> int:
        """Index of the map's model in its `models`."""
        return self.map.models.index((self.map.radial, self.map.degree))


def fit_map(start: SmoothMap, observations: Observations, shift: Array) -> MapFit:
    """Fit a map of the start's model by Levenberg-Marquardt with Tukey's weights, from nearby values."""
    return _with_covariance(_solved_map(start, observations, shift), observations)


def select_map(
    start: SmoothMap,
    observations: Observations,
    shift: Array,
    enough: float = 0.0,
    models: Sequence[tuple[int, int]] | None = None,
) -> MapFit:
    """Fit the simplest model that the observations do not contradict, from a map of any model.

    No richer model is tried once chi2 per observation is below `enough`. The `models` (radial, degree) are
    tried from the simplest to the richest; by default all of the map's `models`.
    """
    best: _Solution | None = None
    now, paid, futile = start, 0, [0, 0]  # futile: lens models, polynomials
    informative, precision = observations.informative, 1 / np.sqrt(observations.variance)
    n_telling, scale = int(informative.sum()), 0.0
    for radial, degree in start.models if models is None else models:
        if futile[degree > 0] >= _FUTILE:
            continue
        now = now.with_model(radial, degree)
        if best is not None and len(now.free) + len(shift) > 0.5 * n_telling:
            break
        count = len(now.free)
        worth = _FIRST_SHARE * _price(scale) * scale**2 * (count - paid)
        fit = _solved_map(now, observations, shift, worth)
        now, shift = fit.map, fit.shift
        z = fit.residual * precision
        scale = _robust_scale(z[informative])
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
    return _with_covariance(best, observations)


def _price(scale: float) -> float:
    """Chi2 that each additional parameter must gain, in units of the squared scale."""
    chance = _PRICE / max(scale, 1.0) ** 2
    return max(chance, _UNEVEN_PRICE - chance)


@frozen_dataclass(eq=False)
class _Solution:
    """A fitted map with shifts, residuals (N,) and derivatives (P, N) of the predictions."""

    map: SmoothMap
    shift: Array
    residual: Array
    jacobian: Array


def _solved_map(start: SmoothMap, observations: Observations, shift: Array, worth: float = 0.0) -> _Solution:
    """Fit a map of the start's model; stop after the first step if it lowers chi2 by less than `worth`."""
    free, m = start.free, len(start.free)
    prior = np.concatenate([start.prior[free], np.full(len(shift), _SHIFT_PRIOR)])
    values = np.concatenate([start.parameters[free], shift])
    places = start.places(observations.grid, np.ascontiguousarray(observations.direction.T))
    inverse_sigma = 1 / np.sqrt(observations.variance)

    def compared(now: SmoothMap, shift: Array) -> tuple[Array, Array]:
        """Residuals (N,) and derivatives (P, N) of the predictions."""
        value, along = now.along(places)
        residual = observations.value - value - observations.shift @ shift
        return residual, np.concatenate([along[free], observations.shift.T])

    residual, jacobian = compared(start, shift)
    # All residuals may be large before the first step, so there are no robust weights yet.
    precision, informative = inverse_sigma * inverse_sigma, observations.informative
    weight, damping, least = precision, _DAMPING, 0.0
    square = residual * residual
    for _ in range(_STEPS):
        weighted = jacobian * weight
        gradient = weighted @ residual - prior * values
        normal = weighted @ jacobian.T
        normal.ravel()[:: len(values) + 1] += prior
        moved = values + _solved(normal, gradient, damping)
        tried = start.moved(free, moved[:m])
        ahead, slopes = compared(tried, moved[m:])
        square_ahead = ahead * ahead
        before = weight @ square + prior @ (values * values)
        after = weight @ square_ahead + prior @ (moved * moved)
        if not after <= before:
            # The parameters are strongly correlated: keep at least this damping from now on.
            damping = least = 10 * damping
            continue
        start, values, residual, jacobian, square = tried, moved, ahead, slopes, square_ahead
        damping = max(0.1 * damping, least)
        if before - after < worth:
            break
        worth = 0.0
        z = residual * inverse_sigma
        scale = _robust_scale(z[informative])
        if before - after < max(_CONVERGED * scale**2, _CREEPING * after) and damping <= max(_DAMPING, least):
            break
        weight = _tukey(z / scale) * precision
    return _Solution(start, values[m:], residual, jacobian)


def loss_of(z: Array) -> float:
    """Chi2 of normalised residuals z (N,), with each term limited to 100 for outliers."""
    return float(np.minimum(z * z, 100.0).sum())


def _tukey(z: Array) -> Array:
    weight = np.maximum(1 - np.square(z * (1 / _TUKEY)), 0)
    return np.square(weight, out=weight)


def _robust_scale(z: Array) -> float:
    """Robust standard deviation of normalised residuals; at least 1.

    So common errors of the map do not turn most observations into outliers.
    """
    return max(1.0, _ROBUST * upper_median(np.abs(z)))


def _solved(normal: Array, gradient: Array, damping: float) -> Array:
    """Solve damped normal equations with scaled parameters."""
    size = 1 / np.sqrt(np.maximum(normal.diagonal(), _TINY))
    scaled = normal * size[:, None] * size
    scaled.ravel()[:: len(size) + 1] += damping
    return np.asarray(size * np.linalg.solve(scaled, gradient * size))


def _with_covariance(solution: _Solution, observations: Observations) -> MapFit:
    """Compute covariance, weights and excess variance of a solution."""
    now, shift, residual, jacobian = solution.map, solution.shift, solution.residual, solution.jacobian
    free, informative = now.free, observations.informative
    z = residual / np.sqrt(observations.variance)
    weight = _tukey(z / _robust_scale(z[informative]))
    good = weight > 0
    normal = (jacobian * (good / observations.variance)) @ jacobian.T
    normal.ravel()[:: len(normal) + 1] += np.concatenate([now.prior[free], np.full(len(shift), _SHIFT_PRIOR)])
    size = 1 / np.sqrt(np.maximum(normal.diagonal(), _TINY))
    inverse = np.linalg.inv(normal * size[:, None] * size) * size[:, None] * size
    informative = good & informative
    left = int(informative.sum()) - len(free) - len(shift)
    excess = float((z[informative] ** 2).sum()) / max(left, 0.2 * len(z))
    shrunk = min(1.0, (excess * left + _BELIEF) / (left + _BELIEF)) if left > 0 else 1.0
    covariance = np.zeros((len(now.parameters),) * 2)
    covariance[free[:, None], free] = inverse[: len(free), : len(free)]
    return MapFit(
        map=replace(now, covariance=covariance),
        shift=shift,
        shift_covariance=inverse[len(free) :, len(free) :].copy(),
        residual=residual,
        weight=weight,
        excess=excess if excess > 1 + 3 * np.sqrt(2 / max(left, 1)) else shrunk,
    )

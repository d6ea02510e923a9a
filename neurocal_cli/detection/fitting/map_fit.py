"""Robust dense fit of the smooth map, and selection of its model.

This does not use the package's least-squares core, because the problem is different: a dense fit of 8 to 64
parameters to about a hundred observations, 0.5 ms each and eight times per grid. There are no blocks to
eliminate, Tukey's weights change from step to step, and a fit ends early if a model gains too little.

The selected model is the simplest one of the initial map's `models` that the observations do not contradict.

For a board in front of a wide lens, the map is made of a homography to directions, a radial profile and a
polynomial. A homography to slopes ends at 90 degrees from the axis, and a power series in slopes diverges
long before. Here a homography maps the scaled grid coordinates x, y to directions, and their angle t from the
axis gives the radius:

    D = R (h0 x + h1 y + h2, h3 x + h4 y + h5, 1 + h6 x + h7 y)
    t = angle between D and the axis,   e = unit vector of (D_u, D_v)
    q = t e sum_k a_k T_k(2 (t / t_max)^2 - 1)
    p = c + ((1 + m) q_u + n q_v, n q_u + (1 - m) q_v) + sum_k b_k T_k(x, y)

R is a fixed rotation of the z axis to the middle of the board, which keeps the homography regular at any
angle from the axis. `wide_start` gives the initial map; everything else is as in `smooth_map`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, fields, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.smooth_map import Frame, Places, SmoothMap
from neurocal_cli.detection.medians import upper_median
from neurocal_cli.detection.wide_lens import fit_wide_lens, frame_along

_HOMOGRAPHY, _PROFILE = 8, 6
_CENTRE, _FIRST = slice(8, 10), 10  # positions of c, and of a_0
_SQUARE = slice(_FIRST + _PROFILE, _FIRST + _PROFILE + 2)  # of m and n
_REST = _SQUARE.stop
# Lenses free c and a_0, then more and more of the others; the last one all but a_2 to a_5.
_LENSES = (
    *(tuple(range(8, stop)) for stop in (11, 12, 13, 14, _SQUARE.start, _REST)),
    (8, 9, 10, 11, *range(_SQUARE.start, _REST)),
)
_ALL, _SIMPLE = 5, 6
# Prior standard deviations of the centre, of the profile beyond a_0, of m and n, and of the polynomial
# [half diagonals].
_CENTRE_PRIOR, _PROFILE_PRIOR, _SQUARE_PRIOR, _REST_PRIOR = 0.1, 0.3, 0.02, 0.1
_ROOM = 1.05  # t_max relative to the angle of the board's outermost vertex
_LEAST = 1e-9


@frozen_dataclass(eq=False)
class WideMap(SmoothMap):
    """A map with its parameters h, c, a, m, n, b, some of which may be fixed at 0."""

    models: ClassVar[tuple[tuple[int, int], ...]] = (
        *((k, 0) for k in range(_ALL + 1)),
        *((_ALL, degree) for degree in (3, 4, 5, 6)),
    )
    # An equidistant lens with pixels that are not square gains nothing by a_1 and a_2 alone, after which no
    # others would be tried.
    simple_models: ClassVar[tuple[tuple[int, int], ...]] = ((0, 0), (1, 0), (_SIMPLE, 0))
    richest_lens: ClassVar[int] = _ALL
    lens_models: ClassVar[tuple[tuple[int, int], ...]] = models[: _ALL + 1]
    lenses: ClassVar[tuple[tuple[int, ...], ...]] = _LENSES
    square: ClassVar[slice] = _SQUARE
    rest: ClassVar[int] = _REST

    turn: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) R
    widest: float = 1.0  # [rad] t_max

    @property
    def prior(self) -> Array:
        """(P,) inverse variances of the prior."""
        sigma = np.full(len(self.parameters), np.inf)
        sigma[_CENTRE], sigma[_FIRST + 1 : _SQUARE.start] = _CENTRE_PRIOR, _PROFILE_PRIOR
        sigma[_SQUARE], sigma[_REST:] = _SQUARE_PRIOR, _REST_PRIOR
        return np.asarray(1 / sigma**2)

    def _through_lens(self, ground: Array) -> Array:
        """Map without the polynomial; see `SmoothMap`."""
        values = self.parameters
        direction, across, angle = self._seen(ground)
        stretch = angle * (values[_FIRST : _SQUARE.start] @ self._profile(angle)[0]) / across
        return np.asarray(values[_CENTRE, None] + self._metric @ (stretch * direction[:2]))

    def along(self, places: Places) -> tuple[Array, Array]:
        """Pixels along the places' directions, and their derivatives; see `SmoothMap.along`."""
        values, axis = self.parameters, places.axis
        out = np.empty((len(values), axis.shape[1]))
        direction, across, angle = self._seen(places.ground)
        towards = direction[:2] / across
        terms, slopes = self._profile(angle)
        a = values[_FIRST : _SQUARE.start]
        level, slope = a @ terms, a @ slopes
        radius = angle * level
        grows = level + angle * slope  # derivative of the radius by the angle
        q = radius * towards
        value = places.origin + axis[0] * values[8] + axis[1] * values[9]
        out[_CENTRE] = axis
        out[_SQUARE.start] = axis[0] * q[0] - axis[1] * q[1]
        out[_SQUARE.start + 1] = axis[0] * q[1] + axis[1] * q[0]
        axis = self._metric @ axis
        outwards = (axis * towards).sum(axis=0)
        value += radius * outwards
        np.multiply(terms, angle * outwards, out=out[_FIRST : _SQUARE.start])
        square = across**2 + direction[2] ** 2
        steep = grows * outwards / square
        by = np.empty_like(direction)
        by[:2] = steep * direction[2] * towards + radius / across * (axis - outwards * towards)
        by[2] = -steep * across
        by = self.turn.T @ by
        ground = places.ground
        np.multiply(by[:2, None], ground, out=out[:6].reshape(2, 3, -1))
        np.multiply(by[2], ground[:2], out=out[6:8])
        if places.rest is not None:
            out[_REST:] = places.rest
            value = value + values[_REST:] @ places.rest
        return value, out

    def _seen(self, ground: Array) -> tuple[Array, Array, Array]:
        """Directions (3, N) of scaled coordinates (3, N), their length across the axis and angle from it."""
        direction = self.turn @ (self._homography @ ground)
        across = np.maximum(np.hypot(direction[0], direction[1]), _LEAST)
        return direction, across, np.arctan2(across, direction[2])

    def _profile(self, angle: Array) -> tuple[Array, Array]:
        """T_k (K, N) of angles (N,), and their derivatives by the angle."""
        w = 2 * (angle / self.widest) ** 2 - 1
        terms, slopes = [np.ones_like(w), w], [np.zeros_like(w), np.ones_like(w)]
        for _ in range(_PROFILE - 2):
            terms.append(2 * w * terms[-1] - terms[-2])
            slopes.append(2 * terms[-2] + 2 * w * slopes[-1] - slopes[-2])
        return np.array(terms), np.array(slopes) * (4 * angle / self.widest**2)


def wide_start(frame: Frame, grid: Array, pixels: Array, size: tuple[int, int]) -> WideMap | None:
    """Fit the map of an equidistant lens to vertices in an image of a size; None if no plane fits them."""
    fit = fit_wide_lens(frame.places(grid), pixels, size)
    if not np.isfinite(fit.rms):
        return None
    scaled = fit.matrix @ np.array(
        [[frame.half[0], 0, frame.origin[0]], [0, frame.half[1], frame.origin[1]], [0, 0, 1.0]]
    )
    turn = frame_along(scaled[:, 2] / np.linalg.norm(scaled[:, 2])).T
    matrix = turn.T @ scaled
    values = np.zeros(_REST)
    values[:_HOMOGRAPHY] = (matrix / matrix[2, 2]).ravel()[:_HOMOGRAPHY]
    values[_CENTRE] = (fit.lens.centre - frame.centre) / frame.unit
    values[_FIRST] = fit.lens.focal / frame.unit
    farthest = np.hypot(*(pixels - fit.lens.centre).T).max() / fit.lens.focal
    return WideMap(frame, values, turn=turn, widest=_ROOM * float(farthest))


# Insensitive.
_STEPS = 25  # greatest number
_SHIFT_PRIOR = 1e-2  # 1/px^2; prior standard deviation of the shifts: 10 px
_TINY = 1e-300
_RARELY = 2.75  # standard deviations of the normal distribution
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
# Most unknowns over the observations that determine the map, if it has a polynomial, and if it is a lens
# alone: without its terms, a small part of a board in a distorted image has up to twenty times the errors.
_MOST_UNKNOWNS, _MOST_OF_LENS = 0.5, 0.92
_FIRST_SHARE = 0.3  # share of that price which the first step must gain for the fit to continue
_FUTILE = 2  # richer lens models, or polynomials, without gain, after which no more are tried
_NOISE = 2.0  # greatest excess variance of residuals that are noise alone
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

    @cached_property
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
        return self.map.models.index((min(self.map.radial, self.map.richest_lens), self.map.degree))


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
    tried from the simplest to the richest; by default all of the map's `models`. Without `enough`,
    the `simple_models` of a map come before these, and suffice if they leave noise alone.
    """
    if start.simple_models and not enough and models is not start.simple_models:
        simple = select_map(start, observations, shift, models=start.simple_models)
        if simple.excess < _NOISE:
            return simple
    best: _Solution | None = None
    now, paid, futile = start, 0, [0, 0]  # futile: lens models, polynomials
    informative, precision = observations.informative, 1 / np.sqrt(observations.variance)
    n_telling, scale = int(informative.sum()), 0.0
    for radial, degree in start.models if models is None else models:
        if futile[degree > 0] >= _FUTILE:
            continue
        now = now.with_model(radial, degree)
        most = _MOST_UNKNOWNS if degree else _MOST_OF_LENS
        if best is not None and len(now.free) + len(shift) > most * n_telling:
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
    # What chance exceeds once in 300 times, by Wilson and Hilferty: few degrees of freedom have a skew chi2.
    third = 2 / (9 * max(left, 1))
    by_chance = (1 - third + _RARELY * np.sqrt(third)) ** 3
    covariance = np.zeros((len(now.parameters),) * 2)
    covariance[free[:, None], free] = inverse[: len(free), : len(free)]
    return MapFit(
        map=replace(now, covariance=covariance),
        shift=shift,
        shift_covariance=inverse[len(free) :, len(free) :].copy(),
        residual=residual,
        weight=weight,
        excess=excess if excess > by_chance else shrunk,
    )

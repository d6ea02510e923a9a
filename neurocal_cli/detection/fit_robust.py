"""Fitting the smooth map to points known along directions, against outliers, and choosing its form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fit_map import Places, SmoothMap
from neurocal_cli.geometry import Array

__all__ = ["FORMS", "MapFit", "Rows", "choose_map", "fit_map", "median"]

# Forms of the map from the simplest on: (radial parameters, degree of the polynomial rest).
FORMS: tuple[tuple[int, int], ...] = ((0, 0), (1, 0), (2, 0), (3, 0), (3, 3), (3, 4), (3, 5), (3, 6))

_STEPS = 25
_SHIFT_PRIOR = 1e-2  # 1/px^2
_TINY = 1e-300
_BELIEF = 20  # rows' worth of belief that variances are what they claim to be
_CREEPING = 5e-3  # of chi2; what is gained so slowly is not worth the steps
_SETTLED = 0.2  # of chi2
_DAMPING = 1e-4  # to begin with, of the normal equations' scaled diagonal
_TUKEY = 6.0  # standard deviations beyond which a row counts as an outlier
# A richer form must lower the chi2 by so much for each of its parameters; chance alone gives 1. Residuals far
# above the noise are those of a board that is uneven by itself: its form is not smooth, and not for a
# polynomial to follow, so that more is asked.
_PRICE, _UNEVEN_PRICE = 2.25, 3.0
_BARREN = 2  # richer forms without gain after which the search ends


@dataclass(frozen=True, eq=False)
class Rows:
    """Positions known along one direction each: ``direction . p = value``.

    Attributes
    ----------
    grid : (N, 2) array [squares]
    direction : (N, 2) array
        Unit vectors.
    value : (N,) array [px]
    variance : (N,) array [px^2]
    shift : (N, K) array
        What else moves the values, linearly, by unknowns that are found along with the map.
    """

    grid: Array
    direction: Array
    value: Array
    variance: Array
    shift: Array

    @classmethod
    def of_points(cls, grid: Array, pixels: Array, sigma: float, shifts: int = 0) -> Rows:
        """Both coordinates of points (N, 2)."""
        n = len(grid)
        return cls(
            np.tile(grid, (2, 1)),
            np.repeat(np.eye(2), n, axis=0),
            pixels.T.reshape(-1),
            np.full(2 * n, sigma**2),
            np.zeros((2 * n, shifts)),
        )

    @property
    def telling(self) -> NDArray[np.bool_]:
        """(N,) rows that tell something about the map; anchors, which may be more than half, do not."""
        typical = np.sort(self.variance)[len(self.variance) // 4]
        return np.asarray(self.variance < 100 * typical)

    def and_(self, other: Rows) -> Rows:
        """Both together."""
        names = ("grid", "direction", "value", "variance", "shift")
        return Rows(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


@dataclass(frozen=True, eq=False)
class MapFit:
    """A map fitted to rows.

    Attributes
    ----------
    map : SmoothMap
    shift : (K,) array [px]
        Unknowns of `Rows.shift`.
    shift_variance : (K,) array [px^2]
    residual : (N,) array [px]
        Value minus map and shift.
    weight : (N,) array
        From 1 down to 0 for outliers.
    chi2 : float
        Tukey's loss, about the number of good rows less that of parameters.
    excess : float
        Variance of the good rows that tell something about the map, as a multiple of what they claim;
        1 as long as it may be that by chance, less where it is less.
    """

    map: SmoothMap
    shift: Array
    shift_variance: Array
    residual: Array
    weight: Array
    chi2: float
    excess: float

    @property
    def form(self) -> int:
        """Index of the map's form."""
        return FORMS.index((self.map.radial, self.map.degree))


def fit_map(start: SmoothMap, rows: Rows, shift: Array, steps: int = _STEPS) -> MapFit:
    """Levenberg-Marquardt steps with Tukey's weights, from a start that is nearly right.

    Parameters
    ----------
    start : SmoothMap
        Whose form is kept.
    rows : Rows
    shift : (K,) array [px]
        Start of the shifts.
    steps : int
        At most.
    """
    free, m = start.free, len(start.free)
    prior = np.concatenate([start.prior[free], np.full(len(shift), _SHIFT_PRIOR)])
    values = np.concatenate([start.parameters[free], shift])
    rows_there = _Rows.of(start, rows)
    residual, jacobian = rows_there.residual(start, shift, free)
    # Before the first step everything may be off, the shifts above all.
    precision, telling = 1 / rows.variance, rows.telling
    weight, damping, least = precision, _DAMPING, 0.0
    for _ in range(steps):
        normal = (jacobian * weight) @ jacobian.T
        gradient = jacobian @ (weight * residual) - prior * values
        normal.ravel()[:: len(values) + 1] += prior
        step = _solved(normal, gradient, damping)
        tried, moved = replace(start, parameters=start.parameters.copy()), values + step
        tried.parameters[free] = moved[:m]
        ahead, slopes = rows_there.residual(tried, moved[m:], free)
        before = weight @ residual**2 + prior @ values**2
        after = weight @ ahead**2 + prior @ moved**2
        if not after <= before:
            # Where parameters can stand in for one another, it would be so again.
            damping = least = 10 * damping
            continue
        start, values, residual, jacobian = tried, moved, ahead, slopes
        damping = max(0.1 * damping, least)
        z = residual * rows_there.steep
        scale = _scale(z[telling])
        weight = _tukey(z / scale) * precision
        if before - after < max(_SETTLED * scale**2, _CREEPING * after) and damping <= _DAMPING:
            break
    return _finished(start, rows, telling, values[m:], residual, jacobian)


def choose_map(start: SmoothMap, rows: Rows, shift: Array, enough: float = 0.0, least: int = 0) -> MapFit:
    """The map of the simplest form that the rows do not contradict.

    Parameters
    ----------
    start : SmoothMap
        Of any form.
    rows : Rows
    shift : (K,) array [px]
    enough : float
        Chi2 per row with which no richer form is tried.
    least : int
        Index of the simplest form that is tried.
    """
    best: MapFit | None = None
    barren, now, paid = 0, start, 0
    telling, precision = rows.telling, 1 / np.sqrt(rows.variance)
    n_telling = int(telling.sum())
    for radial, degree in FORMS[least:]:
        now = now.shaped(radial, degree)
        if best is not None and len(now.free) + len(shift) > 0.5 * n_telling:
            break
        fit = fit_map(now, rows, shift)
        now, shift = fit.map, fit.shift
        z, count = fit.residual * precision, len(now.free)
        scale = _scale(z[telling])
        loss = _loss(z / scale)
        excess = max(1.0, loss / max(n_telling - count, 1))
        chance = _PRICE / scale**2
        price = max(chance, _UNEVEN_PRICE - chance) * excess * (count - paid)
        if best is None or _loss(best.residual * precision / scale) - loss > price:
            best, paid, barren = fit, count, 0
        else:
            barren += 1
        if barren >= _BARREN or loss * scale**2 + _PRICE * count < enough * len(rows.value):
            break
    assert best is not None
    return best


def median(x: Array) -> float:
    """The median, of an even number the upper one; numpy's takes ten times as long for a few hundred."""
    flat = np.sort(x, axis=None)
    return float(flat[len(flat) // 2]) if len(flat) else float("nan")


def _loss(z: Array) -> float:
    """Chi2 that grows no more beyond what no good row reaches."""
    return float(np.minimum(z * z, 100.0).sum())


def _tukey(z: Array) -> Array:
    return np.asarray(np.clip(1 - (z / _TUKEY) ** 2, 0, None) ** 2)


def _scale(z: Array) -> float:
    """How much larger than claimed the residuals of most rows are; at least 1.

    What the map cannot follow must not count as outliers as long as most rows have their share in it.
    """
    return max(1.0, 1.5 * median(np.abs(z)))


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows, prepared for maps of one form."""

    rows: Rows
    places: Places
    direction: Array
    steep: Array  # inverse standard deviations

    @classmethod
    def of(cls, form: SmoothMap, rows: Rows) -> _Rows:
        direction = np.ascontiguousarray(rows.direction.T)
        return cls(rows, form.places(rows.grid), direction, 1 / np.sqrt(rows.variance))

    def residual(self, now: SmoothMap, shift: Array, free: NDArray[np.intp]) -> tuple[Array, Array]:
        """Residuals (N,), and derivatives (P, N) of what they are compared with."""
        value, along = now.along(self.places, self.direction)
        residual = self.rows.value - value - self.rows.shift @ shift
        return residual, np.concatenate([along[free], self.rows.shift.T])


def _solved(normal: Array, gradient: Array, damping: float) -> Array:
    """Solution of damped normal equations whose parameters have very different sizes."""
    size = 1 / np.sqrt(np.maximum(normal.diagonal(), _TINY))
    scaled = normal * size[:, None] * size
    scaled.ravel()[:: len(size) + 1] += damping
    return np.asarray(size * np.linalg.solve(scaled, gradient * size))


def _finished(
    now: SmoothMap,
    rows: Rows,
    telling: NDArray[np.bool_],
    shift: Array,
    residual: Array,
    jacobian: Array,
) -> MapFit:
    free = now.free
    z = residual / np.sqrt(rows.variance)
    weight = _tukey(z / _scale(z[telling]))
    good = weight > 0
    normal = (jacobian * (good / rows.variance)) @ jacobian.T
    normal[np.diag_indices_from(normal)] += np.concatenate(
        [now.prior[free], np.full(len(shift), _SHIFT_PRIOR)]
    )
    size = 1 / np.sqrt(np.maximum(np.diag(normal), _TINY))
    inverse = np.linalg.inv(normal * size[:, None] * size) * size[:, None] * size
    telling = good & telling
    left = int(telling.sum()) - len(free) - len(shift)
    excess = float((z[telling] ** 2).sum()) / max(left, 0.2 * len(z))
    shrunk = min(1.0, (excess * left + _BELIEF) / (left + _BELIEF)) if left > 0 else 1.0
    covariance = np.zeros((len(now.parameters),) * 2)
    covariance[np.ix_(free, free)] = inverse[: len(free), : len(free)]
    return MapFit(
        map=replace(now, covariance=covariance),
        shift=shift,
        shift_variance=np.diag(inverse)[len(free) :].copy(),
        residual=residual,
        weight=weight,
        chi2=float((z[good] ** 2).sum()),
        excess=excess if excess > 1 + 3 * np.sqrt(2 / max(left, 1)) else shrunk,
    )

"""Fitting the smooth map to points known along directions, against outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.smooth_map import MAP_MODELS, Places, SmoothMap
from neurocal_cli.geometry import Array

__all__ = [
    "STEPS",
    "MapFit",
    "MapSolution",
    "Observations",
    "fit_map",
    "loss_of",
    "median",
    "robust_scale",
    "solve_map",
    "with_covariance",
]

STEPS = 25  # at most
_SHIFT_PRIOR = 1e-2  # 1/px^2
_TINY = 1e-300
_BELIEF = 20  # rows' worth of belief that variances are what they claim to be
_CREEPING = 5e-3  # of chi2; what is gained so slowly is not worth the steps
_CONVERGED = 0.2  # of chi2
_DAMPING = 1e-4  # to begin with, of the normal equations' scaled diagonal
_TUKEY = 6.0  # standard deviations beyond which a row counts as an outlier


@dataclass(frozen=True, eq=False)
class Observations:
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
    def of_points(cls, grid: Array, pixels: Array, sigma: float, shifts: int = 0) -> Observations:
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
    def informative(self) -> NDArray[np.bool_]:
        """(N,) rows that tell something about the map; anchors, which may be more than half, do not."""
        quarter = len(self.variance) // 4
        return np.asarray(self.variance < 100 * np.partition(self.variance, quarter)[quarter])

    def joined_with(self, other: Observations) -> Observations:
        """Both together."""
        names = ("grid", "direction", "value", "variance", "shift")
        return Observations(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in names))


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
    def model_index(self) -> int:
        """Index of the map's form."""
        return MAP_MODELS.index((self.map.radial, self.map.degree))


def fit_map(start: SmoothMap, observations: Observations, shift: Array, steps: int = STEPS) -> MapFit:
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
    return with_covariance(solve_map(start, observations, shift, steps), observations)


@dataclass(frozen=True, eq=False)
class MapSolution:
    """A map after its last step: shifts, residuals (N,) and derivatives (P, N) of what they compare with."""

    map: SmoothMap
    shift: Array
    residual: Array
    jacobian: Array


def solve_map(
    start: SmoothMap, observations: Observations, shift: Array, steps: int, worth: float = 0.0
) -> MapSolution:
    """Steps to the best map of a form, but only one if that gains less chi2 than would be worth more."""
    free, m = start.free, len(start.free)
    prior = np.concatenate([start.prior[free], np.full(len(shift), _SHIFT_PRIOR)])
    values = np.concatenate([start.parameters[free], shift])
    seen = _Prepared.of(start, observations)
    residual, jacobian = seen.residual(start, shift, free)
    # Before the first step everything may be off, the shifts above all.
    precision, informative = seen.steep * seen.steep, observations.informative
    weight, damping, least = precision, _DAMPING, 0.0
    square = residual * residual
    for _ in range(steps):
        weighted = jacobian * weight
        gradient = weighted @ residual - prior * values
        normal = weighted @ jacobian.T
        normal.ravel()[:: len(values) + 1] += prior
        moved = values + _solved(normal, gradient, damping)
        tried = start.moved(free, moved[:m])
        ahead, slopes = seen.residual(tried, moved[m:], free)
        square_ahead = ahead * ahead
        before = weight @ square + prior @ (values * values)
        after = weight @ square_ahead + prior @ (moved * moved)
        if not after <= before:
            # Where parameters can stand in for one another, it would be so again.
            damping = least = 10 * damping
            continue
        start, values, residual, jacobian, square = tried, moved, ahead, slopes, square_ahead
        damping = max(0.1 * damping, least)
        if before - after < worth:
            break
        worth = 0.0
        z = residual * seen.steep
        scale = robust_scale(z[informative])
        if before - after < max(_CONVERGED * scale**2, _CREEPING * after) and damping <= max(_DAMPING, least):
            break
        weight = _tukey(z / scale) * precision
    return MapSolution(start, values[m:], residual, jacobian)


def median(x: Array) -> float:
    """The median, of an even number the upper one; numpy's takes ten times as long for a few hundred."""
    flat = x.flatten()
    if not len(flat):
        return float("nan")
    flat.partition(len(flat) // 2)
    return float(flat[len(flat) // 2])


def loss_of(z: Array) -> float:
    """Chi2 that grows no more beyond what no good row reaches."""
    return float(np.minimum(z * z, 100.0).sum())


def _tukey(z: Array) -> Array:
    weight = np.maximum(1 - np.square(z * (1 / _TUKEY)), 0)
    return np.square(weight, out=weight)


def robust_scale(z: Array) -> float:
    """How much larger than claimed the residuals of most rows are; at least 1.

    What the map cannot follow must not count as outliers as long as most rows have their share in it.
    """
    return max(1.0, 1.5 * median(np.abs(z)))


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Rows, prepared for maps of one form."""

    observations: Observations
    places: Places
    steep: Array  # inverse standard deviations

    @classmethod
    def of(cls, model_index: SmoothMap, observations: Observations) -> _Prepared:
        direction = np.ascontiguousarray(observations.direction.T)
        return cls(
            observations, model_index.places(observations.grid, direction), 1 / np.sqrt(observations.variance)
        )

    def residual(self, now: SmoothMap, shift: Array, free: NDArray[np.intp]) -> tuple[Array, Array]:
        """Residuals (N,), and derivatives (P, N) of what they are compared with."""
        value, along = now.along(self.places)
        residual = self.observations.value - value
        residual -= self.observations.shift @ shift
        return residual, np.concatenate([along[free], self.observations.shift.T])


def _solved(normal: Array, gradient: Array, damping: float) -> Array:
    """Solution of damped normal equations whose parameters have very different sizes."""
    size = 1 / np.sqrt(np.maximum(normal.diagonal(), _TINY))
    scaled = normal * size[:, None] * size
    scaled.ravel()[:: len(size) + 1] += damping
    return np.asarray(size * np.linalg.solve(scaled, gradient * size))


def with_covariance(solution: MapSolution, observations: Observations) -> MapFit:
    """A settled map with its covariance, and what its residuals tell of the rows."""
    now, shift, residual, jacobian = solution.map, solution.shift, solution.residual, solution.jacobian
    free, informative = now.free, observations.informative
    z = residual / np.sqrt(observations.variance)
    weight = _tukey(z / robust_scale(z[informative]))
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
        shift_variance=np.diag(inverse)[len(free) :].copy(),
        residual=residual,
        weight=weight,
        chi2=float((z[good] ** 2).sum()),
        excess=excess if excess > 1 + 3 * np.sqrt(2 / max(left, 1)) else shrunk,
    )

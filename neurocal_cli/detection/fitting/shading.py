"""Levels of the dark and the light squares over the image: polynomials, or those of nearby levels.

Polynomials of up to the second degree are sufficient in most images. Vignetting, a lamp or a shadow is
followed by planes, or by even levels, through the nearest levels, if these predict others better.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.smooth_map import Frame, SmoothMap
from neurocal_cli.detection.fitting.strips import Single
from neurocal_cli.detection.grid import Grid, weights_within
from neurocal_cli.detection.medians import CHI2_MEDIAN, MAD_TO_SIGMA, upper_median

# Samples of a square's interior, away from the blurred edges.
_INTERIOR = weights_within(np.stack(np.meshgrid(*[np.linspace(0.25, 0.75, 8)] * 2), axis=-1).reshape(-1, 2))
LEVEL_VARIANCE = 0.5 * np.pi / len(_INTERIOR)  # of a square's median, over that of a pixel
# Insensitive.
_STEPS = 2  # reweighted fits after the highest degree has been reached
_TUKEY = 5.0  # standard deviations beyond which a level is an outlier
_CHANCE = 2.0  # variances of a level for each term, up to which a degree explains nothing
_TINY = 1e-9  # DN^2
_RIDGE = 1e-12
_LEAST_CONTRAST = 1e-3  # DN, to avoid division by 0
_NEAREST = 2  # the distance of so many nearest levels, for each term, is the width of the weights
# (3, 6, 6) coefficients of a polynomial in x and y, and of its derivatives by both, from its own.
_DERIVATIVES = np.zeros((3, 6, 6))
_DERIVATIVES[0] = np.eye(6)
_DERIVATIVES[1, [0, 1, 2], [1, 3, 4]] = 1, 2, 1
_DERIVATIVES[2, [0, 1, 2], [2, 4, 5]] = 1, 1, 2
_TERMS = (1, 3, 6)  # coefficients of polynomials of degree 0, 1, 2
_EVEN = 0.005  # standard deviation of the levels, in half contrasts, below which polynomials are sufficient
_CLEARLY = 0.8  # ratio of errors below which a richer description of the light predicts levels better
_FEWEST = 3  # levels that are more than this are followed
_LEAST_SPREAD = 0.1  # least variance of single levels around others, in variances of a level
_FAR = 1e-5  # weight of levels far away, which determines a plane where nearby ones do not


@frozen_dataclass(eq=False)
class Levels:
    """Levels measured at N places of the image."""

    place: Array  # (N, 2) [px]
    level: Array  # (N,) [DN]
    variance: Array  # (N,) [DN^2]


@frozen_dataclass(eq=False)
class Polynomial:
    """A level as a polynomial of the place, scaled by the frame."""

    frame: Frame
    coefficients: Array  # (6,) [DN] of 1, x, y, x^2, x y, y^2
    spread: float  # [DN^2] variance of single squares around it, including that of itself

    def at(self, place: Array) -> tuple[Array, Array, Array]:
        """Level (N,), slopes (N, 2) [1/px] and variance (N,) of single levels at places (N, 2)."""
        found = polynomial_terms(self.frame, place, 6) @ (_DERIVATIVES @ self.coefficients).T
        return found[:, 0], found[:, 1:] / self.frame.unit, np.full(len(place), self.spread)

    def off(self, levels: Levels) -> Array:
        """Differences (N,) of levels from it [DN]."""
        return levels.level - self.at(levels.place)[0]


@frozen_dataclass(eq=False)
class Nearby:
    """A level that follows nearby levels, with or without slopes, where polynomials do not."""

    frame: Frame
    levels: Levels
    terms: int  # 3 for planes; 1 for even levels, as on both sides of the border of a shadow
    spread: float | None = None  # [DN^2] as of a polynomial; None if it is that of the nearby levels

    def at(self, place: Array, itself: bool = True) -> tuple[Array, Array, Array]:
        """Level (N,), slopes (N, 2) [1/px] and variance (N,) of single levels at places (N, 2).

        The variance is large at the border of a shadow. A level at a place counts there if `itself`.
        """
        levels = self.levels
        weight = _nearness(levels.place, place, _NEAREST * self.terms, itself) + _FAR
        near = polynomial_terms(self.frame, levels.place, self.terms)
        products = (near[:, :, None] * near[:, None]).reshape(len(near), -1)
        # Levels on a line determine no plane across it.
        normal = (weight @ products).reshape(len(place), self.terms, self.terms) + _RIDGE * np.eye(self.terms)
        right = weight @ (near * levels.level[:, None])
        found = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        level = (found * polynomial_terms(self.frame, place, self.terms)).sum(axis=1)
        slopes = np.zeros((len(place), 2))
        slopes[:, : self.terms - 1] = found[:, 1:] / self.frame.unit
        rest = weight @ levels.level**2 - (right * found).sum(axis=1)
        variance = np.maximum(rest, _LEAST_SPREAD * upper_median(levels.variance))
        return level, slopes, variance if self.spread is None else np.full(len(place), self.spread)

    def off(self, levels: Levels) -> Array:
        """Differences (N,) of its levels from what the others predict [DN]."""
        return levels.level - self.at(levels.place, itself=False)[0]


@frozen_dataclass(eq=False)
class Shading:
    """Dark and light level over the image."""

    frame: Frame
    dark: Polynomial | Nearby
    light: Polynomial | Nearby

    @property
    def has_borders(self) -> bool:
        """Whether there may be borders of shadows, beside which the light within a square is bent."""
        return isinstance(self.dark, Nearby) and self.dark.spread is None

    def at(self, place: Array) -> tuple[Array, Array]:
        """Mean level and half contrast at places (N, 2)."""
        dark, light = self.dark.at(place)[0], self.light.at(place)[0]
        return 0.5 * (light + dark), np.maximum(0.5 * (light - dark), _LEAST_CONTRAST)

    def spread_at(self, place: Array) -> Array:
        """(2, N) variance [DN^2] of single dark and light levels around those at places (N, 2)."""
        return np.stack([self.dark.at(place)[2], self.light.at(place)[2]])

    def slopes(self, place: Array) -> tuple[Array, Array]:
        """Gradients [DN/px] of mean level and half contrast at places (N, 2); (N, 2) arrays."""
        dark, light = self.dark.at(place)[1], self.light.at(place)[1]
        return 0.5 * (light + dark), 0.5 * (light - dark)

    def off(self, place: Array, u: Single, v: Single, value: Single) -> tuple[Single, Single]:
        """Remove the gradient of the mean level at places (N, 2) from the pixels around them.

        `u` and `v` (N, M) [px] are the coordinates of the pixels relative to the places. Returns the values
        (N, M) [DN], and the half contrast (N, M) relative to that at the places.
        """
        by_mean, by_contrast = (slope.astype(np.float32) for slope in self.slopes(place))
        by_contrast /= self.at(place)[1].astype(np.float32)[:, None]
        gain = 1 + u * by_contrast[:, :1] + v * by_contrast[:, 1:]
        return value - u * by_mean[:, :1] - v * by_mean[:, 1:], gain


def _nearness(near: Array, place: Array, nearest: int, itself: bool = True) -> Array:
    """Weights (N, M) of places `near` (M, 2) at places (N, 2), normal in their distances, with the sum 1."""
    away = ((place[:, None] - near) ** 2).sum(axis=-1)
    if not itself:
        np.fill_diagonal(away, np.inf)
    nearest = min(nearest, len(near) - 1) - 1
    width = np.partition(away, nearest, axis=1)[:, nearest]
    weight = np.exp(-0.5 * away / np.maximum(width, 1.0)[:, None])
    return np.asarray(weight / np.maximum(weight.sum(axis=1), 1e-12)[:, None])


def square_levels(image: NDArray[np.generic], grid: Grid, at: SmoothMap) -> tuple[Levels, Levels, float]:
    """Medians inside the dark and the light squares whose four vertices are known.

    The third result is the median variance of the pixels inside a square [DN^2].
    """
    seen = grid.seen
    whole = seen[:-1, :-1] & seen[1:, :-1] & seen[:-1, 1:] & seen[1:, 1:]
    r, c = np.nonzero(whole)
    corner = np.stack([c, r], axis=-1).astype(float)
    corners = at.at(corner[:, None] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]))
    height, width = image.shape
    places = np.rint(_INTERIOR @ corners).astype(np.intp)
    u, v = (np.minimum(np.maximum(places[..., k], 0), (width, height)[k] - 1) for k in (0, 1))
    values = image[v, u].astype(float)
    half = values.shape[1] // 2
    level = np.sort(values, axis=1)[:, half]
    noise = (MAD_TO_SIGMA * np.sort(np.abs(values - level[:, None]), axis=1)[:, half]) ** 2 + 1 / 12
    is_dark = (c + r + grid.dark) % 2 == 0
    middle = corners.mean(axis=1)
    dark, light = (
        Levels(middle[kind], level[kind], LEVEL_VARIANCE * noise[kind]) for kind in (is_dark, ~is_dark)
    )
    return dark, light, upper_median(noise)


def fit_shading(frame: Frame, dark: Levels, light: Levels) -> Shading:
    """Fit polynomials to levels, of the degree up to 2 that their number allows."""
    places = np.concatenate([dark.place, light.place])
    if len(places):
        # Coordinates from -1 to 1 on the board, where high powers can be told apart.
        first, last = places.min(axis=0), places.max(axis=0)
        centre, unit = 0.5 * (first + last), max(0.5 * float((last - first).max()), 1.0)
        frame = replace(frame, centre=centre, unit=unit)
    return Shading(frame, _fit(frame, dark), _fit(frame, light))


def _fit(frame: Frame, levels: Levels) -> Polynomial:
    """A robust polynomial through levels.

    Each degree counts as far as it explains more than chance does. Else, the terms that even light does not
    need would make the levels of a board of few edges uncertain.
    """
    n = len(levels.level)
    coefficients = np.zeros(_TERMS[-1])
    if n == 0:
        return Polynomial(frame, coefficients, np.inf)
    terms = polynomial_terms(frame, levels.place, _TERMS[-1])
    residual, spread = levels.level - upper_median(levels.level), 0.0
    most = max([m for m in _TERMS if 3 * m <= n], default=1)
    # Raise the degree step by step from the median, to find hidden squares before they change a gradient.
    for used in (*_TERMS, *(most,) * _STEPS):
        used = min(used, most)
        coefficients[:used], residual, spread = _refit(terms[:, :used], levels, residual, spread)
    chance, count, before = _scatter(residual, most), 0.0, np.zeros(_TERMS[-1])
    coefficients[:] = 0
    for fewer, used in pairwise((0, *(m for m in _TERMS if m <= most))):
        found = np.zeros(_TERMS[-1])
        found[:used] = _refit(terms[:, :used], levels, residual, spread)[0]
        explained = ((terms @ (found - before)) ** 2).sum()
        share = max(1 - _CHANCE * (used - fewer) * chance / max(explained, _TINY), 0.0) if fewer else 1.0
        coefficients += share * (found - before)
        count += share * (used - fewer)
        before = found
    return Polynomial(frame, coefficients, spread + count / n * upper_median(levels.variance))


def adapted_shading(smooth: Shading, dark: Levels, light: Levels, wide: bool = False) -> Shading:
    """Follow nearby levels instead of polynomials if they predict levels clearly better.

    Before a `wide` lens, whose vignetting no polynomial describes, nearby levels are followed in any case.
    Planes suit light that changes over the whole board. Beside the border of a shadow, the slopes of planes
    are wrong on both sides, and even levels suit better.
    """
    both = dark, light
    if min(len(levels.level) for levels in both) <= _FEWEST:
        return smooth
    half = upper_median(smooth.at(light.place)[1])
    if not wide and smooth.spread_at(light.place[:1]).max() < (_EVEN * half) ** 2:
        return smooth
    best = given = smooth.dark, smooth.light
    nearby = [(Nearby(smooth.frame, dark, terms), Nearby(smooth.frame, light, terms)) for terms in (3, 1)]
    rest, least = list[Array](), np.inf
    for one in nearby if wide else (given, *nearby):
        off = [level.off(levels) for level, levels in zip(one, both, strict=True)]
        error = float(np.abs(np.concatenate(off)).mean())
        if error < _CLEARLY * least:
            best, rest, least = one, off, error
    if wide:  # there are no borders of shadows, and few levels tell the spread worse than all of them
        spreads = [excess_variance(left, levels.variance) for left, levels in zip(rest, both, strict=True)]
        best = replace(best[0], spread=spreads[0]), replace(best[1], spread=spreads[1])
    return Shading(smooth.frame, *best)


def _refit(terms: Array, levels: Levels, residual: Array, spread: float) -> tuple[Array, Array, float]:
    """Fit a polynomial once with Tukey's weights; the coefficients, residuals, and spread of the squares.

    The weights come from the residuals of the last fit, and the spread known so far.
    """
    n, used = terms.shape
    # The median is robust against the outliers that the weights are to find.
    scatter = _scatter(residual, used)
    weight = np.maximum(1 - residual**2 / (_TUKEY**2 * scatter + _TINY), 1e-6) ** 2
    root = np.sqrt(weight / (levels.variance + spread))
    weighted = terms.T * root
    normal = weighted @ weighted.T
    # Keeps the solution finite if terms cannot be separated.
    normal.ravel()[:: used + 1] *= 1 + _RIDGE
    coefficients: Array = np.linalg.solve(normal, weighted @ (levels.level * root)).astype(float)
    # The spread of the squares is the part that the errors of the levels do not explain.
    chance = 1 + 4 / np.sqrt(n)
    spread = max(scatter - chance * upper_median(levels.variance), 0.0)
    return coefficients, levels.level - terms @ coefficients, spread


def _scatter(residual: Array, used: int) -> float:
    """Robust variance of the residuals of a fit of so many coefficients."""
    n = len(residual)
    return upper_median(residual**2) / CHI2_MEDIAN * n / max(n - used, 1)


def excess_variance(residual: Array, variance: Array) -> float:
    """Robust variance of residuals (N,) beyond twice the median of their known variances (N,)."""
    return max(upper_median(residual**2) / CHI2_MEDIAN - 2 * upper_median(variance), 0.0)


def polynomial_terms(frame: Frame, place: Array, count: int) -> Array:
    """1, x, y, x^2, x y, y^2 of places (N, 2) [px], scaled by the frame; (N, count)."""
    x, y = ((place - frame.centre) / frame.unit).T
    return np.array([np.ones_like(x), x, y, x * x, x * y, y * y][:count]).T

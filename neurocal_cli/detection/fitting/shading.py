"""Levels of the dark and the light squares over the image: low-degree polynomials, fitted robustly.

In: levels measured inside squares or by edge fits. Out: `Shading`, the levels and their gradients anywhere.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.smooth_map import Frame, SmoothMap
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.medians import CHI2_MEDIAN, MAD_TO_SIGMA, upper_median
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

Single = NDArray[np.float32]

_x, _y = (x.ravel() for x in np.meshgrid(*[np.linspace(0.25, 0.75, 8)] * 2))
# Bilinear weights (64, 4) of a square's corners for samples of its interior, away from the blurred edges.
_INTERIOR = np.stack([(1 - _x) * (1 - _y), _x * (1 - _y), (1 - _x) * _y, _x * _y], axis=-1)
# Insensitive.
_STEPS = 2  # reweighted fits after the highest degree has been reached
_TUKEY = 5.0  # standard deviations beyond which a level is an outlier
_TINY = 1e-9  # DN^2
_RIDGE = 1e-12
_LEAST_CONTRAST = 1e-3  # DN, to avoid division by 0
_NEAREST = 3  # the distance of the n-th nearest level is the width of the weights
_TERMS = (1, 3, 6)  # coefficients of polynomials of degree 0, 1, 2
# A shadow has a border if so many light squares differ so much from the polynomial, relative to the contrast,
# but are so much lighter than the nearest dark ones: on something that hides the board both levels are equal.
# Chosen on one darkened photograph (docs/figures.md); tests/test_measuring.py has shadows and hidden edges.
_SHADOWED, _OFF, _LIGHTER = 0.04, 0.25, 0.2


@frozen_dataclass(eq=False)
class Levels:
    """Levels measured at N places of the image."""

    place: Array  # (N, 2) [px]
    level: Array  # (N,) [DN]
    variance: Array  # (N,) [DN^2]
    # (N,) [DN^2] variance of the pixels there, if measured
    noise: Array = field(default_factory=lambda: np.zeros(0))


@frozen_dataclass(eq=False)
class Shading:
    """Dark and light level as polynomials of the place, scaled by the frame."""

    frame: Frame
    dark: Array  # (6,) [DN] coefficients of 1, x, y, x^2, x y, y^2
    light: Array  # (6,) [DN] the same
    # (2,) [DN^2] variance of single dark and light squares around the polynomials, including that of these
    spread: Array

    def at(self, place: Array) -> tuple[Array, Array]:
        """Mean level and half contrast at places (N, 2)."""
        terms = quadratic_terms(self.frame, place)
        dark, light = terms @ self.dark, terms @ self.light
        return 0.5 * (light + dark), np.maximum(0.5 * (light - dark), _LEAST_CONTRAST)

    def slopes(self, place: Array) -> tuple[Array, Array]:
        """Gradients [DN/px] of mean level and half contrast at places (N, 2); (N, 2) arrays."""
        x, y = ((place - self.frame.centre) / self.frame.unit).T
        one, zero = np.ones_like(x), np.zeros_like(x)
        du = np.stack([zero, one, zero, 2 * x, y, zero], axis=-1) / self.frame.unit
        dv = np.stack([zero, zero, one, zero, x, 2 * y], axis=-1) / self.frame.unit
        dark, light = (np.stack([du @ c, dv @ c], axis=-1) for c in (self.dark, self.light))
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


@frozen_dataclass(eq=False)
class LocalShading(Shading):
    """Levels that also follow nearby squares, for the strong vignetting of wide lenses and for shadows."""

    # Two arrays (N, 2) [px]: places at which the dark and the light levels were measured
    near: tuple[Array, Array]
    above: tuple[Array, Array]  # two arrays (N,) [DN]: their differences from the polynomials

    @classmethod
    def of(cls, smooth: Shading, dark: Levels, light: Levels) -> Shading:
        """Add the levels to which polynomials were fitted; with few levels, return the polynomials."""
        if min(len(dark.level), len(light.level)) <= _NEAREST:
            return smooth
        above, spread = [], []
        for levels, coefficients, before in zip(
            (dark, light), (smooth.dark, smooth.light), smooth.spread, strict=True
        ):
            rest = levels.level - quadratic_terms(smooth.frame, levels.place) @ coefficients
            left = rest - _nearby(levels.place, rest, levels.place, itself=False)
            above.append(rest)
            spread.append(min(excess_variance(left, levels.variance), before))
        near = dark.place, light.place
        return cls(smooth.frame, smooth.dark, smooth.light, np.array(spread), near, (above[0], above[1]))

    def at(self, place: Array) -> tuple[Array, Array]:
        """Mean level and half contrast at places (N, 2)."""
        terms = quadratic_terms(self.frame, place)
        dark, light = (
            terms @ coefficients + _nearby(near, above, place)
            for coefficients, near, above in zip((self.dark, self.light), self.near, self.above, strict=True)
        )
        return 0.5 * (light + dark), np.maximum(0.5 * (light - dark), _LEAST_CONTRAST)


def _nearby(near: Array, value: Array, place: Array, itself: bool = True) -> Array:
    """(N,) means at places (N, 2) of values (M,) at places `near` (M, 2), weighted by their distances."""
    away = ((place[:, None] - near) ** 2).sum(axis=-1)
    if not itself:
        np.fill_diagonal(away, np.inf)
    width = np.partition(away, _NEAREST - 1, axis=1)[:, _NEAREST - 1]
    weight = np.exp(-0.5 * away / np.maximum(width, 1.0)[:, None])
    return np.asarray(weight @ value / np.maximum(weight.sum(axis=1), 1e-12))


def square_levels(image: NDArray[np.generic], grid: Grid, at: SmoothMap) -> tuple[Levels, Levels]:
    """Medians inside the dark and the light squares whose four vertices are known."""
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
        Levels(middle[kind], level[kind], 0.5 * np.pi * noise[kind] / len(_INTERIOR), noise[kind])
        for kind in (is_dark, ~is_dark)
    )
    return dark, light


def fit_shading(frame: Frame, dark: Levels, light: Levels) -> Shading:
    """Fit polynomials to levels, of the highest degree that their number allows."""
    (low, low_spread), (high, high_spread) = (_fit(frame, levels) for levels in (dark, light))
    return Shading(frame, low, high, np.array([low_spread, high_spread]))


def has_shadow(smooth: Shading, dark: Levels, light: Levels) -> bool:
    """Whether the board is partly in a shadow, whose border polynomials cannot follow."""
    if min(len(dark.level), len(light.level)) <= _NEAREST:
        return False
    mean, half = smooth.at(light.place)
    off = np.abs(light.level - mean - half) > _OFF * 2 * half
    if off.mean() < _SHADOWED:
        return False
    nearest = _nearby(dark.place, dark.level, light.place[off])
    lighter = light.level[off] - nearest > _LIGHTER * 2 * half[off]
    return bool(lighter.sum() >= _SHADOWED * len(off))


def _fit(frame: Frame, levels: Levels) -> tuple[Array, float]:
    n = len(levels.level)
    coefficients = np.zeros(_TERMS[-1])
    if n == 0:
        return coefficients, np.inf
    terms = quadratic_terms(frame, levels.place)
    residual, spread = levels.level - upper_median(levels.level), 0.0
    most = max([m for m in _TERMS if 3 * m <= n], default=1)
    # Raise the degree step by step from the median, to find hidden squares before they change a gradient.
    for used in (*_TERMS, *(most,) * _STEPS):
        used = min(used, most)
        # The median is robust against the outliers that the weights are to find.
        scatter = upper_median(residual**2) / CHI2_MEDIAN * n / max(n - used, 1)
        weight = np.maximum(1 - residual**2 / (_TUKEY**2 * scatter + _TINY), 1e-6) ** 2
        root = np.sqrt(weight / (levels.variance + spread))
        weighted = terms[:, :used].T * root
        normal = weighted @ weighted.T
        # Keeps the solution finite if terms cannot be separated.
        normal.ravel()[:: used + 1] *= 1 + _RIDGE
        coefficients[:used] = np.linalg.solve(normal, weighted @ (levels.level * root))
        residual = levels.level - terms[:, :used] @ coefficients[:used]
        # The spread of the squares is the part that the errors of the levels do not explain.
        chance = 1 + 4 / np.sqrt(n)
        spread = max(scatter - chance * upper_median(levels.variance), 0.0)
    return coefficients, spread + most / n * upper_median(levels.variance)


def excess_variance(residual: Array, variance: Array) -> float:
    """Robust variance of residuals (N,) beyond twice the median of their known variances (N,)."""
    return max(upper_median(residual**2) / CHI2_MEDIAN - 2 * upper_median(variance), 0.0)


def quadratic_terms(frame: Frame, place: Array) -> Array:
    """1, x, y, x^2, x y, y^2 of places (N, 2) [px], scaled by the frame; (N, 6)."""
    x, y = ((place - frame.centre) / frame.unit).T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

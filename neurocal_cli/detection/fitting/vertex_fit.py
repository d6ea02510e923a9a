"""Fit vertices, where two edges cross, to all their pixels by maximum likelihood, after the edges.

The values of a fit are offset and tilt of both lines through the vertex, and those of `BatchFit`. With z1, z2
the distances from the two lines in sigma, towards growing r and growing c, the light is

    x = +-(E(z1) E(z2) + 4 rho phi(z1) phi(z2) + ...) Q

The sign is that of the square between the normals, and Q is the effect of the parallel lines on both sides.
rho is the correlation of the blur along both normals, which is the cosine of the angle between them if the
blur is round. If it is not, as with motion blur, sigma differs between the lines, too. The pixels come from
two strips along the two lines, each with the pixels nearer to its own line.

On one side of the corner of a tag, a line is seen along half of the tag, on the other along half of the gap,
so that an error of its direction moves the vertex: by itself, a vertex is then determined 1.4 times worse
than if the direction is known. The map of all edges knows it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import (
    BatchFit,
    FitPixels,
    Linearised,
    ProfileShape,
    fit_batch,
    rows_for,
)
from neurocal_cli.detection.fitting.common_parameters import (
    FieldBlur,
    correlation,
    level_prior,
    with_gradients,
    with_shift,
)
from neurocal_cli.detection.fitting.edge_fit import ALONE, REACH
from neurocal_cli.detection.fitting.edge_profile import (
    Real,
    erf_and_density,
    half_widths,
    response,
    sharp_profile,
)
from neurocal_cli.detection.fitting.grid_fit import LEAST_SCALE, STEPS, GridFit
from neurocal_cli.detection.fitting.initial_fit import is_reliable, without_outlying_pixels
from neurocal_cli.detection.fitting.map_fit import MapFit
from neurocal_cli.detection.fitting.shading import Shading, excess_variance
from neurocal_cli.detection.fitting.strips import GridImage, Lines, Single, grid_lines, packed, strip_pixels
from neurocal_cli.detection.medians import upper_median

# Positions of the values of a fit: offset [px] and tilt [px over the half length] of the line along c, then
# of that along r, then the values of `BatchFit`.
FIRST, SECOND = 0, 2
# Insensitive.
_LAST, _MOST_LAST = 1.5, 0.1  # sigma left out at the board's end, at most this share of the line
_NO_VARIANCE = 1e-12  # px^2, of fits that are not determined
# Standard deviations beyond which the tilt of a line is not that of the map, and squared correlation with the
# offset from which it matters. It does not where the light of a board of equal squares is uneven.
_OUTLIER, _TELLING = 4.0, 0.1
# Number of terms of the series for crossings with a cosine below each limit, and for all others;
# test_fit_models.py compares them with a rendered cross.
_TERMS, _MOST_TERMS = ((2, 0.1), (4, 0.35), (7, 0.65)), 12


def fit_grid_vertices(
    grid_image: GridImage, fitted: GridFit
) -> tuple[BatchFit, tuple[Lines, Lines], NDArray[np.bool_]]:
    """Fit all known vertices after the edges; returns also their lines and a mask of the reliable ones."""
    grid = grid_image.vertices
    # Their normals point towards growing r and growing c.
    at, ones, along_c = fitted.map.map, np.ones(len(grid)), np.zeros(len(grid), dtype=np.bool_)
    lines = grid_lines(at, grid, along_c, ones), grid_lines(at, grid, ~along_c, ones)
    light = np.where((grid.sum(axis=1) + grid_image.grid.dark) % 2 == 1, 1.0, -1.0)
    place = lines[0].middle
    blur = fitted.blur
    (first, spread), (second, _) = (blur.at(line) for line in lines)
    sigma = 0.5 * (first + second)
    # Ends of the lines, along c and along r, at which no vertex is known.
    unknown = ~np.pad(grid_image.grid.seen, 1)
    neighbours = [unknown[1:-1, :-2], unknown[1:-1, 2:], unknown[:-2, 1:-1], unknown[2:, 1:-1]]
    last = np.stack([which[grid_image.grid.seen] for which in neighbours], axis=1).reshape(-1, 2, 2)
    rho = correlation(blur, lines)
    data = _vertex_pixels(grid_image, lines, light, (first, second), rho, fitted.shading, last)
    shape = fitted.fit.shape.elsewhere(np.stack([half_widths(line.normal) for line in lines], axis=1))
    shape = with_shift(shape, upper_median(sigma), float(fitted.map.shift[0]))
    prior = level_prior(fitted.shading, place, sigma, spread, fitted.noise.edge)
    start = np.concatenate([np.zeros((len(grid), 4)), prior.mean], axis=1)
    unit = replace(data, root=data.root / np.float32(np.sqrt(fitted.noise.edge)))
    fit = fit_batch(vertex_model, unit, start, prior, shape, STEPS)
    fit = fit.continued(shape, STEPS, weight=fitted.noise.weights(fit.x))
    fit = without_outlying_pixels(fit, STEPS)
    fit = with_gradients(fit, (data.d1, data.d2), isinstance(blur, FieldBlur), fitted.shading.has_borders)
    if fitted.shifts.used:
        fit = replace(fit, values=fit.values - _displacements(fitted, grid, light, fit.values.shape[1]))
    fit = fit.scaled(max(upper_median(fit.chi2_per_pixel), LEAST_SCALE))
    fit = _with_tilts(fit, grid, lines, fitted.map)
    departure = np.zeros(len(grid))
    for line, which in zip(lines, (FIRST, SECOND), strict=True):
        variance = fit.covariance[:, which, which] + at.variance(grid, line.normal)
        variance *= fitted.map.excess
        departure = np.maximum(
            departure, np.abs(fit.values[:, which]) / np.sqrt(np.maximum(variance, _NO_VARIANCE))
        )
    # Map, blur and levels come from the edges: if no edge is reliable, no vertex is.
    return fit, lines, is_reliable(fit, departure) & fitted.good.any()


def _with_tilts(fit: BatchFit, grid: Array, lines: tuple[Lines, Lines], mapped: MapFit) -> BatchFit:
    """Take into account that lines have the directions of the map.

    Tilts differ from it by its errors, and on an uneven board by as much as they scatter in excess of theirs.
    """
    covariance, precision = fit.covariance, np.zeros_like(fit.information)
    for line, which, step in zip(lines, (FIRST, SECOND), 0.5 * np.eye(2), strict=True):
        tilt = which + 1
        departure, own = fit.values[:, tilt], covariance[:, tilt, tilt]
        variance = mapped.map.tilt_variance(grid, step, line.normal) * mapped.excess
        variance += excess_variance(departure, own + variance) + _NO_VARIANCE
        agrees = departure**2 < _OUTLIER**2 * (own + variance)
        tells = covariance[:, which, tilt] ** 2 > _TELLING * covariance[:, which, which] * own
        precision[:, tilt, tilt] = (agrees & tells) / variance
    fit = replace(fit, information=fit.information + precision)
    back = fit.covariance @ (precision @ fit.values[:, :, None])
    return replace(fit, values=fit.values - back[:, :, 0])


def _displacements(fitted: GridFit, grid: Array, light: Array, count: int) -> Array:
    """(V, count) effect on the values of vertices of lines whose two halves have different shifts.

    The halves are shifted in opposite directions; equal shifts only turn the line. The common response is in
    the vertices' model.
    """
    result, ones = np.zeros((len(grid), count)), np.ones(len(grid))
    for which, step in zip((FIRST, SECOND), 0.25 * np.eye(2), strict=True):
        vertical = np.full(len(grid), which == SECOND)
        before, after = (
            fitted.shifts.beyond_response(
                grid_lines(fitted.map.map, grid + side * step, vertical, ones), fitted.map.shift
            )
            for side in (-1, 1)
        )
        result[:, which] = 0.5 * light * (after - before)
    return result


@frozen_dataclass(eq=False)
class VertexPixels(FitPixels):
    """Pixels of vertices for the fits; (V, N) float32 arrays, Q with the sign of the square."""

    lever1: Single  # tangential coordinate of the first line over half its length
    d1: Single  # [px] distance from the first line
    lever2: Single
    d2: Single
    rho: Single  # (V, 1)
    relative: Single  # (V, 2) blur across both lines, relative to their mean


def _vertex_pixels(
    grid_image: GridImage,
    lines: tuple[Lines, Lines],
    light: Array,
    blur: tuple[Array, Array],
    rho: Array,
    shading: Shading,
    last: NDArray[np.bool_],
) -> VertexPixels:
    """Gather the pixels around vertices, all with weight 1.

    `blur` are two arrays (V,) [px], those across both lines, and `rho` (V,) is the correlation between them.
    `light` (V,) is +1 if the square between the two normals is light, else -1. `last` (V, 2, 2) tells which
    ends of the two lines are ends of the board. At a fold, light of another plane blurs into them.
    """
    parts = []
    for k in (0, 1):
        half = np.minimum(REACH * blur[k], 0.5 * lines[k].width)
        trim = np.minimum(_LAST * blur[1 - k], _MOST_LAST * lines[k].length)[:, None] * last[:, k]
        parts.append(strip_pixels(grid_image.image, lines[k], half, trim, ink=grid_image.ink))
    u, v, value, inside = (
        np.concatenate([getattr(part, name) for part in parts], axis=1)
        for name in ("u", "v", "value", "inside")
    )
    (_, d1), (_, d2) = (_coordinates(line, u, v) for line in lines)
    nearer = np.abs(d1) <= np.abs(d2)
    nearer[:, parts[0].u.shape[1] :] ^= True  # in the second strip, nearer to the second line
    inside &= nearer
    index, inside = packed(inside)
    u, v, value = (x.reshape(-1)[index] for x in (u, v, value))
    (s1, d1), (s2, d2) = (_coordinates(line, u, v) for line in lines)
    inks = [part.ink for part in parts if part.ink is not None]
    ink = np.concatenate(inks, axis=1).reshape(-1)[index] if inks else None
    Q = _faded(lines, (d1, d2), blur) * light.astype(np.float32)[:, None]
    value, gain = shading.off(lines[0].middle, u, v, value)
    lever1, lever2 = (
        s / (0.5 * line.length).astype(np.float32)[:, None] for s, line in zip((s1, s2), lines, strict=True)
    )
    weight, correlation = inside.astype(np.float32), rho.astype(np.float32)[:, None]
    relative = (np.stack(blur, axis=1) / (0.5 * (blur[0] + blur[1]))[:, None]).astype(np.float32)
    return VertexPixels(value, gain, Q, weight, lever1, d1, lever2, d2, correlation, relative, ink=ink)


def _faded(lines: tuple[Lines, Lines], distances: tuple[Single, Single], blur: tuple[Array, Array]) -> Single:
    """Factor Q, the effect of near parallel lines on both sides."""
    Q = np.ones_like(distances[0])
    for line, d, sigma in zip(lines, distances, blur, strict=True):
        for k, side in ((0, 1), (1, -1)):
            close = line.apart[:, k] < ALONE * sigma
            t = (line.apart[close, k, None] + side * d[close]) / sigma[close, None]
            Q[close] *= erf_and_density(t.astype(np.float32))[0]
    return Q


def _coordinates(lines: Lines, u: Single, v: Single) -> tuple[Single, Single]:
    t, n = lines.tangent.astype(np.float32), lines.normal.astype(np.float32)
    s = u * t[:, :1] + v * t[:, 1:]
    d = u * n[:, :1] + v * n[:, 1:]
    d -= (0.5 * lines.curvature[:, None]).astype(np.float32) * s * s
    return s, d


def vertex_model(data: VertexPixels, values: Array, shape: ProfileShape) -> Linearised:
    """Intensity around vertices with given values, and its derivatives; the shape has one row per vertex."""
    offset1, tilt1, offset2, tilt2, mean, contrast, sigma = (
        x.astype(data.value.dtype)[:, None] for x in values.T
    )
    wide1, wide2 = data.relative[:, :1], data.relative[:, 1:]
    z1 = (data.d1 - offset1 - tilt1 * data.lever1) / (sigma * wide1)
    z2 = (data.d2 - offset2 - tilt2 * data.lever2) / (sigma * wide2)
    halves = (None, None) if shape.half is None else (shape.half[:, 0], shape.half[:, 1])
    E1, slope1, spread1, density1 = sharp_profile(z1, sigma * wide1, shape.tails, halves[0])
    E2, slope2, spread2, density2 = sharp_profile(z2, sigma * wide2, shape.tails, halves[1])
    rho = data.rho
    series, bent1, bent2 = _crossed(z1, z2, rho, density1 * density2)
    x = np.asarray((E1 * E2 + series) * data.Q, dtype=data.value.dtype)
    by_z1, by_z2 = (slope1 * E2 + bent1) * data.Q, (slope2 * E1 + bent2) * data.Q
    if data.ink is not None:
        x += data.ink
    F, steep = response(x, shape.nonlinearity)
    gain = data.gain * data.root
    factor = -contrast / sigma * steep * gain
    by_z1 *= factor
    by_z2 *= factor
    rows = rows_for(len(x), 7, x.shape[1], data.value.dtype)
    residual, by = rows[:, 0], rows[:, 1:].swapaxes(0, 1)
    by[4] = data.root
    by[5] = F * gain
    by[6] = z1 * by_z1 + z2 * by_z2
    by_z1 /= wide1
    by_z2 /= wide2
    by[FIRST], by[FIRST + 1] = by_z1, by_z1 * data.lever1
    by[SECOND], by[SECOND + 1] = by_z2, by_z2 * data.lever2
    if spread1 is not None and spread2 is not None:
        by[6] -= factor * (spread1 * E2 + E1 * spread2) * data.Q
    residual[...] = (data.value - mean) * data.root - contrast * by[5]
    z = np.where(np.abs(z1) < np.abs(z2), z1, z2)
    return Linearised(rows, z, x)


@np.errstate(over="ignore", invalid="ignore")  # in fits that diverge, which are rejected
def _crossed(z1: Real, z2: Real, rho: Real, density: Real) -> tuple[Real, Real, Real]:
    """Correction of E(z1) E(z2) for the angle between two lines, and its derivatives by z1 and z2.

    It is the tetrachoric series of two correlated normal variables, 4 phi phi sum_n rho^n / n! He_{n-1}
    He_{n-1}, with more terms for more oblique lines.
    """
    most = float(np.abs(rho).max(initial=0.0))
    terms = next((n for n, limit in _TERMS if most < limit), _MOST_TERMS)
    power: Real = 4 * rho * density
    # He_{n-1} and He_n of both distances.
    last1, now1, last2, now2 = np.ones_like(z1), z1, np.ones_like(z2), z2
    series, by_z1, by_z2 = power.copy(), -power * z1, -power * z2
    for n in range(2, terms + 1):
        power = power * rho / n
        last1, now1 = now1, z1 * now1 - (n - 1) * last1
        last2, now2 = now2, z2 * now2 - (n - 1) * last2
        series += power * last1 * last2
        by_z1 -= power * now1 * last2
        by_z2 -= power * last1 * now2
    return series, by_z1, by_z2

"""Maximum-likelihood fits of the vertices, where two edges cross.

In: the map, levels and blur of the fitted edges. Out: `BatchFit` with offset and tilt of both lines through
each vertex. With z1, z2 the distances from the two lines in sigma, towards growing r and growing c, the
light is

    x = +-(E(z1) E(z2) + 4 rho phi(z1) phi(z2) + ...) Q

with the sign of the square between them, rho the cosine between the normals, and Q the effect of the
parallel lines on both sides. The pixels are those of two strips along the two lines, each with the pixels
that are nearer to its own line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.batched_newton import (
    BatchFit,
    LevelPrior,
    Linearised,
    Part,
    ProfileShape,
    fit_batch,
    rows_for,
)
from neurocal_cli.detection.fitting.edge_profile import Real, erf_and_density, response
from neurocal_cli.detection.fitting.pixel_box import sharp_profile
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.fitting.strips import Lines, grid_lines, packed, strip_pixels
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

Single = NDArray[np.float32]

# Values of a vertex's fit: offset [px] and tilt [px over the half length] of the line along c and of that
# along r, then those of `BatchFit`.
FIRST, SECOND = 0, 2
# Insensitive.
_LAST, _MOST_LAST = 1.5, 0.1  # sigma left out at the board's end, at most this share of the line
# Terms of the series for oblique crossings up to a cosine, and for all others; tests/test_fit_models.py
# compares them with a rendered cross.
_TERMS, _MOST_TERMS = ((2, 0.1), (4, 0.35), (7, 0.65)), 12
_ALONE = 9.0  # sigma; a parallel line at this distance has no effect


@frozen_dataclass(eq=False)
class VertexData:
    """The pixels as the fits need them; (V, N) float32 arrays.

    Attributes
    ----------
    s1, d1, s2, d2 : arrays [px]
        Tangential and normal coordinates of both lines.
    value : array [DN]
        Minus the slope of A.
    gain : array
        B(u, v) relative to the vertex's own.
    Q : array
        With the sign of the square.
    rho : (V, 1) array
    root : array [1/DN]
        Inverse standard deviation of the noise; 0 for pixels that are not used.
    beyond : (V,) array
        Share of the strips' pixels that lie outside the image.
    """

    s1: Single
    d1: Single
    s2: Single
    d2: Single
    value: Single
    gain: Single
    Q: Single
    rho: Single
    root: Single
    beyond: Array

    def part(self, which: Part) -> VertexData:
        """The pixels of some vertices."""
        return VertexData(*(getattr(self, field.name)[which] for field in fields(self)))


def vertex_lines(at: SmoothMap, grid: Array) -> tuple[Lines, Lines]:
    """The lines along c and along r through vertices (V, 2), half a square to both sides.

    Their normals point to growing r and growing c.
    """
    ones = np.ones(len(grid))
    flat = np.zeros(len(grid), dtype=np.bool_)
    return grid_lines(at, grid, flat, ones), grid_lines(at, grid, ~flat, ones)


def vertex_data(
    image: NDArray[np.generic],
    lines: tuple[Lines, Lines],
    light: Array,
    sigma: Array,
    reach: float,
    slopes: tuple[Array, Array],
    contrast: Array,
    last: NDArray[np.bool_],
) -> VertexData:
    """Gather pixels for fits.

    Parameters
    ----------
    image : (H, W) array
    lines : pair of Lines
    light : (V,) array
        +1 where the square between the two normals is light, else -1.
    sigma : (V,) array [px]
        sigma_t.
    reach : float
        Half the strips' width, in sigma.
    slopes : pair of (V, 2) arrays [DN/px]
        Of A and B.
    contrast : (V,) array [DN]
        B where the slopes hold.
    last : (V, 2, 2) bool array
        Which ends of the two lines are the board's. At a fold, another plane's light is blurred into these.
    """
    parts = []
    for k in (0, 1):
        half = np.minimum(reach * sigma, 0.5 * lines[k].width)
        trim = np.minimum(_LAST * sigma, _MOST_LAST * lines[k].length)[:, None] * last[:, k]
        parts.append(strip_pixels(image, lines[k], half, trim))
    u, v, value, inside = (
        np.concatenate([getattr(part, name) for part in parts], axis=1)
        for name in ("u", "v", "value", "inside")
    )
    (_, d1), (_, d2) = (_coordinates(line, u, v) for line in lines)
    inside[:, : parts[0].u.shape[1]] &= (np.abs(d1) <= np.abs(d2))[:, : parts[0].u.shape[1]]
    inside[:, parts[0].u.shape[1] :] &= (np.abs(d1) > np.abs(d2))[:, parts[0].u.shape[1] :]
    index, inside = packed(inside, inside.sum(axis=1))
    u, v, value = (x.reshape(-1)[index] for x in (u, v, value))
    (s1, d1), (s2, d2) = (_coordinates(line, u, v) for line in lines)
    Q = _faded(lines, (d1, d2), sigma) * light.astype(np.float32)[:, None]
    slope_a, slope_b = (g.astype(np.float32) for g in slopes)
    value = np.asarray(value - u * slope_a[:, :1] - v * slope_a[:, 1:], dtype=np.float32)
    relative = slope_b / contrast.astype(np.float32)[:, None]
    gain = 1 + u * relative[:, :1] + v * relative[:, 1:]
    rho = (lines[0].normal * lines[1].normal).sum(axis=1).astype(np.float32)[:, None]
    used = inside.astype(np.float32)
    beyond = np.maximum(parts[0].beyond, parts[1].beyond)
    return VertexData(s1, d1, s2, d2, value, gain, Q, rho, used, beyond)


def _faded(lines: tuple[Lines, Lines], distances: tuple[Single, Single], sigma: Array) -> Single:
    """The effect of near parallel lines on both sides of the edges."""
    Q = np.ones_like(distances[0])
    for line, d in zip(lines, distances, strict=True):
        for k, side in ((0, 1), (1, -1)):
            close = line.apart[:, k] < _ALONE * sigma
            t = (line.apart[close, k, None] + side * d[close]) / sigma[close, None]
            Q[close] *= erf_and_density(t.astype(np.float32))[0]
    return Q


def _coordinates(lines: Lines, u: Single, v: Single) -> tuple[Single, Single]:
    t, n = lines.tangent.astype(np.float32), lines.normal.astype(np.float32)
    s = u * t[:, :1] + v * t[:, 1:]
    d = u * n[:, :1] + v * n[:, 1:]
    d -= (0.5 * lines.curvature[:, None]).astype(np.float32) * s * s
    return s, d


def fit_vertices(
    data: VertexData,
    start: Array,
    prior: LevelPrior,
    half_length: tuple[Array, Array],
    shape: ProfileShape,
    steps: int,
) -> BatchFit:
    """Fit all vertices at once.

    Parameters
    ----------
    data : VertexData
    start : (V, 7) array
        Offset and tilt of the first and of the second line, and the values of `BatchFit`.
    prior : LevelPrior
    half_length : pair of (V,) arrays [px]
    shape : ProfileShape
        With the tails (V, 2) of the vertices.
    steps : int
    """
    levers = (
        data.s1 / half_length[0].astype(np.float32)[:, None],
        data.s2 / half_length[1].astype(np.float32)[:, None],
    )

    def model_of(part: Part) -> Callable[[Array], Linearised]:
        pixels, part_shape = data.part(part), shape.part(part)
        some = (levers[0][part], levers[1][part])
        return lambda values: linearised(pixels, some, values, part_shape)

    return fit_batch(model_of, start, prior, np.count_nonzero(data.root, axis=1), steps)


def linearised(
    data: VertexData, levers: tuple[Single, Single], values: Array, shape: ProfileShape
) -> Linearised:
    """The model and its derivatives; levers are s over the half lengths."""
    offset1, tilt1, offset2, tilt2, mean, contrast, sigma = (
        x.astype(data.value.dtype)[:, None] for x in values.T
    )
    z1 = (data.d1 - offset1 - tilt1 * levers[0]) / sigma
    z2 = (data.d2 - offset2 - tilt2 * levers[1]) / sigma
    halves = (None, None) if shape.half is None else (shape.half[:, 0], shape.half[:, 1])
    E1, slope1, spread1, density1 = sharp_profile(z1, sigma, shape.tails, halves[0])
    E2, slope2, spread2, density2 = sharp_profile(z2, sigma, shape.tails, halves[1])
    rho = data.rho
    series, bent1, bent2 = _crossed(z1, z2, rho, density1 * density2)
    x = np.asarray((E1 * E2 + series) * data.Q, dtype=data.value.dtype)
    by_z1, by_z2 = (slope1 * E2 + bent1) * data.Q, (slope2 * E1 + bent2) * data.Q
    F, steep = response(x, shape.nonlinearity)
    gain = data.gain * data.root
    factor = -contrast / sigma * steep * gain
    by_z1 *= factor
    by_z2 *= factor
    rows = rows_for(len(x), 7, x.shape[1], data.value.dtype)
    residual, by = rows[:, 0], rows[:, 1:].swapaxes(0, 1)
    by[FIRST], by[FIRST + 1] = by_z1, by_z1 * levers[0]
    by[SECOND], by[SECOND + 1] = by_z2, by_z2 * levers[1]
    by[4] = data.root
    by[5] = F * gain
    by[6] = z1 * by_z1 + z2 * by_z2
    if spread1 is not None and spread2 is not None:
        by[6] -= factor * (spread1 * E2 + E1 * spread2) * data.Q
    residual[...] = (data.value - mean) * data.root - contrast * by[5]
    z = np.where(np.abs(z1) < np.abs(z2), z1, z2)
    return Linearised(rows, z, x)


@np.errstate(over="ignore", invalid="ignore")  # of fits that diverge, which are left out
def _crossed(z1: Real, z2: Real, rho: Real, density: Real) -> tuple[Real, Real, Real]:
    """The effect of the angle between two lines on E(z1) E(z2), and its derivatives by z1 and z2.

    The tetrachoric series of two correlated normal variables, 4 phi phi sum_n rho^n / n! He_{n-1} He_{n-1},
    with more terms for more oblique lines.
    """
    most = float(np.abs(rho).max(initial=0.0))
    terms = next((n for n, limit in _TERMS if most < limit), _MOST_TERMS)
    power: Real = 4 * rho * density
    # He_{n-1} and He_n of both.
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

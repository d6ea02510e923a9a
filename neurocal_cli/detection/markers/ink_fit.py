"""Fit the edges of a board with markers: their ink is in the model, with what the last fit says of it.

The first look comes from profiles across the edges, which include the border of the marker beside the edge.
Codes that are blurred into these profiles make levels and blur wrong by a fifth, and later fits keep the
levels. Then blur and levels come from all pixels around the edges: each blur gives the light of edges and
codes, and the levels that suit it best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.saddles import interpolate
from neurocal_cli.detection.fitting.batched_newton import BLUR, CONTRAST, LEAST_BLUR, MEAN, ProfileShape
from neurocal_cli.detection.fitting.common_parameters import correlation
from neurocal_cli.detection.fitting.edge_fit import OFFSET, REACH, edge_model, edge_pixels, usual_stride
from neurocal_cli.detection.fitting.edge_profile import (
    RESPONSE_TERMS,
    EdgeProfile,
    edge_profile,
    erf_and_density,
    find_sharpening,
)
from neurocal_cli.detection.fitting.grid_fit import GridFit, fit_again, fit_from, map_of_vertices
from neurocal_cli.detection.fitting.map_fit import MapFit, fit_map
from neurocal_cli.detection.fitting.shading import (
    LEVEL_VARIANCE,
    Levels,
    Shading,
    adapted_shading,
    fit_shading,
    square_levels,
)
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.fitting.strips import GridImage, Lines, grid_lines, strip_pixels
from neurocal_cli.detection.markers.ink import Appearance, Ink, InkedPixels
from neurocal_cli.detection.medians import upper_median

# Greatest change of the light by the ink, in half contrasts, of pixels that are used in the first fit, and in
# those that repeat it with what it found; how often depends on how far the ink is from the edges [sigma].
# Without pixels in the ink, the light side of blurred edges is not seen, and their levels are wrong by up to
# a tenth; the first look is not accurate enough for all pixels.
_FIRST_MOST = 0.5
_MOST: tuple[tuple[float, tuple[float, ...]], ...] = ((7.0, ()), (5.0, (0.5,)))
_MOST_NEAR = (0.5, 1.0, 1.0)
_ALL = 10.0  # more than any change
_OFFSET_SIGMA = 0.05  # px, of an edge's offset from its profile
_SIGMAS = np.geomspace(0.4, 6.0, 12)  # px, tried first
_OFFSETS = np.linspace(-1.0, 1.0, 9)  # px, of an edge from the found vertices
_FINER = np.geomspace(0.75, 1.33, 9)  # factors on the blur tried afterwards
_INTERPOLATED = 1 / 6  # px^2, variance that linear interpolation adds to the blur
_WIDEST = 10.0  # px; greatest distance from the edges at which sharpening is looked for
_BLURRED = 2.0  # sigma from a code, which its blur reaches
_CODES_APART = 0.8  # sigma between a profile and the inner code, below which blur makes it a part of it
# Factors on the blur for all pixels, in two rounds; profiles with codes have up to 1.3 times the blur.
_BY_PIXELS = ((0.68, 0.82, 1.0), (0.96, 1.04))
_PLACES = 13  # samples across an edge
_ROOM = 1.6  # length of a profile beyond an edge, in distances of the pattern from it
_TINY = 1e-9  # least variance of the samples of a profile
_ALONG = (-0.2, -0.1, 0.0, 0.1, 0.2)  # of an edge, in squares


def fit_with_ink(raw: GridImage, ink: Ink, undo: bool = True) -> GridFit:
    """Fit a board whose cells have patterns, after sharpening by the camera is undone if `undo`."""
    ink = ink.beside(raw.grid.seen)
    gaps = _gaps(raw, ink)
    look, mapped, levels, noise, shading = _first_look(raw, ink, gaps)
    sigma = upper_median(look.blur[:, 0])
    profile = _plain_profile(raw, mapped, gaps, sigma, *levels) if undo else None
    sharpening = find_sharpening(profile)
    if sharpening is not None:
        return fit_with_ink(sharpening.undone(raw, 2 * raw.grid.square), ink, undo=False)
    inked = InkedPixels.of(raw, ink, look)
    fitted = fit_from(inked.under(look, _FIRST_MOST), mapped, sigma, shading, levels, max(noise, raw.floor))
    look = _look_of(fitted, ink)
    gap = ink.gap * look.clearance(ink)
    rounds = next((all_of for limit, all_of in _MOST if gap > limit), _MOST_NEAR)
    for most in rounds:
        fitted = fit_again(inked.under(look, most), fitted)
        look = look.halfway_to(_look_of(fitted, ink))
    return fitted


def _look_of(fitted: GridFit, ink: Ink) -> Appearance:
    """How the board looks by a fit."""
    at, blur = fitted.map.map, fitted.blur
    lines = _crossing(at, ink)
    (along_a, _), (along_b, _) = (blur.at(line) for line in lines)
    spread = np.stack([along_a, along_b, correlation(blur, lines)], axis=-1)
    return Appearance(at, spread, float(fitted.map.shift[0]), fitted.fit.shape.tails.mean(axis=0))


def _first_look(
    raw: GridImage, ink: Ink, gaps: tuple[Array, Array, float]
) -> tuple[Appearance, MapFit, tuple[Array, Array], float, Shading]:
    """How the board looks by the found vertices and by profiles across the edges between them.

    Returns also the map of the edges, their mean levels and half contrasts, noise [DN^2], and shading.
    """
    found = map_of_vertices(raw)
    noise = _noise(raw, found.map)
    sigmas, offsets = _SIGMAS, _OFFSETS
    for _ in range(2):
        lines = raw.edges.lines(found.map)
        values, offset = _profiles(raw, found.map, lines, gaps, sigmas, offsets)
        variance = np.full(len(offset), _OFFSET_SIGMA**2)
        observations = raw.observations(lines, offset, variance, np.ones((len(offset), 1)))
        found = fit_map(found.map, observations, found.shift)
        usual = upper_median(values[:, 2])
        sigmas, offsets = usual * _FINER, 0.3 * _OFFSETS
    sigma = float(np.sqrt(max(usual**2 - _INTERPOLATED, LEAST_BLUR**2)))
    crossing, ones = _crossing(found.map, ink), np.ones(len(ink.cell))
    rho = (crossing[0].normal * crossing[1].normal).sum(axis=1)
    blur = np.stack([sigma * ones, sigma * ones, rho], axis=-1)
    look = Appearance(found.map, blur, float(found.shift[0]), np.zeros(2))
    mean, contrast, shading = _levels(found.map, lines, values[:, 0], values[:, 1])
    if ink.border and (ink.border - (_ROOM - 1) * ink.gap) * look.clearance(ink) < _CODES_APART:
        edges = np.column_stack([offset, np.zeros(len(offset)), mean, contrast, sigma + 0 * offset])
        look, edges, noise = _by_pixels(raw, ink, look, lines, edges, shading)
        mean, contrast, shading = _levels(found.map, lines, edges[:, MEAN], edges[:, CONTRAST])
    return look, found, (mean, contrast), noise, shading


def _levels(at: SmoothMap, lines: Lines, mean: Array, contrast: Array) -> tuple[Array, Array, Shading]:
    """Mean levels and half contrasts of edges, and the shading through them."""
    variance = np.ones(len(mean))
    dark, light = (Levels(lines.middle, mean + sign * contrast, variance) for sign in (-1, 1))
    smooth = fit_shading(at.frame, dark, light)
    return mean, contrast, adapted_shading(smooth, dark, light)


def _by_pixels(
    raw: GridImage, ink: Ink, look: Appearance, lines: Lines, edges: Array, shading: Shading
) -> tuple[Appearance, Array, float]:
    """Look with the blur that suits all pixels around the edges best, their values (E, 5), noise [DN^2].

    Offset and levels of each edge follow from each blur by one step from the values known so far.
    """
    free = np.array([OFFSET, MEAN, CONTRAST]) % edges.shape[1]
    shape = ProfileShape(np.zeros((len(edges), 2)), np.zeros(RESPONSE_TERMS))
    usual, reach = upper_median(edges[:, BLUR]), REACH * edges[:, BLUR]
    inked = InkedPixels.of(raw, ink, look)

    def tried(sigma: float) -> tuple[float, Appearance, Array]:
        values = edges.copy()
        values[:, BLUR] = sigma
        blur = np.column_stack([np.full((len(ink.cell), 2), sigma), look.blur[:, 2]])
        own = replace(look, blur=blur, shift=0.0)
        light = inked.under(own, _ALL)
        pixels = edge_pixels(light, lines, values[:, BLUR], shading, reach, usual_stride(lines))
        products = edge_model(pixels, values, shape).products(edges.shape[1])
        information, gradient = products[:, 1 + free[:, None], 1 + free], products[:, 1 + free, :1]
        step = np.linalg.solve(information + _TINY * np.eye(len(free)), gradient)
        values[:, free] += step[:, :, 0]
        left = products[:, 0, 0] - (step * gradient).sum(axis=(1, 2))
        count = np.count_nonzero(pixels.root, axis=1) - len(free)
        return upper_median(left / np.maximum(count, 1)), own, values

    known: dict[float, float] = {}
    for factors in _BY_PIXELS:
        known |= {usual * factor: tried(usual * factor)[0] for factor in factors}
        nearest = sorted(known, key=known.__getitem__)[:3]
        bend, slope, _ = np.polyfit(np.log(nearest), [known[one] for one in nearest], 2)
        best = float(np.exp(-0.5 * slope / bend)) if bend > 0 else nearest[0]
        usual = float(np.clip(best, min(nearest), max(nearest)))
        known[usual], look, edges = tried(usual)
    return look, edges, known[usual]


def _noise(raw: GridImage, at: SmoothMap) -> float:
    """Variance of a pixel [DN^2], in the squares of the colour that has no patterns."""
    dark, light, _ = square_levels(raw.image, raw.grid, at)
    return min(upper_median(one.variance) for one in (dark, light)) / LEVEL_VARIANCE


def _crossing(at: SmoothMap, ink: Ink) -> tuple[Lines, Lines]:
    """Lines through the middles of cells, along b and along a."""
    middle, ones = np.asarray(ink.cell + 0.5, dtype=float), np.ones(len(ink.cell))
    vertical = np.ones(len(middle), dtype=np.bool_)
    return grid_lines(at, middle, vertical, ones), grid_lines(at, middle, ~vertical, ones)


def _profiles(
    raw: GridImage,
    at: SmoothMap,
    lines: Lines,
    gaps: tuple[Array, Array, float],
    sigmas: Array,
    offsets: Array,
) -> tuple[Array, Array]:
    """Mean level, half contrast and blur (E, 3) of edges, and their offsets (E,) [px], by profiles across.

    The first line of a marker, at a known distance on one side, is part of the profile: the marker is of the
    other colour than the cell in which it is.
    """
    share, side, clear = gaps
    # In perspective, the marker's line is not at its share of the distance to the next line.
    across = np.where(raw.edges.vertical[:, None], [1.0, 0.0], [0.0, 1.0])
    inside = raw.edges.centre + (share * side * raw.edges.light)[:, None] * across
    gap = np.abs(((at.at(inside) - lines.middle) * lines.normal).sum(axis=1))
    near = share < 0.5
    half = np.minimum(np.where(near, _ROOM * gap, clear * lines.apart[:, 0]), 0.4 * lines.width)
    d = np.linspace(-1, 1, _PLACES) * half[:, None]
    image = np.asarray(raw.image, dtype=np.float32)
    seen = np.zeros(d.shape)
    for part in _ALONG:
        middle = lines.middle + (part * lines.length)[:, None] * lines.tangent
        seen += interpolate(image, middle[:, None] + d[..., None] * lines.normal[:, None]) / len(_ALONG)
    level = seen.mean(axis=1)
    moved, profile = (x.astype(np.float32) for x in (d - offsets[:, None, None], seen - level[:, None]))
    sign, room = (x.astype(np.float32)[:, None] for x in (side, gap))
    per_sigma = (1 / sigmas).astype(np.float32)[:, None, None, None]
    x = erf_and_density(moved * per_sigma)[0]
    if near.any():
        x -= sign * near[:, None] * (1 + erf_and_density((sign * moved - room) * per_sigma)[0])
    # The line through the profile over x.
    sum_x, product_x, squares = (
        np.einsum(f"soen{of}->soe", x, *other, dtype=float)
        for of, other in (("", ()), (",en", (profile,)), (",soen", (x,)))
    )
    contrasts = _PLACES * product_x / np.maximum(_PLACES * squares - sum_x**2, _TINY)
    costs = np.where(contrasts > 0, -contrasts * product_x, np.inf)
    means = level - contrasts * sum_x / _PLACES
    every = np.arange(len(d))
    k, j = np.divmod(costs.reshape(-1, len(d)).argmin(axis=0), len(offsets))
    # The least of the parabola through the costs of three offsets.
    three = np.stack([costs[k, np.clip(j + step, 0, len(offsets) - 1), every] for step in (-1, 0, 1)])
    inner = (j > 0) & (j < len(offsets) - 1) & np.isfinite(three).all(axis=0)
    before, here, after = np.where(inner, three, 0.0)
    bend = before - 2 * here + after
    part = 0.5 * np.divide(before - after, bend, out=np.zeros(len(d)), where=bend > 0)
    found = offsets[j] + part * (offsets[1] - offsets[0])
    return np.column_stack([means[k, j, every], contrasts[k, j, every], sigmas[k]]), found


def _plain_profile(
    raw: GridImage,
    mapped: MapFit,
    gaps: tuple[Array, Array, float],
    sigma: float,
    mean: Array,
    contrast: Array,
) -> EdgeProfile | None:
    """Mean profile of the edges by the sides that have no patterns.

    What is beyond an edge with a pattern is what is before it, with the levels exchanged.
    """
    lines, (gap, side, clear) = raw.edges.lines(mapped.map), gaps
    offset = mapped.residual[: len(gap)] + mapped.shift[0]
    blank = clear * lines.apart[:, 0] - _BLURRED * sigma
    half = np.maximum(np.minimum(np.minimum(_WIDEST, 0.35 * lines.width), blank), 0.0)
    strips = strip_pixels(raw.image, lines, half, 0.2 * lines.length[:, None], usual_stride(lines))
    zero, middle = (x.astype(np.float32)[:, None] for x in (offset, mean))
    patterned = (gap < 0.5)[:, None]
    plain = strips.inside & ~(patterned & (side[:, None] * (strips.d - zero) > 0))
    d, value, inside = (
        np.concatenate(pair, axis=1)
        for pair in (
            (strips.d, 2 * zero - strips.d),
            (strips.value, 2 * middle - strips.value),
            (plain, plain & patterned),
        )
    )
    found = edge_profile(d, value, inside, offset, mean, contrast)
    return None if found is None else replace(found, reflected=True)


def _gaps(raw: GridImage, ink: Ink) -> tuple[Array, Array, float]:
    """Distance (E,) [cells] of each edge from the nearest pattern, and (E,) +1 if it is on the light side.

    Also that of codes within dark cells.
    """
    edges, cells = raw.edges, ink.cell
    unlike = ink.light != ink.base[:, None, None]
    bordered = unlike[:, 0].all(axis=1), unlike[:, :, 0].all(axis=1)
    gap, sign = np.ones(len(edges.index)), np.ones(len(edges.index))
    for after in (0, 1):
        beside = edges.index - (1 - after) * np.where(edges.vertical[:, None], [1, 0], [0, 1])
        e, k = np.nonzero((beside[:, None] == cells).all(axis=2))
        e = e[np.where(edges.vertical[e], bordered[1][k], bordered[0][k])]
        gap[e], sign[e] = ink.lines[0], edges.light[e] * (1 if after else -1)
    return gap, sign, ink.gap if (ink.base < 0).all() else np.inf

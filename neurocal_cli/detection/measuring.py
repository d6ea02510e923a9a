"""Measure the mid-points or vertices of a grid to the limit set by the pixel noise.

Each edge is fitted to all pixels around it. A smooth map from grid to pixels, fitted to all edges, gives the
curvature of the edges and the position of each mid-point along its edge. The position across the edge comes
from that edge alone. Gamma, ink spread and blooming displace all edges towards the dark or the light side: an
alternating shift between edges and map, which is estimated and removed.

The outermost mid-points may be measured along their edges as well (`positions_along_edges`). At the ends of
the outermost edges, the last pieces of two grid lines begin, which lead to the rim of the board. They are
fitted, too, and have no mid-points of their own: what they measure is the position along the outermost edges.

         |       |        the edges to the rim, measured across themselves
    -----+---x---+-----   x: a mid-point in the outermost row
         |       |

Such an edge departs from a map of the lens, which all edges of the board determine, by its own error alone.
This departure is added to the map at a mid-point beside it. So each edge to the rim serves one mid-point, and
the errors of all mid-points stay independent of each other.

The map must be accurate up to the rim. So it contains the lens, with tangential distortion and k3, and no
polynomial, which would extrapolate badly. If the edges do not agree with it within their noise, as on paper
boards, what they depart in common is taken off instead (`find_departures`). Mid-points whose edges to the rim
alone do not agree stay as they are.

Edges of paper boards depart from any smooth map. An edge departs towards the growing coordinate across it by

    f = mean of w at both ends +- q + e

w are departures of the vertices, q is a shift towards the light side in addition to those that all edges have
in common, and e is the edge's own error. The sign of q is that of the edge's polarity. It alternates along a
line, so that neighbours tell q from w. w and q have a part that is alike at near places, with the correlation
``(1 + d) exp(-d)`` at a distance of d squares, and w has another part of each vertex. The variances of all
parts are those that make the departures in the image most likely, and then q is the most likely one.

The position of a mid-point along its edge is moved by what the lines that cross the edge at both ends depart.
There, light and dark squares meet in pairs, so that q hardly matters.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import BLUR
from neurocal_cli.detection.fitting.edge_fit import OFFSET, TILT
from neurocal_cli.detection.fitting.edge_profile import response, sharp_profile
from neurocal_cli.detection.fitting.grid_fit import GridFit, fit_grid, fit_rim, fit_small, map_to_rim
from neurocal_cli.detection.fitting.strips import GridEdges, GridImage, grid_lines
from neurocal_cli.detection.fitting.vertex_fit import FIRST, SECOND, fit_grid_vertices
from neurocal_cli.detection.grey import least_variance
from neurocal_cli.detection.grid import EDGE_H, EDGE_V, Grid, Measured, squares_of
from neurocal_cli.detection.markers.ink import Ink
from neurocal_cli.detection.markers.ink_fit import fit_with_ink
from neurocal_cli.detection.medians import upper_median
from neurocal_cli.observations.measured_directions import variance_across

Points: TypeAlias = Literal["midpoints", "edges", "vertices"]

_FAR, _PLACES = 3.0, 601  # to find an edge's middle level: sigma on both sides, and number of samples
# Ratio of the variance around the map to that of the fits, up to which the edges agree with the map. It is
# 0.7 to 1.6 in rendered images (test_rendered_sets.py), and 9 to 300 in photographs of paper boards.
_AGREES = 2.0
_ENDS = np.array([[0, 0], [1, 0]])  # of an edge along c, from its first vertex
_MOST_EXPLAINED = 0.8  # share of the unevenness
_WORTH = 10.0  # greatest variance along an edge that is used, over that across it
_FAINT = 0.1  # least contrast around a vertex, over that of the lit ones
_OUTLIER = 4.0  # standard deviations beyond which the departure of an edge to the rim is not used


def measure(
    image: NDArray[np.generic],
    grid: Grid,
    points: Points = "midpoints",
    gamma: float | None = None,
    ink: Ink | None = None,
) -> Measured:
    """Measure the mid-points of edges, or the vertices, of a grid with vertices known to half a pixel.

    The grey image (H, W) is uint8, uint16 or float. `points` are the mid-points of the edges between known
    vertices ("midpoints"), these and the mid-points of the edges to the rim ("edges"), or the vertices. If a
    camera's `gamma` is given, pixels are ``light^(1 / gamma)`` and are linearised first; without it, the
    effect of the response on the edges is estimated. `ink` are the markers on a board, if it has any. Points
    whose fits are rejected are left out.
    """
    light = image if gamma is None else linearised(image, gamma)
    if ink is None:
        grid = _lit(light, grid)
    grid_image = GridImage(light, grid, least_variance(light))
    vertices = np.full(grid.pixels.shape, np.nan)
    if len(grid_image.edges.index) == 0:
        index = np.zeros((0, 2), dtype=np.int64)
        return Measured(index[:, 0], index, np.zeros((0, 2)), np.zeros((0, 3)), None, vertices, 0, 0.0)
    fitted = fit_grid(grid_image) if ink is None else fit_with_ink(grid_image, ink)
    grid_image = fitted.grid_image
    if grid_image.is_small:
        fitted = fit_small(grid_image, fitted)
    vertices[grid.seen] = fitted.map.map.at(grid_image.vertices)
    if points == "vertices":
        return _vertices(grid_image, fitted, vertices)
    uneven = fitted.map.excess > _AGREES
    if grid.paired:  # there is nothing along the edges, and no rim
        # Fewer edges than the map has unknowns rest on the corners, of which one may be read wrongly.
        good = fitted.good & (fitted.good.sum() >= len(fitted.map.map.free))
        return _midpoints(grid_image.edges, fitted, fitted.unevenness, vertices).only(good)
    inner = _midpoints(grid_image.edges, fitted, fitted.unevenness, vertices, uneven)
    if points == "midpoints":
        along = positions_along_edges(grid_image, fitted)
        return (inner if along is None else _measured_both_ways(inner, along)).only(fitted.good)
    inner, to_rim = inner.only(fitted.good), fit_rim(grid_image, fitted)
    if to_rim is None:
        return inner
    rim, fitted_rim = to_rim
    return inner.joined_with(_midpoints(rim, fitted_rim, fitted.unevenness, vertices).only(fitted_rim.good))


def _lit(light: NDArray[np.generic], grid: Grid) -> Grid:
    """The grid without the vertices in a deep shadow, where the levels of the lit squares tell nothing."""
    centres = squares_of(grid.pixels).mean(axis=2)
    known = np.isfinite(centres[..., 0])
    level = np.full(known.shape, -np.inf)
    u, v = np.rint(centres[known]).astype(np.intp).T
    level[known] = light[v, u]
    # The lightest and the darkest of the squares around each vertex.
    around = (np.pad(x, 1, constant_values=-np.inf) for x in (level, np.where(known, -level, -np.inf)))
    high, low = (np.maximum.reduce([x[:-1, :-1], x[:-1, 1:], x[1:, :-1], x[1:, 1:]]) for x in around)
    contrast = high + low
    usual = np.quantile(contrast[contrast > 0], 0.9) if (contrast > 0).any() else 0.0
    faint = (contrast > 0) & (contrast < _FAINT * usual)
    return replace(grid, pixels=np.where(faint[..., None], np.nan, grid.pixels)) if faint.any() else grid


def linearised(image: NDArray[np.generic], gamma: float) -> NDArray[np.float32]:
    """Linearise the image, keeping its full scale."""
    if np.issubdtype(image.dtype, np.integer):
        full = float(np.iinfo(image.dtype).max)  # type: ignore[type-var]
        table = full * (np.arange(full + 1) / full) ** gamma
        return np.asarray(table.astype(np.float32)[image])
    full = float(np.max(image))
    return np.asarray(full * (np.clip(image.astype(np.float32), 0, None) / full) ** gamma, dtype=np.float32)


def _midpoints(
    edges: GridEdges, fitted: GridFit, unevenness: float, vertices: Array, uneven: bool = False
) -> Measured:
    """Combine positions along the edges from the map with those across from the edge fits.

    The variance across the edges includes `unevenness` [px^2]. If the board is `uneven`, departures from the
    map that the edges have in common are taken from them; see `find_departures`.
    """
    lines, fit, mapped = fitted.lines, fitted.fit, fitted.map
    centre = edges.centre
    s = ((mapped.map.at(centre) - lines.middle) * lines.tangent).sum(axis=1)
    along = mapped.map.variance(centre, lines.tangent) * mapped.excess
    across = fit.covariance[:, OFFSET, OFFSET] * fit.variance_growth * min(mapped.excess, 1.0)
    across += fitted.shift_variance + unevenness
    shift = fitted.shift
    if uneven:
        found = _departures(edges, fitted)
        slant = np.abs(np.einsum("eki,ei->ek", lines.crossing, lines.tangent)).mean(axis=1)
        s += found.along / slant
        shift = shift + found.shift
        across -= np.minimum(found.explained, _MOST_EXPLAINED * unevenness)
        told = found.counted > 0
        along[told] = upper_median(across) / found.counted[told] / slant[told] ** 2
    d = fit.values[:, OFFSET] + fit.values[:, TILT] * s / (0.5 * lines.length)
    d += 0.5 * lines.curvature * s * s - shift
    pixels = lines.middle + s[:, None] * lines.tangent + d[:, None] * lines.normal
    (tu, tv), (nu, nv) = lines.tangent.T, lines.normal.T
    covariance = np.stack(
        [
            along * tu * tu + across * nu * nu,
            along * tu * tv + across * nu * nv,
            along * tv * tv + across * nv * nv,
        ],
        axis=-1,
    )
    return Measured(
        kind=np.where(edges.vertical, EDGE_V, EDGE_H).astype(np.int64),
        index=edges.index,
        pixels=pixels,
        covariance=covariance,
        across=lines.normal,
        vertices=vertices,
        rejected=0,
        polarity=_polarity(fitted),
    )


def _departures(edges: GridEdges, fitted: GridFit) -> Departures:
    """Departures of the edges from the map that have causes in common."""
    lines, fit, at = fitted.lines, fitted.fit, fitted.map.map
    ends = edges.index[:, None] + np.where(edges.vertical[:, None, None], _ENDS[:, ::-1], _ENDS)
    # Where the map has both ends, beside the lines of the fits.
    mapped = ((at.at(ends.astype(float)) - lines.middle[:, None]) * lines.normal[:, None]).sum(axis=2)
    mapped -= 0.5 * lines.curvature[:, None] * lines.ends**2
    tilt = fit.values[:, TILT] - 0.5 * (mapped[:, 1] - mapped[:, 0])
    departure, variance = fitted.map.residual[: len(tilt)], fit.covariance[:, OFFSET, OFFSET]
    return find_departures(ends, edges.light, departure, tilt, variance, fitted.good)


def _polarity(fitted: GridFit) -> float:
    """Displacement of the mid-level crossing from the true edge, towards the dark side [px]."""
    z = np.linspace(-_FAR, _FAR, _PLACES)[None]
    sigma = upper_median(fitted.fit.values[:, BLUR])
    shape = fitted.fit.shape
    half = None if shape.half is None else shape.half[:1]
    edge = sharp_profile(z, np.array([[sigma]]), shape.tails[:1], half)[0]
    light = response(edge, shape.nonlinearity)[0][0]
    after = max(int(np.argmax(light > 0)), 1)
    share = light[after] / (light[after] - light[after - 1])
    zero = z[0, after] - share * (z[0, 1] - z[0, 0])
    return -float(fitted.map.shift[0]) - float(zero) * sigma


def _vertices(grid_image: GridImage, fitted: GridFit, vertices: Array) -> Measured:
    """Fit the vertices, and write the reliable ones to `vertices` (rows, cols, 2) [px] as well."""
    fit, (first, second), good = fit_grid_vertices(grid_image, fitted)
    # Intersection of the two lines: n1 . p = offset1, n2 . p = offset2.
    inverse = np.linalg.inv(np.stack([first.normal, second.normal], axis=1))
    offsets = fit.values[:, [FIRST, SECOND]]
    pixels = first.middle + (inverse @ offsets[:, :, None])[:, :, 0]
    spread = fit.covariance[:, [[FIRST], [SECOND]], [FIRST, SECOND]] * fit.variance_growth[:, None, None]
    spread = inverse @ spread @ inverse.swapaxes(1, 2) + fitted.unevenness * np.eye(2)
    vertices[grid_image.grid.seen] = np.where(good[:, None], pixels, np.nan)
    index = grid_image.vertices.astype(np.int64)
    return Measured.of_vertices(index, pixels, spread, vertices, _polarity(fitted)).only(good)


@frozen_dataclass(eq=False)
class AlongEdges:
    """Positions of M mid-points along their edges: ``direction . p = value``."""

    rows: NDArray[np.intp]  # (M,) of the mid-points among the edges of the grid
    direction: Array  # (M, 2) unit normals of the grid lines that cross the edges
    value: Array  # (M,) [px]
    variance: Array  # (M,) [px^2]

    def only(self, which: NDArray[np.bool_]) -> AlongEdges:
        """Some of them."""
        return AlongEdges(self.rows[which], self.direction[which], self.value[which], self.variance[which])


def positions_along_edges(grid_image: GridImage, fitted: GridFit) -> AlongEdges | None:
    """Measure where the outermost mid-points lie along their edges; None if the map is not accurate."""
    if fitted.map.excess > _AGREES or (found := map_to_rim(grid_image, fitted)) is None:
        return None
    rim, fit, mapped = found
    edges, n = grid_image.edges, len(grid_image.edges.index)
    serves = edges_served(grid_image.grid.shape, edges, rim, fitted.good)
    if mapped.excess > _AGREES:
        return None
    variance = fit.fit.covariance[:, OFFSET, OFFSET] * fit.fit.variance_growth + fitted.unevenness
    variance *= max(mapped.excess, 1.0)
    departure = mapped.residual[-len(rim.index) :] * rim.light
    used = fit.good & (serves >= 0) & (departure**2 < _OUTLIER**2 * variance)
    if not used.any():
        return None
    weight, departure = 1 / variance[used], departure[used]
    total = np.bincount(serves[used], weight, n)
    mean = np.bincount(serves[used], weight * departure, n)
    rows = np.flatnonzero(total)
    crossing = grid_lines(mapped.map, edges.centre[rows], ~edges.vertical[rows], np.ones(len(rows)))
    direction = crossing.normal / np.hypot(*crossing.normal.T)[:, None]
    value = (crossing.middle * direction).sum(axis=1) + mean[rows] / total[rows]
    return AlongEdges(rows, direction, value, 1 / total[rows])


def edges_served(
    shape: tuple[int, int], edges: GridEdges, rim: GridEdges, good: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Find the edge whose mid-point each edge to the rim serves, among the `good` ones; -1 for none.

    Two edges between vertices cross the edge to the rim at its known vertex. The one towards the middle of
    the board, of (cols, rows) vertices, is preferred.
    """
    cols, rows = shape
    row_of = np.full((2, cols + 2, rows + 2), -1, dtype=np.intp)  # one longer on each side
    c, r = edges.index[good].T + 1
    row_of[edges.vertical[good].astype(int), c, r] = np.flatnonzero(good)
    along = np.where(rim.vertical[:, None], [0, 1], [1, 0])
    vertex = rim.index + along * rim.known[:, 1:]
    across = 1 - along
    before_middle = (vertex * across).sum(axis=1) < 0.5 * ((np.array(shape) - 1) * across).sum(axis=1)
    kind = 1 - rim.vertical.astype(int)
    begin, end = ((vertex + 1 - step * across).T for step in (0, 1))
    ahead, behind = row_of[kind, begin[0], begin[1]], row_of[kind, end[0], end[1]]
    first, second = np.where(before_middle, (ahead, behind), (behind, ahead))
    return np.where(first >= 0, first, second)


def _measured_both_ways(midpoints: Measured, along: AlongEdges) -> Measured:
    """Replace the positions of some mid-points along their edges by measured ones."""
    across = midpoints.across
    assert across is not None
    variance = variance_across(midpoints.covariance[along.rows], across[along.rows])
    # Short edges to the rim, as on tags, tell too little.
    worth = along.variance < _WORTH * variance
    rows, variance, along = along.rows[worth], variance[worth], along.only(worth)
    n = across[rows]
    # Intersection of two lines: n . p = value across the edge, direction . p = value along it.
    inverse = np.linalg.inv(np.stack([n, along.direction], axis=1))
    value = np.stack([(midpoints.pixels[rows] * n).sum(axis=1), along.value], axis=1)
    pixels, covariance, directions = midpoints.pixels.copy(), midpoints.covariance.copy(), across.copy()
    pixels[rows] = (inverse @ value[:, :, None])[:, :, 0]
    spread = (inverse * np.stack([variance, along.variance], axis=1)[:, None]) @ inverse.swapaxes(1, 2)
    covariance[rows] = spread.reshape(-1, 4)[:, [0, 1, 3]]
    directions[rows] = 0.0
    return replace(midpoints, pixels=pixels, covariance=covariance, across=directions)


_STEPS = 10
_FIRST = (0.5, 0.2, 0.1, 0.2)  # shares of the mean square, from which the variances begin
_LEAST = 1e-4  # of the mean square, least variance
_TOGETHER = 250  # edges that are estimated together


@frozen_dataclass(eq=False)
class Departures:
    """What E edges say of each other."""

    # (E,) [px] displacement of mid-points along their edges towards the growing coordinate, and the number
    # of edges that say so
    along: Array
    counted: NDArray[np.int64]
    shift: Array  # (E,) [px] local shift of the edges towards the light side
    shift_variance: Array  # (E,) [px^2]
    explained: Array  # (E,) [px^2] variance that the edges lose with their local shifts


def find_departures(
    ends: NDArray[np.int64],
    light: Array,
    departure: Array,
    tilt: Array,
    variance: Array,
    good: NDArray[np.bool_],
) -> Departures:
    """Estimate departures of edges between vertices `ends` (E, 2, 2) [squares], of which some are `good`.

    `light` (E,) is +1 if the light side is that of the growing coordinate, else -1. `departure` (E,) [px] is
    that of the edge's middle towards the light side, of `variance` (E,) by the noise, and `tilt` (E,) [px] is
    how much more its second end departs.
    """
    crossing = ends[:, 0, 0] == ends[:, 1, 0]
    vertices, at = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    at = at.reshape(-1, 2)
    total, count = np.zeros((2, 2, len(vertices)))
    some = np.flatnonzero(good)
    for k, sign in ((0, -0.5), (1, 0.5)):
        # The nearer half of the edge, as for a vertex.
        half = (light * (departure + sign * tilt))[some]
        place = crossing[some].astype(np.intp), at[some, k]
        np.add.at(total, place, half)
        np.add.at(count, place, 1.0)
    other = 1 - crossing.astype(np.intp)
    told = total[other[:, None], at] / np.maximum(count[other[:, None], at], 1)
    shift, spread, explained = np.zeros((3, len(light)))
    for part in _parts(ends.mean(axis=1), some):
        shift[part], spread[part], explained[part] = _shifts(
            ends[part], crossing[part], light[part], departure[part], variance[part]
        )
    counted = count[other[:, None], at]
    return Departures(told.mean(axis=1), counted.sum(axis=1).astype(np.int64), shift, spread, explained)


def _parts(centre: Array, some: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Divide edges into neighbourhoods that are estimated together."""
    if len(some) <= _TOGETHER:
        return [some] if len(some) else []
    span = np.ptp(centre[some], axis=0)
    order = np.argsort(centre[some, int(span.argmax())], kind="stable")
    return [part for half in np.array_split(some[order], 2) for part in _parts(centre, half)]


def _shifts(
    ends: NDArray[np.int64], crossing: NDArray[np.bool_], light: Array, departure: Array, variance: Array
) -> tuple[Array, Array, Array]:
    """Local shifts of N edges towards the light side, their variances, and how much these are reduced."""
    f, usual = light * departure, float(np.mean(departure**2))
    apart = ends[:, None, :, None] - ends[:, None]  # (N, N, 2, 2, 2) between ends
    same = crossing[:, None] == crossing
    own = 0.25 * (apart == 0).all(axis=-1).sum(axis=(2, 3)) * same
    near = _alike(np.hypot(*(ends.mean(axis=1)[:, None] - ends.mean(axis=1)).transpose(2, 0, 1)))
    polarity = light[:, None] * light
    kernels = np.stack([own, near * same, near * polarity, np.eye(len(f))])
    noise, amounts = np.diag(variance), usual * np.array(_FIRST)
    for _ in range(_STEPS):
        inverse = np.linalg.inv(np.tensordot(amounts, kernels, 1) + noise)
        weights = inverse @ f
        # Each variance grows or shrinks by the ratio of what it should explain to what it does.
        share = (kernels @ weights) @ weights / np.einsum("ij,kij->k", inverse, kernels)
        amounts = np.maximum(amounts * share, _LEAST * usual)
    inverse = np.linalg.inv(np.tensordot(amounts, kernels, 1) + noise)
    shift = amounts[2] * kernels[2]
    explained = np.einsum("ei,ij,ej->e", shift, inverse, shift)
    return light * (shift @ (inverse @ f)), amounts[2] - explained, explained


def _alike(distance: Array) -> Array:
    return np.asarray((1 + distance) * np.exp(-distance))

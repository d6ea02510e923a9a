"""Measure the mid-points or vertices of a grid to the limit set by the pixel noise.

Each edge is fitted to all pixels around it. A smooth map from grid to pixels, fitted to all edges, gives the
curvature of the edges and the position of each mid-point along its edge. The position across the edge comes
from that edge alone. The outermost mid-points may be measured along their edges as well (`crossing_edges`).
Gamma, ink spread and blooming displace all edges towards the dark or the light side: an alternating shift
between edges and map, which is estimated and removed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import BLUR
from neurocal_cli.detection.fitting.crossing_edges import AlongEdges, positions_along_edges
from neurocal_cli.detection.fitting.edge_fit import OFFSET, TILT
from neurocal_cli.detection.fitting.edge_profile import response, sharp_profile
from neurocal_cli.detection.fitting.grid_fit import (
    GridEdges,
    GridFit,
    GridImage,
    fit_grid,
    fit_grid_vertices,
    fit_rim,
)
from neurocal_cli.detection.fitting.vertex_fit import FIRST, SECOND
from neurocal_cli.detection.grid import EDGE_H, EDGE_V, VERTEX, Grid, Measured
from neurocal_cli.detection.medians import upper_median

Points: TypeAlias = Literal["midpoints", "edges", "vertices"]

_ROUNDING = 1 / 12  # DN^2
_EXACT, _TINY = 1e-5, 1e-30  # relative standard deviation and least variance assumed for noise-free images
_FAR, _PLACES = 3.0, 601  # to find an edge's middle level: sigma on both sides, and number of samples


def measure(
    image: NDArray[np.generic], grid: Grid, points: Points = "midpoints", gamma: float | None = None
) -> Measured:
    """Measure the mid-points of edges, or the vertices, of a grid with vertices known to half a pixel.

    The grey image (H, W) is uint8, uint16 or float. `points` are the mid-points of the edges between known
    vertices ("midpoints"), these and the mid-points of the edges to the rim ("edges"), or the vertices. If a
    camera's `gamma` is given, pixels are ``light^(1 / gamma)`` and are linearised first; without it, the
    effect of the response on the edges is estimated. Points whose fits are rejected are left out.
    """
    light = image if gamma is None else _linear(image, gamma)
    whole = np.issubdtype(light.dtype, np.integer)
    floor = _ROUNDING if whole else (_EXACT * float(np.abs(light).max())) ** 2 + _TINY
    grid_image = GridImage(light, grid, floor)
    vertices = np.full(grid.pixels.shape, np.nan)
    if len(grid_image.edges.index) == 0:
        index = np.zeros((0, 2), dtype=np.int64)
        return Measured(index[:, 0], index, np.zeros((0, 2)), np.zeros((0, 3)), None, vertices, 0, 0.0)
    fitted = fit_grid(grid_image)
    vertices[grid.seen] = fitted.map.map.at(grid_image.vertices)
    if points == "vertices":
        return _vertices(grid_image, fitted, vertices)
    inner = _midpoints(grid_image.edges, fitted, fitted.unevenness, vertices)
    if points == "midpoints":
        along = positions_along_edges(grid_image, fitted)
        return (inner if along is None else _measured_both_ways(inner, along)).only(fitted.good)
    rim, fitted_rim = fit_rim(grid_image, fitted)
    outer = _midpoints(rim, fitted_rim, fitted.unevenness, vertices)
    return inner.only(fitted.good).joined_with(outer.only(fitted_rim.good))


def _midpoints(edges: GridEdges, fitted: GridFit, unevenness: float, vertices: Array) -> Measured:
    """Combine positions along the edges from the map with those across from the edge fits.

    The variance across the edges includes `unevenness` [px^2].
    """
    lines, fit, mapped = fitted.lines, fitted.fit, fitted.map
    centre = edges.centre
    s = ((mapped.map.at(centre) - lines.middle) * lines.tangent).sum(axis=1)
    d = fit.values[:, OFFSET] + fit.values[:, TILT] * s / (0.5 * lines.length)
    d += 0.5 * lines.curvature * s * s - fitted.shift
    pixels = lines.middle + s[:, None] * lines.tangent + d[:, None] * lines.normal
    along = mapped.map.variance(centre, lines.tangent) * mapped.excess
    across = fit.covariance[:, OFFSET, OFFSET] * fit.variance_growth * min(mapped.excess, 1.0)
    across += fitted.shift_variance + unevenness
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


def _measured_both_ways(midpoints: Measured, along: AlongEdges) -> Measured:
    """Replace the positions of some mid-points along their edges by measured ones."""
    rows, across = along.rows, midpoints.across
    assert across is not None
    n = across[rows]
    suu, suv, svv = midpoints.covariance[rows].T
    variance = suu * n[:, 0] ** 2 + 2 * suv * n[:, 0] * n[:, 1] + svv * n[:, 1] ** 2
    # Intersection of two lines: n . p = value across the edge, direction . p = value along it.
    inverse = np.linalg.inv(np.stack([n, along.direction], axis=1))
    value = np.stack([(midpoints.pixels[rows] * n).sum(axis=1), along.value], axis=1)
    pixels, covariance, directions = midpoints.pixels.copy(), midpoints.covariance.copy(), across.copy()
    pixels[rows] = (inverse @ value[:, :, None])[:, :, 0]
    spread = (inverse * np.stack([variance, along.variance], axis=1)[:, None]) @ inverse.swapaxes(1, 2)
    covariance[rows] = spread.reshape(-1, 4)[:, [0, 1, 3]]
    directions[rows] = 0.0
    return replace(midpoints, pixels=pixels, covariance=covariance, across=directions)


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
    fit, (first, second), good = fit_grid_vertices(grid_image, fitted)
    # Intersection of the two lines: n1 . p = offset1, n2 . p = offset2.
    inverse = np.linalg.inv(np.stack([first.normal, second.normal], axis=1))
    offsets = fit.values[:, [FIRST, SECOND]]
    pixels = first.middle + (inverse @ offsets[:, :, None])[:, :, 0]
    spread = fit.covariance[:, [[FIRST], [SECOND]], [FIRST, SECOND]] * fit.variance_growth[:, None, None]
    spread = inverse @ spread @ inverse.swapaxes(1, 2)
    uneven = fitted.unevenness
    covariance = np.stack([spread[:, 0, 0] + uneven, spread[:, 0, 1], spread[:, 1, 1] + uneven], axis=-1)
    vertices[grid_image.grid.seen] = np.where(good[:, None], pixels, np.nan)
    return Measured(
        kind=np.full(len(pixels), VERTEX, dtype=np.int64),
        index=grid_image.vertices.astype(np.int64),
        pixels=pixels,
        covariance=covariance,
        across=None,
        vertices=vertices,
        rejected=0,
        polarity=_polarity(fitted),
    ).only(good)


def _linear(image: NDArray[np.generic], gamma: float) -> NDArray[np.float32]:
    """Linearise the image, keeping its full scale."""
    if np.issubdtype(image.dtype, np.integer):
        full = float(np.iinfo(image.dtype).max)  # type: ignore[type-var]
        table = full * (np.arange(full + 1) / full) ** gamma
        return np.asarray(table.astype(np.float32)[image])
    full = float(np.max(image))
    return np.asarray(full * (np.clip(image.astype(np.float32), 0, None) / full) ** gamma, dtype=np.float32)

"""Grow a lattice layer by layer, remove its outliers, and tell a fully grown one from clutter.

Every new vertex is predicted from its neighbours, searched near the prediction, and accepted if it lies
within a tolerance of it and the image around it looks like a vertex (`check_vertices`).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.lattice import (
    Index,
    Lattice,
    PredictedVertices,
    in_whole_square,
    predict_vertices,
    signs,
)
from neurocal_cli.detection.finding.saddles import Level, interpolate, refine_saddles
from neurocal_cli.detection.medians import median

# Insensitive, except _INTO and _ALONG: doubled, samples reach the next squares, and 66 of 279 points of three
# photographs are lost.
_INTO = 0.3  # squares; offset of the samples in the four squares, along both axes
_ALONG, _ASIDE = 0.36, 0.16  # squares; offsets of the samples beside the edges, along and across these
_LEAST_EVENNESS = 0.6  # a visible vertex has at least 0.9, even if blurred or noisy
_LEAST_EDGE = 0.3  # least step across an edge, relative to the contrast
# (12, 2) sample positions [squares]: in the four squares, then beside the four edges.
_OFFSETS = np.array(
    [
        # Colours alternate, beginning with dark.
        *((_INTO, _INTO), (-_INTO, _INTO), (-_INTO, -_INTO), (_INTO, -_INTO)),
        # On the dark side of each edge, and across it.
        *((_ALONG, _ASIDE), (-_ASIDE, _ALONG), (-_ALONG, -_ASIDE), (_ASIDE, -_ALONG)),
        *((_ALONG, -_ASIDE), (_ASIDE, _ALONG), (-_ALONG, _ASIDE), (-_ASIDE, -_ALONG)),
    ]
)
# Weights of the samples for the contrast and for the steps across the edges. The samples' signs are changed
# first, so that dark squares have the larger values.
_CONTRAST = np.array([0.5, -0.5, 0.5, -0.5] + [0.0] * 8)
_ACROSS = np.concatenate([np.zeros((4, 4)), np.diag([1.0, -1, 1, -1]), np.diag([-1.0, 1, -1, 1])])

# Limits of whole lattices. Insensitive.
# Greatest rms distance of vertices from the predictions of their neighbours: in squares, plus px, plus px per
# ratio of the noise (of second derivatives) to the contrast.
_OFF_MAP, _OFF_MAP_PX, _OFF_MAP_NOISE = 0.021, 0.09, 20.0
_MANY, _FEW_SMOOTH = 18, 0.6  # factor on this limit for fewer vertices, which may be aligned by chance

# Insensitive, with exceptions: half of _STEPS loses 3 of 1204 vertices, half of _MOST_SPREAD loses 47, and
# twice _WEAKEST, which exceeds the contrast of the neighbours, stops growth. test_finding.py repeats
# this.
_SEARCHED = 0.24  # squares; half width of the search around a prediction ...
_STEPS = 7  # ... and number of samples in each direction
_MOST_SPREAD = 5.0  # greatest spread of a prediction that is used
_OFF, _OFF_SPREAD, _OFF_PX = 0.045, 0.025, 0.45  # squares, squares per spread, px: see `_off`
_WEAKEST = 0.55  # least contrast, relative to the neighbours
# Stricter limits outside complete squares: least evenness, and greatest distance in units of the tolerance.
_EVEN_ALONE, _OFF_ALONE = 0.88, 0.3
_LAYERS = 200  # greatest number
_ROUNDS = 12  # greatest number of rounds of removing outliers
_SHARES = np.stack(np.meshgrid(*[np.linspace(-_SEARCHED, _SEARCHED, _STEPS)] * 2), axis=-1).reshape(-1, 2)
_PRIOR = 1 - 0.4 * np.abs(_SHARES).max(axis=1) / _SEARCHED

# One convolution counts all known neighbours (modulo 16) and those along edges (multiples of 16).
_BESIDE = 16
_COUNTS = np.array(
    [[1, _BESIDE + 1, 1], [_BESIDE + 1, 1, _BESIDE + 1], [1, _BESIDE + 1, 1]], dtype=np.float32
)


def grow(level: Level, lattice: Lattice, outwards: bool = True, reach: int = 1) -> Lattice:
    """Add vertices between the known ones and, if `outwards`, around them, until no more are accepted.

    The lattice has at least 2 x 3 vertices. With a reach of 2, growth also steps over a single hidden vertex.
    """
    sigma, start = lattice.derivative_sigma, lattice
    tried: set[tuple[int, int, int]] = set()
    top, left = 0, 0  # shift of the indices by padding
    for _ in range(_LAYERS):
        if outwards:
            lattice, shift = lattice.padded()
            top, left = top + shift[0], left + shift[1]
        row, col, support = frontier(lattice.seen, reach)
        # A place is searched again only if its number of known neighbours has changed.
        keys = list(zip((row - top).tolist(), (col - left).tolist(), support.tolist(), strict=True))
        fresh = [k for k, key in enumerate(keys) if key not in tried]
        if not fresh:
            break
        tried.update(keys)
        if len(fresh) < len(keys):
            row, col = row[fresh], col[fresh]
        lattice = _grow_layer(level, lattice, row, col, sigma, reach)
    return (lattice if lattice.seen.sum() > start.seen.sum() else start).cropped()


def frontier(seen: NDArray[np.bool_], reach: int) -> tuple[Index, Index, NDArray[np.generic]]:
    """Rows and columns of the unknown places to search next, and the number of known places around each.

    With a reach of 1, these have a known neighbour along an edge and at least one more among the eight around
    them. With a reach of 2, these are at most two places away from a known one.
    """
    counts = cv2.filter2D(seen.view(np.uint8), -1, _COUNTS, borderType=cv2.BORDER_CONSTANT)
    around = counts % _BESIDE
    near = (counts >= _BESIDE) & (around >= 2) if reach == 1 else _around(_around(seen)) > 0
    row, col = np.nonzero(near & ~seen)
    return row, col, around[row, col]


def _grow_layer(level: Level, lattice: Lattice, row: Index, col: Index, sigma: float, reach: int) -> Lattice:
    """Search vertices at places of a lattice, and add the accepted ones."""
    predicted = predict_vertices(lattice.pixels, row, col)
    height, width = level.image.shape
    u, v = predicted.points.T
    worth = (predicted.spread < _MOST_SPREAD * reach) & (predicted.area > 4)
    worth &= (u > 1) & (v > 1) & (u < width - 2) & (v < height - 2)
    if not worth.all():
        row, col, predicted = row[worth], col[worth], predicted[worth]
    if not len(row):
        return lattice
    dark = signs(row, col, lattice.dark)
    points = refine_saddles(level.image, _steepest_nearby(level, predicted, dark), sigma)
    good = np.isfinite(points[:, 0])
    points = np.where(good[:, None], points, predicted.points)
    good &= _off(predicted, points) < 1
    check = check_vertices(level, points, predicted, dark)
    good &= check.is_vertex & (check.contrast > _WEAKEST * _usual_contrast(lattice)[row, col])
    row, col = row[good], col[good]
    pixels, contrast = lattice.pixels.copy(), lattice.contrast.copy()
    pixels[row, col], contrast[row, col] = points[good], check.contrast[good]
    return Lattice(pixels, contrast, lattice.dark)


def _steepest_nearby(level: Level, predicted: PredictedVertices, dark: Array) -> Array:
    """Places near the predictions with the steepest saddle of the right sign; (N, 2) [px]."""
    places = predicted.around(_SHARES, predicted.points)
    maps = places.astype(np.float32)
    uu, uv, vv = (interpolate(x, maps) for x in level.curvature)
    (c_u, c_v), (r_u, r_v) = -dark * predicted.c.T, predicted.r.T
    steepness = (c_u * r_u)[:, None] * uu
    steepness += (c_v * r_v)[:, None] * vv
    steepness += (c_u * r_v + c_v * r_u)[:, None] * uv
    steepness *= _PRIOR
    return np.asarray(places[np.arange(len(places)), steepness.argmax(axis=1)])


def _usual_contrast(lattice: Lattice) -> Array:
    """(rows, cols) weighted mean contrast of the known vertices at most two places away."""
    seen = lattice.seen
    known = np.where(seen, lattice.contrast, 0.0)
    return np.asarray(_around(_around(known)) / np.maximum(_around(_around(seen)), 1))


def _around(values: NDArray[np.generic]) -> Array:
    """Sum over the 3 x 3 neighbourhood of each place."""
    whole = values.astype(float)
    return np.asarray(cv2.boxFilter(whole, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT))


def _off(predicted: PredictedVertices, points: Array) -> Array:
    """(N,) larger component of the distance between points and their predictions, over its tolerance."""
    away = np.abs(predicted.in_squares(points - predicted.points))
    tolerance = _OFF + _OFF_SPREAD * predicted.spread + _OFF_PX / np.maximum(predicted.width, 1e-3)
    return np.asarray(np.maximum(away[:, 0], away[:, 1]) / tolerance)


def remove_outliers(level: Level, lattice: Lattice) -> Lattice:
    """Remove vertices that do not look like one or are far from their predictions, the worst first."""
    for _ in range(_ROUNDS):
        row, col, predicted = lattice.predicted
        if not len(row):
            break
        points = lattice.pixels[row, col]
        check = check_vertices(level, points, predicted, signs(row, col, lattice.dark))
        contrast = lattice.contrast.copy()
        contrast[row, col] = check.contrast
        lattice, off = replace(lattice, contrast=contrast), _off(predicted, points)
        # Vertices outside complete squares have fewer neighbours to confirm them.
        closes = in_whole_square(lattice.seen)[row, col]
        accepted = check.is_vertex & (closes | ((check.evenness > _EVEN_ALONE) & (off < _OFF_ALONE)))
        accepted &= (predicted.area > 0) & (predicted.spread < 2 * _MOST_SPREAD)
        off = np.where(accepted, off, np.inf)
        if not (off > 1).any():
            break
        # An outlier spoils the predictions of its neighbours, so remove only the worst of a neighbourhood.
        worst = np.zeros(lattice.contrast.shape)
        worst[row, col] = off
        bad = (worst > 1) & (worst >= cv2.dilate(worst, np.ones((3, 3), np.uint8)))
        lattice = lattice.subset(~bad)
    return lattice.cropped()


@frozen_dataclass(eq=False)
class VertexCheck:
    """Result of the samples around N points."""

    # [DN] mean of the bright minus mean of the dark squares; negative if the colours are swapped
    contrast: Array
    evenness: Array  # darkest bright minus brightest dark square, over the contrast: 1 for an ideal vertex
    is_vertex: NDArray[np.bool_]  # two bright and two dark squares, and an edge between each two neighbours


def check_vertices(level: Level, points: Array, predicted: PredictedVertices, dark: Array) -> VertexCheck:
    """Sample the squares and edges around points (N, 2) [px], where the grid has the predicted steps.

    `dark` (N,) is +1 if the square towards growing c and r is dark, else -1.
    """
    places = predicted.around(_OFFSETS, points)
    value = interpolate(level.smooth, places)
    value *= -dark[:, None]
    contrast = value @ _CONTRAST
    scale = np.maximum(np.abs(contrast), 1e-9)
    flat = np.minimum(value[:, 0], value[:, 2]) - np.maximum(value[:, 1], value[:, 3])
    flat /= scale
    is_vertex = (contrast > 0) & (flat > _LEAST_EVENNESS)
    is_vertex &= (value @ _ACROSS).min(axis=1) > _LEAST_EDGE * contrast
    size = np.array(level.image.shape[::-1])
    if places.min() <= -1 or (places.max(axis=(0, 1)) >= size).any():
        # Samples beyond the border only repeat its pixels.
        is_vertex &= ((places > -1) & (places < size)).all(axis=(1, 2))
    return VertexCheck(contrast, flat, is_vertex)


def has_block(lattice: Lattice) -> bool:
    """Whether a block of 3 x 3 vertices is known; otherwise no third vertex tests the lines."""
    seen = lattice.seen
    if min(seen.shape) < 3:
        return False
    rows = seen[:-2] & seen[1:-1] & seen[2:]
    return bool((rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]).any())


def is_smooth(level: Level, lattice: Lattice) -> bool:
    """Whether the vertices lie where their neighbours predict them, within the noise."""
    row, col, predicted = lattice.predicted
    off = (
        predicted.in_squares(lattice.pixels[row, col] - predicted.points)
        / np.maximum(predicted.spread, 1.0)[:, None]
    )
    contrast = max(median(lattice.contrast), 1e-3)
    tolerated = _OFF_MAP + (_OFF_MAP_PX + _OFF_MAP_NOISE * level.noise / contrast) / max(
        median(predicted.width), 1.0
    )
    most = 1 if len(row) >= _MANY else _FEW_SMOOTH
    return float(np.sqrt((off**2).mean())) / tolerated < most

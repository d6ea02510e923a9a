"""Check points against the image (`check_vertices`), and tell fully grown lattices from clutter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.lattice import Lattice, signs
from neurocal_cli.detection.finding.levels import Level, interpolate
from neurocal_cli.detection.finding.predict import PredictedVertices
from neurocal_cli.detection.medians import median

# Insensitive, except _INTO and _ALONG: doubled, samples reach the next squares, and 66 of 279 points of three
# photographs are lost.
_INTO = 0.3  # squares; offset of the samples in the four squares, along both axes
_ALONG, _ASIDE = 0.36, 0.16  # squares; offsets of the samples beside the edges, along and across these
_LEAST_EVENNESS = 0.6  # a visible vertex has at least 0.9, even if blurred or noisy
_LEAST_EDGE = 0.3  # least step across an edge, relative to the contrast
# Limits of whole lattices. Insensitive, except _EDGES, which is a share: doubled, it rejects all boards.
_EDGES = 0.9  # least share of visible edges
# Greatest rms distance of vertices from the predictions of their neighbours: in squares, plus px, plus px per
# ratio of the noise (of second derivatives) to the contrast.
_OFF, _OFF_PX, _OFF_NOISE = 0.021, 0.09, 20.0
_MANY, _FEW_SMOOTH = 18, 0.6  # factor on this limit for fewer vertices, which may be aligned by chance


@frozen_dataclass(eq=False)
class VertexCheck:
    """Result of the samples around N points."""

    # [DN] mean of the bright minus mean of the dark squares; negative if the colours are swapped
    contrast: Array
    evenness: Array  # darkest bright minus brightest dark square, over the contrast: 1 for an ideal vertex
    is_vertex: NDArray[np.bool_]  # two bright and two dark squares, and an edge between each two neighbours


def _offsets() -> Array:
    """(12, 2) sample positions [squares]: in the four squares, then beside the four edges."""
    i, a, s = _INTO, _ALONG, _ASIDE
    inside = [(i, i), (-i, i), (-i, -i), (i, -i)]  # colours alternate, beginning with dark
    beside = [(a, s), (-s, a), (-a, -s), (s, -a)]  # on the dark side of each edge
    across = [(a, -s), (s, a), (-a, s), (-s, -a)]
    return np.array(inside + beside + across)


_OFFSETS = _offsets()
# Weights of the samples for the contrast and for the steps across the edges. The samples' signs are changed
# first, so that dark squares have the larger values.
_CONTRAST = np.array([0.5, -0.5, 0.5, -0.5] + [0.0] * 8)
_STEPS = np.concatenate([np.zeros((4, 4)), np.diag([1.0, -1, 1, -1]), np.diag([-1.0, 1, -1, 1])])


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
    is_vertex &= (value @ _STEPS).min(axis=1) > _LEAST_EDGE * contrast
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
    tolerated = _OFF + (_OFF_PX + _OFF_NOISE * level.noise / contrast) / max(median(predicted.width), 1.0)
    most = 1 if len(row) >= _MANY else _FEW_SMOOTH
    return float(np.sqrt((off**2).mean())) / tolerated < most


def edges_visible(level: Level, lattice: Lattice) -> bool:
    """Whether the edges between neighbouring vertices separate dark from light."""
    row, col, predicted = lattice.predicted
    pixels, contrast = lattice.pixels, lattice.contrast
    c, r = np.full_like(pixels, np.nan), np.full_like(pixels, np.nan)
    c[row, col], r[row, col] = predicted.c, predicted.r
    visible = [
        _edges_with_contrast(level, pixels, r, contrast, lattice.dark),
        # Exchanging rows and columns also exchanges the two sides of an edge.
        _edges_with_contrast(
            level, pixels.transpose(1, 0, 2), c.transpose(1, 0, 2), contrast.T, lattice.dark
        ),
    ]
    return float(np.concatenate(visible).mean()) >= _EDGES


def _edges_with_contrast(level: Level, pixels: Array, steps: Array, contrast: Array, dark: int) -> Array:
    """Whether each edge along a row has contrast, given the steps (rows, cols, 2) to the next row."""
    known = np.isfinite(pixels[..., 0])
    row, col = np.nonzero(known[:, :-1] & known[:, 1:])
    start, end = pixels[row, col], pixels[row, col + 1]
    across = 0.5 * (steps[row, col] + steps[row, col + 1])
    middle = 0.5 * (start + end)
    sides = np.stack([middle + _ASIDE * across, middle - _ASIDE * across], axis=1)
    value = interpolate(level.smooth, sides)
    rise = (value[:, 1] - value[:, 0]) * signs(row, col, dark)
    usual = np.minimum(contrast[row, col], contrast[row, col + 1])
    return np.asarray(rise > _LEAST_EDGE * usual)

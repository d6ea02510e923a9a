"""Final tests whether a lattice is a chessboard or clutter.

In: a fully grown lattice. Out: whether it has a block of 3 x 3 vertices, whether its vertices lie on a smooth
surface, and whether its edges separate dark from light. Called by `grids`.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.finding.lattice import Lattice, signs
from neurocal_cli.detection.finding.levels import Level, interpolate
from neurocal_cli.detection.medians import median
from neurocal_cli.geometry import Array

# Insensitive, except _EDGES, which is a share: doubled, it rejects all boards.
_ASIDE = 0.16  # squares; distance of the samples from the middle of an edge, on both sides
_LEAST_EDGE = 0.3  # least step across an edge, relative to the contrast
_EDGES = 0.9  # least share of visible edges
# Greatest rms distance of vertices from the predictions of their neighbours: in squares, plus px, plus px per
# ratio of the noise (of second derivatives) to the contrast.
_OFF, _OFF_PX, _OFF_NOISE = 0.021, 0.09, 20.0
_MANY, _FEW_SMOOTH = 18, 0.6  # factor on this limit for fewer vertices, which may be aligned by chance


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

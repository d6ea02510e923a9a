"""The last tests of a lattice: a chessboard, or clutter.

In: a lattice that has grown. Out: whether it has a block of 3 x 3 vertices, whether its vertices lie on a
smooth surface, and whether its edges separate dark from light. Called by `grids`.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.finding.lattice import Lattice, signs
from neurocal_cli.detection.finding.levels import Level, interpolate
from neurocal_cli.detection.medians import median
from neurocal_cli.geometry import Array

# Insensitive, apart from _EDGES, which is a share: doubled it rejects all boards.
_ASIDE = 0.16  # squares; to either side of an edge, half-way between two vertices
_LEAST_EDGE = 0.3  # of the contrast, across an edge
_EDGES = 0.9  # share of the edges that are seen
# Rms limits of the vertices' deviations from their neighbours' predictions: squares, px, and px per
# ratio of the noise (of second derivatives) to the contrast.
_OFF, _OFF_PX, _OFF_NOISE = 0.021, 0.09, 20.0
_MANY, _FEW_SMOOTH = 18, 0.6  # few vertices may be in line by chance: a stricter limit


def has_block(lattice: Lattice) -> bool:
    """Whether a block of 3 x 3 vertices is known. In smaller lattices no third vertex tests a line."""
    seen = lattice.seen
    if min(seen.shape) < 3:
        return False
    rows = seen[:-2] & seen[1:-1] & seen[2:]
    return bool((rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]).any())


def is_smooth(level: Level, lattice: Lattice) -> bool:
    """Whether the vertices lie where their neighbours predict them, within what noise explains."""
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
    """Whether each edge along a row has contrast; steps (rows, cols, 2) lead from row to row."""
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

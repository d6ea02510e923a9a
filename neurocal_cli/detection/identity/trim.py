"""Lines of vertices that a grid only seems to have.

Where the paper of a board ends near its outer squares, a corner of the paper can look like a vertex,
and where two planes meet, a square's corner at the fold can.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.board import Plane
from neurocal_cli.detection.grid import Grid
from neurocal_cli.geometry import Array

__all__ = ["trimmed"]

_FEW = 0.34  # share of a line's vertices up to which it may be none
_FEW_AT_FOLDS = 0.6  # of one of several planes, whose places are proved by one camera seeing them all


def trimmed(grid: Grid, planes: Sequence[Plane]) -> Grid:
    """Grid without the outer lines that are hardly there and keep it from fitting any plane.

    Parameters
    ----------
    grid : Grid
    planes : sequence of Plane

    Returns
    -------
    grid : Grid
        The one given if it fits, or would not fit without such lines either.
    """
    left = grid
    few = _FEW if len(planes) == 1 else _FEW_AT_FOLDS
    while not _fits(left, planes):
        seen = left.seen
        lines = {0: seen[:, 0], 1: seen[:, -1], 2: seen[0], 3: seen[-1]}
        shares = {side: float(line.mean()) for side, line in lines.items()}
        side = min(shares, key=lambda k: shares[k])
        if shares[side] > few or min(seen.shape) <= 3:
            return grid
        left = _cropped(left.pixels, left.dark, side)
    return left


def _fits(grid: Grid, planes: Sequence[Plane]) -> bool:
    size = sorted(grid.shape)
    return any(
        size[0] <= min(plane.cols, plane.rows) and size[1] <= max(plane.cols, plane.rows) for plane in planes
    )


def _cropped(pixels: Array, dark: int, side: int) -> Grid:
    """Without a side's line, and without the lines that are empty then."""
    rows, cols = pixels.shape[:2]
    window = [slice(0, rows), slice(0, cols)]
    window[1 if side < 2 else 0] = slice(1, None) if side % 2 == 0 else slice(0, -1)
    first = (window[0].start or 0, window[1].start or 0)
    pixels = pixels[tuple(window)]
    seen = np.isfinite(pixels[..., 0])
    (top, bottom), (west, east) = (np.flatnonzero(seen.any(axis=k))[[0, -1]] for k in (1, 0))
    dark = (dark + sum(first) + int(top) + int(west)) % 2
    return Grid(pixels[top : bottom + 1, west : east + 1], dark)

"""Removing outer lines of a grid that are not lines of the board.

A corner of the paper can look like a vertex where the paper ends near the outer squares, and so can the
corner of a square at a fold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.board import Plane
from neurocal_cli.detection.grid import Grid

Side = tuple[slice | int, ...]

_SIDES: tuple[Side, ...] = (np.s_[:, 0], np.s_[:, -1], np.s_[0, :], np.s_[-1, :])

# tests/test_identity.py removes such lines, and keeps them on larger boards.
_FEW = 0.34  # greatest share of vertices of a line that may be removed
_FEW_AT_FOLDS = 0.6  # the same for several planes, because the fit of one camera tests them afterwards


def trimmed(grid: Grid, planes: Sequence[Plane]) -> Grid:
    """Remove outer lines with few vertices from a grid that is too large for every plane.

    Parameters
    ----------
    grid : Grid
    planes : sequence of Plane

    Returns
    -------
    grid : Grid
        The given one if it fits, or does not fit without such lines either.
    """
    left = grid
    few = _FEW if len(planes) == 1 else _FEW_AT_FOLDS
    while not _fits(left, planes):
        shares = [float(left.seen[side].mean()) for side in _SIDES]
        if min(shares) > few or min(left.shape) <= 3:
            return grid
        left = _without(left, _SIDES[shares.index(min(shares))])
    return left


def _fits(grid: Grid, planes: Sequence[Plane]) -> bool:
    size = sorted(grid.shape)
    return any(
        size[0] <= min(plane.cols, plane.rows) and size[1] <= max(plane.cols, plane.rows) for plane in planes
    )


def _without(grid: Grid, side: Side) -> Grid:
    """The grid without the line of a side, and without lines that are empty then."""
    pixels = grid.pixels.copy()
    pixels[side] = np.nan
    seen = np.isfinite(pixels[..., 0])
    (top, bottom), (west, east) = (np.flatnonzero(seen.any(axis=k))[[0, -1]] for k in (1, 0))
    return Grid(pixels[top : bottom + 1, west : east + 1], int(grid.dark + top + west) % 2)

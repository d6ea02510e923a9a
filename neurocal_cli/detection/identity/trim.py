"""Remove outer lines of a grid that are not lines of the board.

False vertices occur where a corner of the paper lies near the outer squares, and at corners of squares on a
fold.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.board import Plane
from neurocal_cli.detection.grid import Grid

Side = tuple[slice | int, ...]

_SIDES: tuple[Side, ...] = (np.s_[:, 0], np.s_[:, -1], np.s_[0, :], np.s_[-1, :])

# With these limits tests/test_identity.py removes false lines, and keeps those of larger boards.
_FEW = 0.34  # a line may be removed if at most this share of its vertices was found
_FEW_AT_FOLDS = 0.6  # the same for several planes, which are tested against a camera afterwards


def trimmed(grid: Grid, planes: Sequence[Plane]) -> Grid:
    """Remove outer lines with few vertices from a grid that is too large for every plane.

    Parameters
    ----------
    grid : Grid
    planes : sequence of Plane

    Returns
    -------
    grid : Grid
        The given one if it fits, or if removing such lines does not make it fit.
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
    """Remove the line of a side, and lines that are then empty."""
    pixels = grid.pixels.copy()
    pixels[side] = np.nan
    seen = np.isfinite(pixels[..., 0])
    (top, bottom), (west, east) = (np.flatnonzero(seen.any(axis=k))[[0, -1]] for k in (1, 0))
    return Grid(pixels[top : bottom + 1, west : east + 1], int(grid.dark + top + west) % 2)

"""Placements of a grid on a plane of the board: rotated, mirrored if seen from behind, and shifted.

Before that, `trimmed` removes outer lines of a grid that are not lines of the board. False vertices occur
where a corner of the paper lies near the outer squares, and at corners of squares on a fold.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.grid import TURNS, Grid
from neurocal_cli.detection.identity.ends import End
from neurocal_cli.observations.board import Plane

Side = tuple[slice | int, ...]

_SIDES: tuple[Side, ...] = (np.s_[:, 0], np.s_[:, -1], np.s_[0, :], np.s_[-1, :])

# With these limits tests/test_identity.py removes false lines, and keeps those of larger boards.
_FEW = 0.34  # a line may be removed if at most this share of its vertices was found
_FEW_AT_FOLDS = 0.6  # the same for several planes, which are tested against a camera afterwards


def trimmed(grid: Grid, planes: Sequence[Plane]) -> Grid:
    """Remove outer lines with few vertices from a grid that is too large for every plane.

    The grid stays as it is if it fits, or if removing such lines does not make it fit.
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


Matrix = tuple[tuple[int, int], tuple[int, int]]

_MIRRORED: tuple[Matrix, ...] = tuple((second, first) for first, second in TURNS)


@frozen_dataclass
class Placement:
    """A grid's coordinates on a plane: ``matrix @ (c, r) + offset``."""

    plane: int  # position among the board's planes
    matrix: Matrix  # a rotation by a multiple of 90 degrees, with or without a reflection
    offset: tuple[int, int]

    def apply(self, grid: ArrayLike) -> Array:
        """Plane coordinates (..., 2) of grid coordinates."""
        return np.asarray(grid) @ np.array(self.matrix).T + np.array(self.offset)

    def first_square_is_dark(self, dark: int) -> bool:
        """Whether the square between the plane's vertices (0, 0) and (1, 1) is dark, by `Grid.dark`."""
        centre = (np.array([0.5, 0.5]) - np.array(self.offset)) @ np.array(self.matrix)  # matrix^-1
        return bool((np.floor(centre).sum() + dark) % 2 == 0)

    def axis(self, grid: Grid) -> Array:
        """Mean direction of the plane's x axis in the image of a grid; (2,) unit vector."""
        steps = (np.diff(grid.pixels, axis=1), np.diff(grid.pixels, axis=0))  # along c, along r
        along_c, along_r = (np.nanmean(step.reshape(-1, 2), axis=0) for step in steps)
        axis = self.matrix[0][0] * along_c + self.matrix[0][1] * along_r
        return np.asarray(axis / np.hypot(*axis))


def placements(
    grid: Grid, plane: Plane, index: int, ends: Mapping[tuple[int, int], End], *, mirrored: bool
) -> Iterator[Placement]:
    """Enumerate the placements of a grid on the plane of this index that agree with the board's ends.

    The ends are given by the directions of the grid's sides; absent sides are unknown. The plane may be seen
    from behind if `mirrored`.
    """
    last = plane.cols - 1, plane.rows - 1
    cols, rows = grid.shape
    for matrix in (*TURNS, *(_MIRRORED if mirrored else ())):
        corner = [a * (cols - 1) + b * (rows - 1) for a, b in matrix]  # the grid's, opposite to (0, 0)
        size = abs(corner[0]), abs(corner[1])
        for start in product(*(range(most - long + 1) for most, long in zip(last, size, strict=True))):
            stop = start[0] + size[0], start[1] + size[1]
            if _allowed(matrix, start, stop, last, ends):
                yield Placement(index, matrix, (start[0] - min(corner[0], 0), start[1] - min(corner[1], 0)))


def _allowed(
    matrix: Matrix,
    start: tuple[int, ...],
    stop: tuple[int, ...],
    last: tuple[int, int],
    ends: Mapping[tuple[int, int], End],
) -> bool:
    """Whether a grid's sides lie at the ends of the plane, 0 and `last`, exactly where the board ends."""
    for direction, end in ends.items():
        if end is End.UNKNOWN:
            continue
        outwards = [a * direction[0] + b * direction[1] for a, b in matrix]
        axis = 0 if outwards[0] else 1
        at_end = start[axis] == 0 if outwards[axis] < 0 else stop[axis] == last[axis]
        if at_end != (end is End.BOARD):
            return False
    return True

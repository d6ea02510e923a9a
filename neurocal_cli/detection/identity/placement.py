"""Placements of a grid on a plane of the board: rotated, mirrored if seen from behind, and shifted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from neurocal_cli.board import Plane
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.identity.ends import End
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

Matrix = tuple[tuple[int, int], tuple[int, int]]

_TURNS: tuple[Matrix, ...] = (((1, 0), (0, 1)), ((0, -1), (1, 0)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0)))
_MIRRORED: tuple[Matrix, ...] = tuple((second, first) for first, second in _TURNS)


@frozen_dataclass
class Placement:
    """A grid's coordinates on a plane: ``matrix @ (c, r) + offset``.

    Attributes
    ----------
    plane : int
        Position among the board's planes.
    matrix : 2 x 2 ints
        A rotation by a multiple of 90 degrees, with or without a reflection.
    offset : 2 ints
    """

    plane: int
    matrix: Matrix
    offset: tuple[int, int]

    def apply(self, grid: ArrayLike) -> Array:
        """Plane coordinates (..., 2) of grid coordinates."""
        return np.asarray(grid) @ np.array(self.matrix).T + np.array(self.offset)

    def first_square_is_dark(self, dark: int) -> bool:
        """Whether the square between the plane's vertices (0, 0) and (1, 1) is dark.

        Parameters
        ----------
        dark : int
            That of the grid; see `Grid`.
        """
        centre = (np.array([0.5, 0.5]) - np.array(self.offset)) @ np.array(self.matrix)  # matrix^-1
        return bool((np.floor(centre).sum() + dark) % 2 == 0)

    def axis(self, grid: Grid) -> Array:
        """Mean direction of the plane's x axis in the image of a grid; (2,) unit vector."""
        steps = (np.diff(grid.pixels, axis=1), np.diff(grid.pixels, axis=0))  # along c, along r
        along_c, along_r = (np.nanmean(step.reshape(-1, 2), axis=0) for step in steps)
        axis = self.matrix[0][0] * along_c + self.matrix[0][1] * along_r
        return np.asarray(axis / np.hypot(*axis))


def placements(
    grid: Grid,
    plane: Plane,
    index: int,
    ends: Mapping[tuple[int, int], End],
    *,
    mirrored: bool,
) -> Iterator[Placement]:
    """Enumerate the placements of a grid on a plane that agree with the board's ends.

    Parameters
    ----------
    grid : Grid
    plane : Plane
    index : int
        Of the plane on its board.
    ends : dict of End
        By the directions of the grid's sides; absent sides are unknown.
    mirrored : bool
        Whether the plane may be seen from behind.
    """
    last = plane.cols - 1, plane.rows - 1
    cols, rows = grid.shape
    for matrix in (*_TURNS, *(_MIRRORED if mirrored else ())):
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

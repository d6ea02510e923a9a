"""How a grid may lie on a plane of the board: turned, mirrored where seen from behind, and shifted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.board import Plane
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.identity.ends import End
from neurocal_cli.geometry import Array

__all__ = ["Placement", "placements"]

Matrix = tuple[tuple[int, int], tuple[int, int]]

_TURNS: tuple[Matrix, ...] = (((1, 0), (0, 1)), ((0, -1), (1, 0)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0)))
_MIRRORED: tuple[Matrix, ...] = tuple((second, first) for first, second in _TURNS)


@dataclass(frozen=True)
class Placement:
    """A grid's coordinates on a plane: ``matrix @ (c, r) + offset``.

    Attributes
    ----------
    plane : int
        Position among the board's planes.
    matrix : 2 x 2 ints
        A turn by a multiple of 90 degrees, or one with a reflection.
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
            The grid's; see `Grid`.
        """
        centre = (np.array([0.5, 0.5]) - np.array(self.offset)) @ np.array(self.matrix)  # matrix^-1
        return bool((np.floor(centre).sum() + dark) % 2 == 0)

    def axis(self, grid: Grid) -> Array:
        """Direction in the image of the plane's x axis, in the middle of a grid; (2,) unit vector."""
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
    """All ways to lay a grid on a plane that its ends allow.

    Parameters
    ----------
    grid : Grid
    plane : Plane
    index : int
        Of the plane on its board.
    ends : dict of End
        By the sides' directions; an absent one is unknown.
    mirrored : bool
        Whether the plane may be seen from the side its axes turn the other way on.
    """
    last = np.array([plane.cols, plane.rows]) - 1
    for matrix in (*_TURNS, *(_MIRRORED if mirrored else ())):
        corners = np.array([[0, 0], np.array(grid.shape) - 1]) @ np.array(matrix).T
        low, size = corners.min(axis=0), np.ptp(corners, axis=0)
        if (size > last).any():
            continue
        for shift in product(*(range(int(room) + 1) for room in last - size)):
            start = np.array(shift)
            if _allowed(matrix, start, start + size, last, ends):
                offset = start - low
                yield Placement(index, matrix, (int(offset[0]), int(offset[1])))


def _allowed(
    matrix: Matrix,
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    last: NDArray[np.int64],
    ends: Mapping[tuple[int, int], End],
) -> bool:
    """Whether the sides of a grid lie at the plane's ends where the board ends, and not where it goes on."""
    for direction, end in ends.items():
        if end is End.UNKNOWN:
            continue
        outwards = np.array(matrix) @ np.array(direction)
        axis = int(np.flatnonzero(outwards)[0])
        at_end = bool(start[axis] == 0 if outwards[axis] < 0 else stop[axis] == last[axis])
        if at_end != (end is End.BOARD):
            return False
    return True

"""Placements of a grid on a plane of the board: rotated, mirrored if seen from behind, and shifted.

The board's ends (`ends`) exclude most of them.

Before that, `trimmed` removes outer lines of a grid that are not lines of the board. False vertices occur
where a corner of the paper lies near the outer squares, and at corners of squares on a fold.

A grid that cannot be placed gives a `NoBoardError`, whose message says what the image shows instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.grid import TURNS, Grid
from neurocal_cli.detection.identity.ends import End, surrounded
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.board import Board, Plane

Matrix = tuple[tuple[int, int], tuple[int, int]]

_SIDES: tuple[tuple[slice | int, ...], ...] = (np.s_[:, 0], np.s_[:, -1], np.s_[0, :], np.s_[-1, :])
_MIRRORED: tuple[Matrix, ...] = tuple((second, first) for first, second in TURNS)

# With these limits test_identity.py removes false lines, and keeps those of larger boards.
_FEW = 0.34  # a line may be removed if at most this share of its vertices was found
_FEW_AT_FOLDS = 0.6  # the same for several planes, which are tested against a camera afterwards

# Least share of a grid's vertices that are found if it is a whole board. On photographs it is 0.89 and more
# for boards, and at most 0.77 for blinds, tiled floors and textures. It changes only a message.
_WHOLE = 0.8

SYMMETRIC_BOARD = (
    "the board looks the same after a turn, so its first corner depends on its orientation in the image; to "
    "get the same point ids in all images, use a board with an even number of inner vertices on one side and "
    "an odd number on the other"
)


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
        if end not in (End.BOARD, End.PATTERN):
            continue
        outwards = [a * direction[0] + b * direction[1] for a, b in matrix]
        axis = 0 if outwards[0] else 1
        at_end = start[axis] == 0 if outwards[axis] < 0 else stop[axis] == last[axis]
        if at_end != (end is End.BOARD):
            return False
    return True


def trimmed(grid: Grid, planes: Sequence[Plane]) -> Grid:
    """Remove outer lines with few vertices from a grid that is too large for every plane.

    The grid stays as it is if it fits, or if removing such lines does not make it fit.
    """
    left = grid
    few = _FEW if len(planes) == 1 else _FEW_AT_FOLDS
    sizes = [sorted((plane.cols, plane.rows)) for plane in planes]
    while True:
        short, long = sorted(left.shape)
        if any(short <= narrow and long <= wide for narrow, wide in sizes):
            return left
        shares = [float(left.seen[side].mean()) for side in _SIDES]
        if min(shares) > few or short <= 3:
            return grid
        pixels = left.pixels.copy()
        pixels[_SIDES[shares.index(min(shares))]] = np.nan
        # This removes the line, and lines beside it that are empty now.
        seen = np.isfinite(pixels[..., 0])
        (top, bottom), (west, east) = (np.flatnonzero(seen.any(axis=k))[[0, -1]] for k in (1, 0))
        left = Grid(pixels[top : bottom + 1, west : east + 1], int(left.dark + top + west) % 2)


class NoBoardError(NeurocalError):
    """The image does not show the board, or not enough of it to locate its points.

    `shown` is the number (cols, rows) of inner vertices of the board that the image shows instead.
    """

    def __init__(self, message: str, shown: tuple[int, int] | None = None) -> None:
        super().__init__(message)
        self.shown = shown


def wrong_size(board: Board, grid: Grid, ends: Mapping[tuple[int, int], End]) -> NoBoardError:
    """Make the error about a grid that does not fit on the board."""
    wanted = _sizes(board)
    shape = _in_order(grid.shape, board)
    if len(board.planes) == 1:
        plane = board.planes[0]
        if sorted(shape) == sorted((plane.cols, plane.rows)) and End.PATTERN in ends.values():
            return NoBoardError(
                f"the pattern continues beyond {wanted} inner vertices; give the size of the whole board"
            )
    if grid.seen.mean() < _WHOLE:
        return NoBoardError(
            f"detected no board of {wanted} inner vertices, only parts of a pattern of {_size(shape)}; "
            "show the whole board, sharp and evenly lit",
            shape,
        )
    doubtful = surrounded(ends) and set(ends.values()) != {End.BOARD}
    if doubtful and len(board.planes) == 1 and _fits(shape, board.planes[0]):
        return NoBoardError(
            f"detected {_size(shape)} inner vertices with ends on all sides, but the board has {wanted}; "
            "give the size of the board in the image, or show the whole board, evenly lit",
            shape,
        )
    have = "board has" if len(board.planes) == 1 else "planes of the board have"
    return NoBoardError(
        f"detected {_size(shape)} inner vertices, but the {have} {wanted}; give the size of the board in the "
        "image",
        shape,
    )


def ambiguous(board: Board, grids: Sequence[Grid], rms: float) -> NoBoardError:
    """Make the error about grids with several possible arrangements, the best with an rms error [px]."""
    sizes = [sorted((plane.cols, plane.rows)) for plane in board.planes]
    part = next((grid for grid in grids if sorted(grid.shape) not in sizes), None)
    if part is not None:
        shape = _in_order(part.shape, board)
        return NoBoardError(
            f"detected {_size(shape)} of {_sizes(board)} inner vertices, but it is ambiguous "
            "which ones; show its outer border on more sides, or correct the size if this is all of it",
            shape,
        )
    if len(grids) < len(board.planes):
        return NoBoardError(
            f"only {len(grids)} of the {len(board.planes)} planes detected, so their position is ambiguous; "
            "show more of them"
        )
    return NoBoardError(
        f"the planes fit the board in more than one way, to {rms:.2g} px; check the board's origins and "
        "axes, or take the image from nearer"
    )


def _fits(shape: tuple[int, int], plane: Plane) -> bool:
    """Whether a grid of this shape may be a part of the plane."""
    (short, long), (narrow, wide) = sorted(shape), sorted((plane.cols, plane.rows))
    return short <= narrow and long <= wide


def _in_order(shape: tuple[int, int], board: Board) -> tuple[int, int]:
    """Columns and rows of a grid in the order of a board of one plane."""
    if len(board.planes) == 1 and (shape[0] < shape[1]) != (board.planes[0].cols < board.planes[0].rows):
        return shape[1], shape[0]
    return shape


def _sizes(board: Board) -> str:
    names = [_size((plane.cols, plane.rows)) for plane in board.planes]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[0]} x {shape[1]}"

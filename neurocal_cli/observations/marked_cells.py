"""Which cells of a board carry which markers, and what these look like."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane
from neurocal_cli.observations.markers import DICTIONARIES, code, code_count

_USUAL_DIAMETER = 0.6  # of circles, over their distance


@frozen_dataclass
class Print:
    """How a board of markers may have been printed."""

    legacy: bool = False  # whether the first square of a ChArUco board is light
    turn: int = 0  # quarter turns of a tag's code, anticlockwise


@frozen_dataclass(eq=False)
class Cells:
    """The cells of a plane that carry a marker, in grid coordinates."""

    number: NDArray[np.int64]  # (N,) of the marker
    cell: NDArray[np.int64]  # (N, 2) (c, r) of the cell's first vertex
    corners: Array  # (N, 4, 2) [cells] top left, top right, bottom right, bottom left of the upright marker

    def of(self, numbers: NDArray[np.int64]) -> NDArray[np.intp]:
        """Position (M,) of markers among the cells."""
        return np.searchsorted(self.number, numbers)


def prints(plane: Plane) -> Iterator[Print]:
    """The ways in which a board may have been printed."""
    if isinstance(plane, TagPlane):
        yield from (Print(turn=turn) for turn in range(4))
        return
    assert plane.markers is not None
    legacy = plane.markers.legacy
    both = (False, True) if (plane.rows + 1) % 2 == 0 else (False,)
    yield from (Print(legacy=one) for one in (both if legacy is None else (legacy and len(both) > 1,)))


def marked_cells(plane: Plane, how: Print) -> Cells:
    """The cells with markers, in the order of their numbers."""
    assert plane.markers is not None
    first = plane.markers.first_id
    if isinstance(plane, TagPlane):
        cols, rows = plane.tags
        cell = np.array([(2 * i, 2 * j) for j, i in product(range(rows), range(cols))])
        upright = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
        outline = np.roll(upright if plane.downwards else upright[::-1], how.turn, axis=0)
    else:
        light = 0 if how.legacy else 1
        squares = product(range(plane.rows + 1), range(plane.cols + 1))
        cell = np.array([(x - 1, y - 1) for y, x in squares if (x + y) % 2 == light])
        low = 0.5 * (1 - plane.markers.side / plane.square)
        outline = np.array([[low, low], [1 - low, low], [1 - low, 1 - low], [low, 1 - low]])
    return Cells(first + np.arange(len(cell)), cell, cell[:, None] + outline)


def inset(plane: Plane) -> float:
    """Distance of a marker from the sides of its cell, in cells."""
    assert plane.markers is not None
    return 0.0 if isinstance(plane, TagPlane) else 0.5 * (1 - plane.markers.side / plane.square)


def pattern_lines(plane: Plane, dictionary: str) -> Array:
    """Places (n + 1,) of the lines of a marker's pattern along a side of its cell, in cells."""
    border = plane.border if isinstance(plane, TagPlane) else 1
    low = inset(plane)
    return np.linspace(low, 1 - low, DICTIONARIES[dictionary] + 2 * border + 1)


def patterns(plane: Plane, cells: Cells, dictionary: str, how: Print) -> NDArray[np.bool_]:
    """Dark parts (N, n, n) of the cells' markers, ``[row, column]`` along growing r and c.

    Raises InputError if the dictionary has too few codes.
    """
    border = plane.border if isinstance(plane, TagPlane) else 1
    every = np.stack([code(dictionary, number, border) for number in cells.number.tolist()])
    if not isinstance(plane, TagPlane):
        return every
    turned = np.rot90(every, how.turn, axes=(1, 2))
    return turned if plane.downwards else turned[:, ::-1]


def printed_rectangles(plane: Plane) -> tuple[Array, Array, NDArray[np.bool_]]:
    """What is printed on a plane with markers: lines along x and along y, and which rectangles are dark.

    Lines are in lengths over the square, ascending; the rectangles ``[y, x]`` have one more around the lines,
    which are not dark. Raises InputError if the dictionary is not known or has too few codes.
    """
    markers = plane.markers
    assert markers is not None
    dictionary = named_dictionary(plane)
    how = next(prints(plane))
    cells = marked_cells(plane, how)
    within = pattern_lines(plane, dictionary)
    dark = patterns(plane, cells, dictionary, how)
    # Fine lines of the grid: those between its cells, from one beyond the vertices, and those of patterns.
    counts = plane.cols, plane.rows
    fine = [np.unique(np.round((np.arange(-1, n)[:, None] + [0.0, *within, 1.0]).ravel(), 9)) for n in counts]
    middles = [0.5 * (one[1:] + one[:-1]) for one in fine]
    c, r = (np.floor(one).astype(int) for one in middles)
    if isinstance(plane, TagPlane) and plane.downwards:  # its markers stand alone
        grid = np.zeros((len(r), len(c)), dtype=np.bool_)
    else:
        grid = (c + r[:, None] + int(how.legacy)) % 2 == 0
    place = {tuple(cell): k for k, cell in enumerate(cells.cell.tolist())}
    count = len(within) - 1
    for (x, y), k in place.items():
        for j in np.flatnonzero(r == y):
            row = np.searchsorted(within, middles[1][j] - y) - 1
            if not 0 <= row < count:
                continue
            at = np.flatnonzero(c == x)
            column = np.searchsorted(within, middles[0][at] - x) - 1
            inside = (column >= 0) & (column < count)
            grid[j, at[inside]] = dark[k, row, column[inside]]
    if markers.inverted:
        grid = ~grid
    lines = [_along(plane, one, axis) for axis, one in enumerate(fine)]
    return lines[0], lines[1], np.pad(grid, 1)


def _along(plane: Plane, lines: Array, axis: int) -> Array:
    """Lengths over the square of grid coordinates along an axis."""
    places = np.zeros((len(lines), 2))
    places[:, axis] = lines
    return np.asarray(plane.spread(places)[:, axis])


def named_dictionary(plane: Plane) -> str:
    """The dictionary of a plane's markers, which must be known to draw them; an InputError if it is not."""
    assert plane.markers is not None
    if not plane.markers.dictionary:
        raise InputError(
            "the dictionary of the markers is not known; name it, for example charuco:8x6:28:21:DICT_4X4_50"
        )
    return plane.markers.dictionary


def numbered_apart(board: Board, count: int) -> tuple[Board, ...]:
    """So many boards with the same pattern, whose markers have different numbers and one dictionary."""
    boards, step = [], 0
    for plane in board.planes:
        step += len(marked_cells(plane, next(prints(plane))).number)
    for k in range(count):
        planes = []
        for plane in board.planes:
            assert plane.markers is not None
            first = plane.markers.first_id + k * step
            planes.append(replace(plane, markers=replace(plane.markers, first_id=first)))
        boards.append(planes)
    # A dictionary that is not named is the smallest for the last board.
    names = [printed.markers.dictionary for plane in boards[-1] if (printed := to_print(plane)).markers]
    return tuple(
        replace(
            board,
            planes=tuple(
                replace(plane, markers=replace(plane.markers, dictionary=name))
                for plane, name in zip(planes, names, strict=True)
                if plane.markers is not None
            ),
        )
        for planes in boards
    )


def to_print(plane: Plane) -> Plane:
    """The plane with what a print needs: a dictionary of enough markers, a diameter of circles."""
    if isinstance(plane, CirclePlane) and not plane.diameter:
        nearest = plane.square * (np.sqrt(2) if plane.asymmetric else 1.0)
        return replace(plane, diameter=float(np.round(_USUAL_DIAMETER * nearest, 4)))
    markers = plane.markers
    if markers is None or markers.dictionary:
        return plane
    last = int(marked_cells(plane, Print()).number[-1])
    dictionary = next((one for one in DICTIONARIES if code_count(one) > last), "")
    if not dictionary:
        raise InputError(f"no dictionary has a marker {last}; make a board of fewer squares")
    return replace(plane, markers=replace(markers, dictionary=dictionary, legacy=bool(markers.legacy)))

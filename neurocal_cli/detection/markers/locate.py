"""Locate boards with markers in an image, whatever they were printed with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.finding.saddles import Image, grey_levels
from neurocal_cli.detection.grey import eight_bits
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.identify import Identified, Located
from neurocal_cli.detection.markers.ink import Ink
from neurocal_cli.detection.markers.lattice import (
    LEAST_AGREEMENT,
    Placed,
    agreement,
    are_misplaced,
    corners_of_tags,
    find_vertices,
    place,
    read_together,
)
from neurocal_cli.detection.markers.numbering import lie_of
from neurocal_cli.detection.markers.reading import (
    SMALL,
    USUAL,
    WRONG_BORDER,
    Marks,
    View,
    candidates,
    codes_in,
    looks_at,
    markers_in,
)
from neurocal_cli.detection.placement import ONE_BOARD, NoBoardError, Placement
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import TagPlane
from neurocal_cli.observations.marked_cells import Cells, marked_cells, pattern_lines, patterns, prints
from neurocal_cli.observations.markers import DICTIONARIES, code_count

_ENOUGH = 4  # markers that are no chance
_MOST = 0.5  # share of the markers after which no other scale is tried
_WITH_SQUARES = 0.5  # share of the corners of tags that are vertices if there are squares at them
# Distance of markers as read over the described one: 0.92 to 1.0 in 45 views of a blur of up to a twelfth of
# a side, which hides the darkest part of borders; more where the light grows over the edges of small ones.
_SPACED = 0.9, 1.2
# Greatest shift of measured edges, towards the light and towards the dark [px], and by ink [sides]. It is at
# most 0.01 px in rendered views, and 0.2 to 0.4 px towards the dark with gamma 2.2 and a blur of 0.5 to 1.2
# px; spacings of 0.2 and 0.25 differ by 0.02 sides.
_DARKENED, _LIGHTENED, _PRINTED = 0.1, 0.8, 0.006
_TWICE = 1.5  # places of a marker, on average
_STRANGE = 8  # markers of another dictionary that are worth a word
_MIRRORED = ((1, 0), (0, -1))


def locate(board: Board, image: NDArray[np.generic]) -> Identified:
    """Locate the planes of a board by their markers.

    Raises NoBoardError if there are not two markers of one plane, with the reason as far as it is known.
    """
    grey, light = eight_bits(image), grey_levels(image)
    looks, quadrangles = looks_at(grey), list[Array]()
    located, notes, read = [], [], 0
    for index, plane in enumerate(board.planes):
        if plane.markers is None:
            raise InputError("a board has markers on all its planes, or on none; describe them in two files")
        placed = _placed(plane, grey, _quadrangles(looks, quadrangles))
        # Of a border of two cells, the inner one may be seen alone, so those of one cell are not sure.
        if isinstance(plane, TagPlane) and (placed is None or plane.border == 1):
            _check_border(plane, grey, quadrangles)
        if placed is None:
            continue
        number, times = np.unique(placed.read.number, return_counts=True)
        if times[np.isin(number, placed.marks.number)].mean() > _TWICE:
            raise NoBoardError(f"two boards with the same markers are detected; {ONE_BOARD}")
        if isinstance(plane, TagPlane) and plane.downwards:
            _check_spacing(plane, placed.marks)
        found, agree = _vertices(plane, placed, light), len(np.unique(placed.at))
        misplaced = are_misplaced(plane, placed, (grey.shape[1], grey.shape[0]))
        if found is None and (agree < _ENOUGH or not misplaced or placed.unsure):
            read = max(read, agree)
            continue
        if placed.unsure:
            raise NoBoardError(
                "the markers fit today's and the legacy pattern of OpenCV; show more of the board, or give "
                "legacy: true or false in a board file"
            )
        one = None if found is None else _located(plane, index, placed, *found)
        if one is None or misplaced or not _shows_its_codes(one, placed.marks.dictionary, light):
            raise NoBoardError(
                "most markers are not where the board has them, as if it had another number of columns; "
                "correct its description, or leave out --board, so that the board is found"
            )
        located.append(one)
        notes.append(_told(plane, placed, one.grid))
    if not located:
        raise NoBoardError(_reason(board, grey, read, quadrangles))
    return Identified(tuple(located), notes=tuple(dict.fromkeys(note for note in notes if note)))


def _check_spacing(plane: TagPlane, marks: Marks) -> None:
    """Refuse markers that stand alone and are farther from each other, or nearer, than the board has them."""
    lie = lie_of(marks)
    if lie is not None and not _SPACED[0] < lie.step / (1 + plane.spacing) < _SPACED[1]:
        raise _other_spacing(plane, lie.step)


def check_measured_spacing(plane: TagPlane, grid: Grid, polarity: float) -> None:
    """Refuse markers that stand alone if their edges are off by more than ink, light and response move them.

    `polarity` [px] is how far the light has grown at the edges between light and dark.
    """
    along, down = np.diff(grid.pixels, axis=1)[:, ::2], np.diff(grid.pixels, axis=0)[::2]
    sides = np.concatenate([along.reshape(-1, 2), down.reshape(-1, 2)])
    side = float(np.nanmedian(np.hypot(*sides.T)))
    if not -_DARKENED - _PRINTED * side < polarity < _LIGHTENED + _PRINTED * side:
        raise _other_spacing(plane, (1 + plane.spacing) * side / (side - 2 * polarity))


def _other_spacing(plane: TagPlane, step: float) -> NoBoardError:
    return NoBoardError(
        f"the gap between two markers is about {step - 1:.2f} of their side, and the board has "
        f"{plane.spacing:g}; correct its spacing"
    )


def _vertices(plane: Plane, placed: Placed, light: Image) -> tuple[Grid, tuple[int, int]] | None:
    """The vertices around the markers of a plane, or the corners of tags without squares at these."""
    if isinstance(plane, TagPlane) and plane.downwards:
        return corners_of_tags(plane, placed)
    found = find_vertices(plane, placed, light)
    few = found is None or found[0].seen.sum() < _WITH_SQUARES * 4 * len(placed.at)
    return corners_of_tags(plane, placed) if isinstance(plane, TagPlane) and few else found


def _quadrangles(looks: Iterator[Sequence[View]], found: list[Array]) -> Iterator[Array]:
    """Quadrangles that may be markers of any dictionary: those found before, and those of other looks."""
    yield from list(found)
    for look in looks:
        found.append(candidates(look))
        yield found[-1]


def _placed(plane: Plane, grey: NDArray[np.uint8], quadrangles: Iterable[Array]) -> Placed | None:
    """The markers of a plane within quadrangles, of the dictionary of which most agree with each other."""
    markers = plane.markers
    assert markers is not None
    count = len(marked_cells(plane, next(prints(plane))).number)
    border = plane.border if isinstance(plane, TagPlane) else 1
    named, first = markers.dictionary, markers.first_id
    if named and first + count > code_count(named):
        last = code_count(named) - 1
        raise InputError(
            f"the board has markers up to {first + count - 1}, and {named} up to {last}; correct the "
            "dictionary or the number of squares"
        )
    best: Placed | None = None
    read: dict[str, Marks] = {}
    for every in quadrangles:
        for dictionary in (named,) if named else USUAL:
            marks = markers_in(grey, every, dictionary, border, first, count)
            read[dictionary] = marks.with_others(read.get(dictionary))
            placed = place(plane, read[dictionary])
            if placed is not None and (best is None or len(placed.at) > len(best.at) or best.unsure):
                best = placed
        if best is not None and len(best.at) >= _MOST * count and not best.unsure:
            break
    if best is None and named and not isinstance(plane, TagPlane) and max(grey.shape) <= SMALL:
        together = (read_together(plane, named, grid, grey_levels(grey)) for grid in find_grids(grey))
        best = next((place(plane, marks) for marks in together if marks is not None), None)
    return best


def _check_border(plane: TagPlane, grey: NDArray[np.uint8], quadrangles: Iterable[Array]) -> None:
    """Refuse tags that are read with the other width of the border, where the board has them."""
    assert plane.markers is not None
    name, other, marks = plane.markers.dictionary, 3 - plane.border, None
    first, count = plane.markers.first_id, plane.tags[0] * plane.tags[1]
    for every in quadrangles if name else ():
        marks = markers_in(grey, every, name, other, first, count, wrong_border=WRONG_BORDER).with_others(
            marks
        )
    placed = None if marks is None else place(replace(plane, border=other), marks)
    if placed is not None and len(placed.at) >= _ENOUGH:
        cells = "a border of one cell" if plane.border == 2 else "a border of two cells"
        raise NoBoardError(f"the tags have {cells}; say border: {other} in a board file")


def _located(plane: Plane, index: int, placed: Placed, grid: Grid, first: tuple[int, int]) -> Located:
    """The grid with its place on the plane, its lines, and its ink."""
    cols, rows = grid.shape
    dictionary = placed.marks.dictionary
    cell = placed.cells.cell - np.array(first)
    dark = patterns(plane, placed.cells, dictionary, placed.how)
    within = pattern_lines(plane, dictionary)
    if not isinstance(plane, TagPlane):
        ink = Ink(cell, within, np.where(dark, -1.0, 1.0), np.ones(len(cell)))
        return Located(grid, plane, Placement(index, ((1, 0), (0, 1)), first), ink)
    lines_c, lines_r = first[0] + np.arange(-1.0, cols + 1), first[1] + np.arange(-1.0, rows + 1)
    placement = Placement(index, ((1, 0), (0, 1)), first)
    if not plane.downwards:  # the plane's y points upwards, the grid's rows downwards
        cell, dark = np.stack([cell[:, 0], rows - 2 - cell[:, 1]], axis=-1), dark[:, ::-1]
        lines_r = lines_r[::-1]
        placement = Placement(index, _MIRRORED, (first[0], first[1] + rows - 1))
    x = plane.spread(np.column_stack([lines_c, 0 * lines_c]))[:, 0]
    y = plane.spread(np.column_stack([0 * lines_r, lines_r]))[:, 1]
    ink = Ink(cell, within, np.where(dark, -1.0, 1.0), -np.ones(len(cell)))
    return Located(replace(grid, lines=(x - x[0], np.abs(y - y[0]))), plane, placement, ink)


def _shows_its_codes(located: Located, dictionary: str, light: Image) -> bool:
    """Whether most of the squares that have markers on the board show their codes."""
    ink = located.ink
    assert ink is not None
    n = len(ink.lines) - 1
    code = slice((n - DICTIONARIES[dictionary]) // 2, (n + DICTIONARIES[dictionary]) // 2)
    lines = ink.lines[code.start : code.stop + 1]
    agree = agreement(located.grid, ink.cell, lines, ink.light[:, code, code], light)[2]
    return not len(agree) or float(np.median(agree)) > LEAST_AGREEMENT


def _told(plane: Plane, placed: Placed, grid: Grid) -> str:
    """What the image told of the markers beyond the board's description; its text suits all images."""
    markers = plane.markers
    assert markers is not None
    words = []
    if not markers.dictionary:
        words.append(f"the markers are of {smallest(placed.marks.dictionary, placed.cells)}")
    if markers.legacy is None and placed.how.legacy:
        words.append("the board has the legacy pattern, whose first square is light")
    if grid.paired and not (isinstance(plane, TagPlane) and plane.downwards):
        words.append("there are no squares at the corners of the tags, so only their edges are measured")
    return "; ".join(words)


def smallest(dictionary: str, cells: Cells) -> str:
    """The smallest dictionary with the same codes for the cells, since larger ones begin like it."""
    bits, _, count = dictionary.rpartition("_")
    if not count.isdigit():
        return dictionary
    last = int(cells.number.max())
    return next(
        (d for d in DICTIONARIES if d.rpartition("_")[0] == bits and code_count(d) > last), dictionary
    )


def _reason(board: Board, grey: NDArray[np.uint8], read: int, quadrangles: Sequence[Array]) -> str:
    """Why no plane was located, although so many markers of one were read."""
    if read >= _ENOUGH:
        return (
            f"{read} markers of the board are read, but the squares of a chessboard around them are not "
            "seen; show it sharper or nearer, or use a board that has them"
        )
    named = {plane.markers.dictionary for plane in board.planes if plane.markers is not None} - {""}
    seen = chain.from_iterable(codes_in(grey, every) for every in quadrangles) if named else ()
    for marks, _ in seen:
        if not any(codes_alike(marks.dictionary, one) for one in named) and len(marks) >= _STRANGE:
            return (
                f"the image shows markers of {marks.dictionary} instead of {' and '.join(sorted(named))}; "
                "correct the dictionary of the board"
            )
    return (
        "no two markers of the board can be read together, and one is not enough; show more of it, sharp and "
        "evenly lit, or correct its description"
    )


def codes_alike(one: str, other: str) -> bool:
    """Whether a dictionary begins with the codes of another."""
    bits, _, count = one.rpartition("_")
    return one == other or (count.isdigit() and other.rpartition("_")[0] == bits)

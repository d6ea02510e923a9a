"""Corners of boards in tables: with places, with cells of the board, mrcal's, and a file for each view."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, value_failures
from neurocal_cli.files.points_csv import PIXEL, PLACE, POINTS, correspondences
from neurocal_cli.files.reading import decode, read_bytes
from neurocal_cli.files.table import Table, read_table
from neurocal_cli.files.table_header import column_names
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.points import Correspondences

# Columns of a table whose points are told by their places on the board.
_CELLS = replace(
    POINTS,
    required=PIXEL,
    optional=(*POINTS.optional, "row", "col"),
    headerless=False,
    aliases={name: forms for name, forms in POINTS.aliases.items() if name not in PLACE}
    | {
        "col": ("column", "boardcol", "colindex"),
        "row": ("boardrow", "rowindex"),
        "point": (*POINTS.aliases["point"], "id"),
    },
    others=((tuple("xy"), PIXEL),),
)


@frozen_dataclass
class Given:
    """What the caller says: the board, its unit, whether points are wanted, the advice without a board."""

    board: Board | None
    unit: str | None
    points: bool
    advice: str
    notes: list[str]


def table_of(names: list[str], given: Given) -> Correspondences:
    """Read tables of points with their places."""
    tables = [read_table(name, POINTS) for name in names]
    points = correspondences(tables, given.notes)
    if given.board is not None:
        given.notes.append(f"{points.source}: has the places of its points, so the board is not used")
    if given.unit in (None, points.unit):
        return points
    if all(table.metadata.unit for table in tables):
        raise FormatError(f"is in {points.unit}, not {given.unit}; leave out --unit", points.source)
    return replace(points, unit=str(given.unit))


def is_of_cells(text: str) -> bool:
    """Whether a text may be a table of pixels and their places on a board, without X, Y, Z under any name."""
    names, given = set(column_names(text, _CELLS)), set(PLACE) & set(column_names(text, POINTS))
    told = "point" in names or {"row", "col"} <= names or (not given and {"u", "v"} <= names)
    return told and len(given) < len(PLACE)


def has_points(text: str) -> bool:
    """Whether a text may be a table of points, perhaps with some of the columns under other names."""
    names = {name.lower() for name in column_names(text, POINTS)}
    return {"u", "v"} <= names or {"x", "y"} <= names


def of_cells(names: list[str], board: Board, notes: list[str]) -> Correspondences:
    """Read tables of points by row and column on the board, or by their ids or numbers along its rows.

    Rows, columns and numbers are counted from 1 if they go beyond the board's and none is 0.
    """
    if len(board.planes) != 1:
        raise FormatError("has points by their places on a board; give a board of one plane", names[0])
    (plane,) = board.planes
    ids = list(plane.vertex_ids())
    tables = [read_table(name, _CELLS) for name in names]
    cells = [_cells(table, ids, plane.cols) for table in tables]
    if len({one.shape[1] for one in cells}) > 1:
        raise FormatError("tells its points otherwise than other files; give row and col in all", names[0])
    sides = np.array([plane.cols, plane.rows]) if cells[0].shape[1] == 2 else np.array([len(ids)])
    if all((one >= 1).all() for one in cells) and any((one >= sides).any() for one in cells):
        cells = [one - 1 for one in cells]
        notes.append(f"{names[0]}: counts the points of the board from 1")
    vertices = plane.vertices().reshape(-1, 3)
    placed = []
    for table, cell in zip(tables, cells, strict=True):
        wrong = ((cell < 0) | (cell >= sides) | (cell % 1 != 0)).any(axis=1)
        if wrong.any():
            raise FormatError(
                f"is no vertex of a board of {plane.cols} x {plane.rows}; give the board that was measured",
                table.source,
                int(table.lines[np.argmax(wrong)]),
            )
        k = (cell @ [1, plane.cols] if cell.shape[1] == 2 else cell[:, 0]).astype(int)
        numbers = {name: column for name, column in table.numbers.items() if name not in ("row", "col")}
        numbers |= dict(zip(PLACE, vertices[k].T, strict=True))
        labels = {**table.labels, "point": np.array(ids)[k]}
        placed.append(replace(table, numbers=numbers, labels=labels))
    return replace(correspondences(placed, notes), unit=board.unit)


def _cells(table: Table, ids: list[str], cols: int) -> Array:
    """Column and row (N, 2) of each point, or its number (N, 1) along the rows of the board."""
    if {"row", "col"} <= table.numbers.keys():
        return table.stack(("col", "row"))
    labels = table.labels.get("point")
    if labels is None:
        raise FormatError("names no point of the board; add columns row and col, or point", table.source)
    if all(map(str.isdecimal, labels.tolist())):
        return labels.astype(float)[:, None]
    places = {label: (k % cols, k // cols) for k, label in enumerate(ids)}
    return np.array([places.get(label, (-1, -1)) for label in labels.tolist()], dtype=float)


@frozen_dataclass(eq=False)
class Seen:
    """The corners of one view: pixels (N, 2), nan if not found, and places (N, 3), if the file has them."""

    name: str
    pixels: Array
    places: Array | None
    field: Field  # for messages


def vnl(text: str, source: str, given: Given) -> Correspondences:
    """Read mrcal's table; ``-`` means a corner was not found, and each level doubles sigma."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        corners = rows.setdefault(words[0], [])
        if "-" in words[1:3]:
            corners.append((np.nan, np.nan, 0.0))
            continue
        try:
            level = float(words[3]) if len(words) > 3 and words[3] != "-" else 0.0
            corners.append((float(words[1]), float(words[2]), level))
        except (ValueError, IndexError) as error:
            raise FormatError("is not a line 'filename x y level'; correct it", source, number) from error
    # A single line without a corner means that the board was not found.
    seen = {name: corners for name, corners in rows.items() if len(corners) > 1 or np.isfinite(corners[0][0])}
    if not seen:
        raise FormatError("has no detected corner; give another file", source)
    if len(set(map(len, seen.values()))) > 1:
        raise FormatError(
            "the images have different numbers of corners; write all of them, - for none", source
        )
    stack = np.array(list(seen.values())).reshape(len(seen), -1, 3)
    # A negative level marks a corner that mrcal considers an outlier.
    pixels = np.where(stack[:, :, 2:] < 0, np.nan, stack[:, :, :2])
    field, found = Field(None, source, "the table"), np.isfinite(pixels).all(axis=2)
    views = [Seen(name, uv, None, field) for name, uv in zip(_stems(seen), pixels, strict=True)]
    points, sigma = assembled(views, given, source), 2.0 ** stack[:, :, 2][found]
    if not (sigma > 1).any():
        return points
    return replace(points, covariance=np.column_stack([sigma**2, 0 * sigma, sigma**2]))


def separate(names: list[str], given: Given) -> Correspondences:
    """Read files of numbers: board points X Y Z, unless a board is given, and u v of each view."""
    tables, places = [_table(name) for name in names], None
    if tables[0].shape[1] == 3 or given.board is None:
        if len(tables) == 1:
            raise FormatError("holds places alone; give the files of the pixels after it", names[0])
        first, names = tables.pop(0), names[1:]
        places = np.pad(first, ((0, 0), (0, 3 - first.shape[1])))
    count = len(tables[0] if places is None else places)
    for name, table in zip(names, tables, strict=True):
        if table.shape != (count, 2):
            raise FormatError(
                f"has {len(table)} rows of {table.shape[1]}; give {count} rows of u and v", name
            )
    field = Field(None, names[0], "the file")
    views = [Seen(name, uv, places, field) for name, uv in zip(_stems(names), tables, strict=True)]
    return assembled(views, given, names[0])


def _stems(names: Iterable[str]) -> list[str]:
    """Names of files without folder and extension; the full names if these are not distinct."""
    stems = [Path(name).stem for name in names]
    return stems if len(set(stems)) == len(stems) else list(names)


def _table(name: str) -> Array:
    data, source = read_bytes(name)
    rows = []
    for number, line in enumerate(decode(data, source).splitlines(), start=1):
        words = re.split(r"[\s,;]+", line.strip())
        if words == [""] or words[0].startswith("#"):
            continue
        try:
            rows.append([float(word) for word in words if word])
        except ValueError as error:
            raise FormatError("is not a row of numbers; correct it", source, number) from error
        if len(rows[-1]) != len(rows[0]) or len(rows[0]) not in (2, 3):
            raise FormatError("must be a row of 2 numbers or of 3, as all the others", source, number)
    if not rows:
        raise FormatError("holds no numbers; give another file", source)
    return np.array(rows)


def of_board(
    board: Board | None, count: int, field: Field, advice: str, down: bool = False
) -> tuple[Array, list[str]]:
    """Vertices (N, 3) of a board of one plane, and their ids, along its rows or down its columns."""
    if board is None:
        field.refuse(f"{field.path} has {count} corners a view, but not their places on the board; {advice}")
    if len(board.planes) != 1 or board.planes[0].cols * board.planes[0].rows != count:
        sizes = " and ".join(f"{plane.cols} x {plane.rows}" for plane in board.planes)
        field.refuse(
            f"there are {count} corners a view, and {sizes} vertices on the board; give the board that was "
            "measured"
        )
    (plane,) = board.planes
    order = np.arange(count)
    if down:
        order = order.reshape(plane.rows, plane.cols).T.ravel()
    ids = list(plane.vertex_ids())
    return plane.vertices().reshape(-1, 3)[order], [ids[k] for k in order]


def assembled(
    views: Sequence[Seen],
    given: Given,
    source: str,
    ids: list[str] | None = None,
    *,
    unit: str | None = None,
    named: bool = True,
    down: bool = False,
) -> Correspondences:
    """Join views to one data set, without corners that are nan.

    Their ids are these, or those of the board if it has their places, or numbers if corners are `named`.
    `unit` is that of places in the file, and `down` as for `of_board`.
    """
    world, pixels, names, labels = [], [], [], []
    unit = unit or given.unit or "unknown"
    for one in views:
        places, own = one.places, ids or list(map(str, range(len(one.pixels))))
        if places is None:
            places, own = of_board(given.board, len(one.pixels), one.field, given.advice, down)
            unit, named = given.board.unit if given.board else unit, True
        if len(places) != len(one.pixels):
            one.field.fail(f"{len(places)} points in each view, as there are places on the board")
        found = np.asarray(np.isfinite(one.pixels).all(axis=1))
        world.append(places[found])
        pixels.append(one.pixels[found])
        names += [one.name] * int(found.sum())
        labels += [label for label, here in zip(own, found, strict=True) if here]
    if not names:
        raise FormatError("has no detected corner; give another file", source)
    with value_failures(""):
        return Correspondences(
            np.concatenate(world), np.concatenate(pixels), np.array(names), unit=unit, source=source,
            point=np.array(labels) if named else None,
        )  # fmt: skip

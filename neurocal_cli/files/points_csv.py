"""Points CSV: known points and their pixels as a table that users and programs can edit."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError, value_failures
from neurocal_cli.files.table import Table, read_table
from neurocal_cli.files.table_header import METADATA, Schema, quoted_field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.observations.labels import most_moved
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.separate_boards import by_board, parts_of

TABLES = (".csv", ".txt", ".tsv")  # endings of files
PLACE = ("X", "Y", "Z")
PIXEL = ("u", "v")
OPTIONAL = {
    "covariance": ("suu", "suv", "svv"),
    "world_std": ("sX", "sY", "sZ"),
    "across": ("nu", "nv"),
    "time": ("time",),
}
"""Names of the optional columns, by their attribute of `Correspondences`."""
_SETTINGS = ("zoom", "focus")
# Names of columns in use elsewhere, in lower case without punctuation.
_WORLD = (
    "{0}world", "world{0}", "{0}w", "obj{0}", "object{0}", "objloc{0}", "{0}3d", "{0}object", "{0}mm",
    "{0}cm", "{0}m",
)  # fmt: skip
_IMAGE = (
    "imgloc{1}", "img{1}", "image{1}", "pixel{1}", "{1}pixel", "{1}img", "{1}image", "{0}pixel", "pixel{0}",
    "{0}px", "{1}px", "{1}2d",
)  # fmt: skip
POINTS = Schema(
    kind="points",
    required=(*PLACE, *PIXEL),
    optional=("view", "point", "camera", "board", "sigma", *chain(*OPTIONAL.values()), *_SETTINGS),
    labels=frozenset({"view", "point", "camera", "board"}),
    headerless=True,
    aliases={
        **{axis: tuple(form.format(axis.lower()) for form in _WORLD) for axis in PLACE},
        **{
            name: tuple(form.format(name, axis) for form in _IMAGE)
            for name, axis in zip(PIXEL, "xy", strict=True)
        },
        "view": ("syncindex", "image", "img", "imagename", "filename", "frame"),
        "point": ("keypointid", "pointid", "cornerid", "corner"),
        "camera": ("camid", "cameraid", "cam", "port"),
        "time": ("frametime",),
    },
    others=((tuple("xyz"), PLACE), (tuple("xy"), PIXEL), (("col", "row"), PIXEL), (("column", "row"), PIXEL)),
    instead="; neurocal convert --to neurocal makes one of another program's corners",
)


def read_points(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> Correspondences:
    """Read points from CSV files.

    Parameters
    ----------
    paths : str, Path or a sequence of them
        ``-`` is stdin. Several files are read as one: view names must then differ between files, and a file
        without a column ``view`` is one view with the file's name.
    notes : list of str, optional
        Remarks about ignored columns are appended.

    Returns
    -------
    points : Correspondences
        With the line of each row, for messages.

    Raises
    ------
    FormatError
        A file cannot be read; the message begins with ``FILE:LINE:``.
    InputError
        Rows are well formed but contradict each other.
    """
    several = [paths] if isinstance(paths, (str, bytes, os.PathLike)) else list(paths)
    if not several:
        raise InputError("there are no files of points; give at least one")
    tables = [read_table(path, POINTS) for path in several]
    return correspondences(tables, notes if notes is not None else [])


def ids_at_two_places(points: Correspondences) -> list[str]:
    """A note on an id with different X,Y,Z in two views, which is right for several targets only."""
    moved = None if points.point is None else most_moved(points.world, np.asarray(points.point))
    if moved is None or points.point is None:
        return []
    places = [f"({', '.join(f'{x:g}' for x in points.world[row])})" for row in moved]
    return [
        f"{points.place(moved[0])}: the point {str(points.point[moved[0]])[:60]!r} is at {places[0]}, but at "
        f"{places[1]} in {points.place(moved[1])}; if all views show one target, correct X,Y,Z"
    ]


def write_points(points: Correspondences, path: str | Path) -> None:
    """Write points as CSV; `read_points` gives back the same numbers to the last bit."""
    write_whole(path, format_points(points))


def format_points(points: Correspondences) -> str:
    """Points as the text of a CSV file; an InputError if a label is empty or has a line break."""
    labels = {}
    view, board, point = parts_of(points)
    if view is not None:
        quoted = {label: _quoted(label, "view") for label in dict.fromkeys(view)}
        labels["view"] = [quoted[label] for label in view]
    if board is not None:
        labels["board"] = board
    if point is not None:
        labels["point"] = [_quoted(label, "point") for label in point]
    names, blocks = value_columns(points)
    numbers = json.dumps(np.hstack([points.world, *blocks]).tolist(), separators=(",", ":"))
    rows = map(",".join, zip(*labels.values(), numbers[2:-2].split("],["), strict=True))
    if points.unit != points.unit.strip(" \t,;") or re.search(r"[\r\n\0]", points.unit) or not points.unit:
        raise InputError(f"the unit {points.unit!r} cannot be written; name it in a word, such as mm")
    given = {key: value for key in METADATA if (value := getattr(points, key))}
    lines = [f"# {key}: {METADATA[key][1](value)}" for key, value in given.items()]
    return "\n".join([*lines, ",".join([*labels, *PLACE, *names]), *rows, ""])


def value_columns(points: Correspondences) -> tuple[list[str], list[Array]]:
    """Names and values of the columns after the world coordinates: pixels and the optional columns."""
    names, blocks = list(PIXEL), [points.pixels]
    for attribute, columns in OPTIONAL.items():
        values = getattr(points, attribute)
        if values is not None:
            names += columns
            blocks.append(values.reshape(len(values), -1))
    return names, blocks


def _quoted(label: str, name: str) -> str:
    if not label or "\n" in label or "\r" in label or "\0" in label:
        raise InputError(f"the {name} label {label[:40]!r} cannot be written to CSV; rename it")
    return quoted_field(label)


def correspondences(tables: list[Table], notes: list[str]) -> Correspondences:
    """Join the tables of one or several files, and append remarks about ignored columns to `notes`."""
    for table in tables:
        table.note_unknown(notes)
    _check_settings(tables, notes)
    _check_one_camera(tables)
    several = len(tables) > 1
    images = _of_some(
        tables,
        [_views_of_file(table) if "board" in table.labels else None for table in tables],
        _without("column board"),
    )
    tables = [_told_apart(table) for table in tables] if images is not None else tables
    views = [_views_of_file(table) for table in tables] if several or "view" in tables[0].labels else None
    owners = _owners(tables, views) if several and views else None
    points = _if_all(tables, "point", "point ids", notes)

    def known_or_zero(names: tuple[str, ...]) -> Array | None:
        blocks = [_together(table, names) for table in tables]
        return _of_some(tables, blocks, lambda table: np.zeros((len(table), len(names))))

    return Correspondences(
        _joined([table.stack(PLACE) for table in tables]),
        _joined([table.stack(PIXEL) for table in tables]),
        view=None if views is None else _joined(views),
        point=points,
        covariance=_of_some(tables, list(map(_covariance, tables)), _without("sigma (or suu,suv,svv)")),
        world_std=known_or_zero(OPTIONAL["world_std"]),
        across=known_or_zero(OPTIONAL["across"]),
        time=_if_all(tables, "time", "times", notes),
        image=images,
        image_size=_agreed("image_size", tables),
        image_center=_agreed("image_center", tables),
        distances=_agreed("distances", tables) or () if points is not None or not several else (),
        board=_agreed("board", tables) or "",
        undistorted=_undistorted(tables, notes),
        unit=_agreed("unit", tables) or "mm",
        source=tables[0].source,
        lines=_joined([table.lines for table in tables]),
        sources=owners,
    )


def _if_all(tables: list[Table], name: str, said: str, notes: list[str]) -> NDArray[Any] | None:
    """A column that all files have; a note if some have it."""
    columns = [table.labels.get(name, table.numbers.get(name)) for table in tables]
    there = [column for column in columns if column is not None]
    if there and len(there) < len(tables):
        lacking = next(table for table, column in zip(tables, columns, strict=True) if column is None)
        notes.append(f"{lacking.source}: has no column {name}, so the {said} of the other files are not used")
    return _joined(there) if len(there) == len(tables) else None


def _of_some(
    tables: list[Table], blocks: Sequence[NDArray[Any] | None], otherwise: Callable[[Table], NDArray[Any]]
) -> NDArray[Any] | None:
    """Columns of several files, or what takes their place in files without; None if no file has them."""
    if all(block is None for block in blocks):
        return None
    both = zip(tables, blocks, strict=True)
    return _joined([otherwise(table) if block is None else block for table, block in both])


def _without(name: str) -> Callable[[Table], NoReturn]:
    def refuse(table: Table) -> NoReturn:
        raise FormatError(f"has no {name} as other files do; give it in all or none", table.source)

    return refuse


def _told_apart(table: Table) -> Table:
    """The table with a view for each board in each image, and with ids of each board's points."""
    with value_failures(table.source):
        view, point = by_board(_views_of_file(table), table.labels.get("point"), table.labels["board"])
    named = {"view": view} | ({} if point is None else {"point": point})
    return replace(table, labels=table.labels | named)


def _joined(blocks: list[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate blocks; a single one is not copied, because it may have a million rows."""
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)


def _views_of_file(table: Table) -> NDArray[Any]:
    if "view" in table.labels:
        return table.labels["view"]
    name = "stdin" if table.source == "<stdin>" else os.path.splitext(os.path.basename(table.source))[0]
    return np.full(len(table), name)


def _owners(tables: list[Table], views: list[NDArray[Any]]) -> dict[str, str]:
    """Find the file of each view."""
    owners: dict[str, str] = {}
    for table, labels in zip(tables, views, strict=True):
        for name in dict.fromkeys(labels.tolist()):
            if name in owners:
                row = int(np.argmax(labels == name))
                raise InputError(
                    f"{table.source}:{table.lines[row]}: the view {name[:60]!r} is also in {owners[name]}; "
                    "give each view of the camera a name of its own"
                )
            owners[name] = table.source
    return owners


def _agreed(key: str, tables: list[Table]) -> Any:
    """Value of a metadata key, on which all files that give it must agree."""
    given = [(getattr(table.metadata, key), table.source) for table in tables]
    given = [(value, source) for value, source in given if value is not None]
    for value, source in given:
        first, first_source = given[0]
        if value != first:
            raise FormatError(
                f"{key} is {_plain(value)} but {_plain(first)} in {first_source}; "
                "files of one camera must agree",
                source,
            )
    return given[0][0] if given else None


def _undistorted(tables: list[Table], notes: list[str]) -> str:
    """What all files say, or else some of them, with a note on those that do not."""
    shape = str(_agreed("undistorted", tables) or "")
    others = [table.source for table in tables if table.metadata.undistorted is None]
    if shape and others:
        notes.append(
            f"{others[0]}: the points of other files are undistorted, and those of this file are taken for "
            "undistorted, too; give the points of one camera as they were measured, or all undistorted"
        )
    return shape


def _plain(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _check_settings(tables: list[Table], notes: list[str]) -> None:
    """Refuse points at several zoom or focus settings, because a calibration has one setting."""
    for name in _SETTINGS:
        given = [(table, table.numbers[name]) for table in tables if name in table.numbers]
        if not given:
            continue
        setting = given[0][1][0]
        for table, column in given:
            differs = column != setting
            if differs.any():
                row = int(np.argmax(differs))
                raise InputError(
                    f"{table.source}:{table.lines[row]}: {name} changes from {setting:g} to {column[row]:g}, "
                    "but a calibration has one setting of zoom and focus; give one setting, or use "
                    "`neurocal lens fit`"
                )
        notes.append(f"{tables[0].source}: {name} is {setting:g} throughout; the column is not used")


def _check_one_camera(tables: list[Table]) -> None:
    """Refuse the points of several cameras, which one camera cannot fit."""
    columns = [(table, table.labels["camera"].tolist()) for table in tables if "camera" in table.labels]
    named = {name: table for table, names in columns for name in dict.fromkeys(names)}
    if len(named) > 1:
        told = ", ".join(name[:20] for name in named)
        raise FormatError(
            f"holds points of {len(named)} cameras ({told[:80]}); give it to neurocal rig, or the rows of "
            "one camera",
            next(iter(named.values())).source,
        )


def _covariance(table: Table) -> Array | None:
    """(N, 3) covariance from the columns sigma or suu, suv, svv."""
    if "sigma" not in table.numbers:
        return _together(table, OPTIONAL["covariance"])
    if any(name in table.numbers for name in OPTIONAL["covariance"]):
        raise FormatError("has both sigma and suu,suv,svv; keep one", table.source)
    sigma = table.numbers["sigma"]
    if not (sigma > 0).all():
        row = int(np.argmin(sigma > 0))
        raise InputError(
            f"{table.source}:{table.lines[row]}: sigma is {sigma[row]:g}, but must be positive; "
            "correct or remove the row"
        )
    with np.errstate(over="ignore", under="ignore"):  # Correspondences refuses the resulting inf or 0
        return np.column_stack([sigma * sigma, np.zeros_like(sigma), sigma * sigma])


def _together(table: Table, names: tuple[str, ...]) -> Array | None:
    """Stack columns of which a file must have all or none."""
    given = [name for name in names if name in table.numbers]
    if given and len(given) < len(names):
        raise FormatError(
            f"has {', '.join(given)} only; give {'both' if len(names) == 2 else 'all of'} {','.join(names)}",
            table.source,
        )
    return table.stack(names) if given else None

"""Points CSV: known points and their pixels as a table that users and programs can edit."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.io.point_columns import OPTIONAL, PIXEL, PLACE, value_columns
from neurocal_cli.io.points_join import SETTINGS, correspondences
from neurocal_cli.io.table import read_table
from neurocal_cli.io.table_header import Schema, quoted_field
from neurocal_cli.io.writing import write_whole
from neurocal_cli.points import Correspondences
from neurocal_cli.repeated_ids import first_moved

if TYPE_CHECKING:
    from pathlib import Path

POINTS = Schema(
    kind="points",
    required=(*PLACE, *PIXEL),
    optional=("view", "point", "sigma", *chain(*OPTIONAL.values()), *SETTINGS),
    labels=frozenset({"view", "point"}),
    headerless=(*PLACE, *PIXEL),
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
    moved = None if points.point is None else first_moved(points.world, np.asarray(points.point))
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
    """Points as the text of a CSV file.

    Raises
    ------
    InputError
        A label is empty or has a line break, so it cannot be written to CSV.
    """
    labels = {}
    if points.view is not None:
        quoted = [_quoted(label, "view") for label in points.view_names]
        labels["view"] = [quoted[k] for k in points.view_index.tolist()]
    if points.point is not None:
        labels["point"] = [_quoted(str(label), "point") for label in np.asarray(points.point).tolist()]
    names, blocks = value_columns(points)
    numbers = json.dumps(np.hstack([points.world, *blocks]).tolist(), separators=(",", ":"))
    rows = map(",".join, zip(*labels.values(), numbers[2:-2].split("],["), strict=True))
    return "\n".join([*_metadata_lines(points), ",".join([*labels, *PLACE, *names]), *rows, ""])


def _metadata_lines(points: Correspondences) -> list[str]:
    lines = []
    if points.image_size is not None:
        lines.append(f"# image_size: {points.image_size[0]} {points.image_size[1]}")
    if points.image_center is not None:
        lines.append(f"# image_center: {points.image_center[0]!r} {points.image_center[1]!r}")
    if points.unit != points.unit.strip(" \t,;") or re.search(r"[\r\n\0]", points.unit) or not points.unit:
        raise InputError(f"the unit {points.unit!r} cannot be written; name it in a word, such as mm")
    if points.distances:
        rows = [[one.start, one.end, one.length, one.std] for one in points.distances]
        lines.append(f"# distances: {json.dumps(rows)}")
    return [*lines, f"# unit: {points.unit}"]


def _quoted(label: str, name: str) -> str:
    if not label or "\n" in label or "\r" in label or "\0" in label:
        raise InputError(f"the {name} label {label[:40]!r} cannot be written to CSV; rename it")
    return quoted_field(label)

"""Points CSV: known points and their pixels as a table that people and programs can edit."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.io.points_join import ACROSS, COVARIANCE, SETTINGS, WORLD_STD, correspondences
from neurocal_cli.io.table import read_table
from neurocal_cli.io.table_header import Schema
from neurocal_cli.io.writing import write_whole
from neurocal_cli.points import Correspondences

POINTS = Schema(
    kind="points",
    required=("X", "Y", "Z", "u", "v"),
    optional=("view", "point", "sigma", *COVARIANCE, *WORLD_STD, *ACROSS, *SETTINGS),
    labels=frozenset({"view", "point"}),
    headerless=("X", "Y", "Z", "u", "v"),
    instead="; neurocal convert --to neurocal makes one of another program's corners",
)


def read_points(
    paths: str | Path | Sequence[str | Path], *, notes: list[str] | None = None
) -> Correspondences:
    """Read points from CSV files.

    Parameters
    ----------
    paths : str, Path or a sequence of them
        ``-`` is stdin. Several files are read as one: view names must then differ between files,
        and a file without a column ``view`` is one view with the file's name.
    notes : list of str, optional
        Remarks about what was left out are appended.

    Returns
    -------
    points : Correspondences
        With the line of each row, for messages.

    Raises
    ------
    FormatError
        A file that cannot be read; the message begins with ``FILE:LINE:``.
    InputError
        Rows that are well formed but do not fit together.
    """
    several = [paths] if isinstance(paths, (str, Path)) else list(paths)
    if not several:
        raise InputError("there are no files of points; give at least one")
    tables = [read_table(path, POINTS) for path in several]
    return correspondences(tables, notes if notes is not None else [])


def write_points(points: Correspondences, path: str | Path) -> None:
    """Write points as CSV; `read_points` gives back the same numbers to the last bit."""
    write_whole(path, format_points(points))


def format_points(points: Correspondences) -> str:
    """Points as the text of a CSV file.

    Raises
    ------
    InputError
        A label that no CSV file can hold: empty or with a line break.
    """
    columns = {name: _quoted_labels(name, points) for name in ("view", "point")}
    labels = {name: column for name, column in columns.items() if column is not None}
    blocks = [points.world, points.pixels]
    names = [*labels, *POINTS.required]
    if points.covariance is not None:
        blocks.append(points.covariance)
        names += COVARIANCE
    if points.world_std is not None:
        blocks.append(points.world_std)
        names += WORLD_STD
    if points.across is not None:
        blocks.append(points.across)
        names += ACROSS
    numbers = json.dumps(np.hstack(blocks).tolist(), separators=(",", ":"))[2:-2].split("],[")
    rows = map(",".join, zip(*labels.values(), numbers, strict=True)) if labels else numbers
    return "\n".join([*_metadata_lines(points), ",".join(names), *rows, ""])


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


def _quoted_labels(name: str, points: Correspondences) -> list[str] | None:
    labels = getattr(points, name)
    if labels is None:
        return None
    if name == "view":
        quoted = [_quoted(label, name) for label in points.view_names]
        return [quoted[k] for k in points.view_index.tolist()]
    return [_quoted(str(label), name) for label in labels.tolist()]


def _quoted(label: str, name: str) -> str:
    if not label or "\n" in label or "\r" in label or "\0" in label:
        raise InputError(f"the {name} label {label[:40]!r} cannot be written to CSV; rename it")
    if re.search(r'[",;\t]|^[ #]|[ ]$', label):
        return '"' + label.replace('"', '""') + '"'
    return label

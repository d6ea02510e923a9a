"""Manifests of many data sets: a CSV with a row for each of them, or a tree of folders.

A manifest has a header. Its columns are named by `batch_jobs`; here they are only cells of text. Cells that
are empty are not given. Lines that begin with ``#`` are comments, and commas, semicolons or tabs separate.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Mapping

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.files.failures import one_line
from neurocal_cli.files.image_files import is_image, natural_order
from neurocal_cli.files.reading import read_text

_SEPARATORS = ",;\t"
_BOARD = "board.yaml"  # of the images in its folder and below


@frozen_dataclass
class DataSet:
    """One row of a manifest, or one folder."""

    name: str
    cells: Mapping[str, str]  # by column, in lower case and with "-" for "_"; without empty ones
    place: str  # of the row, for messages
    folder: str  # that its paths are relative to


def read_data_sets(path: str) -> list[DataSet]:
    """Read a manifest, or find the data sets in the leaf folders of a tree.

    Raises
    ------
    FormatError
        The manifest cannot be read, has no column `name`, or a name twice or that is no name of a folder.
    InputError
        The tree has no folder with images or points, or two with the same name.
    """
    found = _in_tree(path) if os.path.isdir(path) else _in_manifest(path)
    seen: dict[str, DataSet] = {}
    for one in found:
        if (former := seen.setdefault(one.name.casefold(), one)) is not one:
            raise InputError(f"{one.place}: the name {one.name!r} is that of {former.place}, too; rename one")
    return found


def _in_manifest(path: str) -> list[DataSet]:
    text, source = read_text(path, "a manifest")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if _counts(line)]
    if len(lines) < 2:
        raise FormatError("has no rows; give a header and a row for each data set", source)
    head = lines[0][1]
    separator = max(_SEPARATORS, key=head.count)
    rows = list(csv.reader([line for _, line in lines], delimiter=separator, skipinitialspace=True))
    columns = [cell.strip().lower().replace("_", "-") for cell in rows[0]]
    if "name" not in columns or len(set(columns)) < len(columns):
        raise FormatError("the header needs a column name, and each column once", source, lines[0][0])
    folder = os.path.dirname(os.path.abspath(path))
    found = []
    for (number, _), row in zip(lines[1:], rows[1:], strict=True):
        if len(row) > len(columns):
            raise FormatError(
                f"has {len(row)} cells, but the header has {len(columns)}; quote those that hold a "
                f"{separator!r}", source, number,
            )  # fmt: skip
        cells = {c: cell.strip() for c, cell in zip(columns, row, strict=False) if cell.strip()}
        name = cells.pop("name", "")
        if not _is_name(name):
            raise FormatError(
                f"the name {name!r} cannot be that of a folder; use letters, digits, - and _", source, number
            )
        found.append(DataSet(name, cells, f"{source}:{number}", folder))
    return found


def _counts(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _is_name(name: str) -> bool:
    """Whether a folder can have this name on any system."""
    return bool(name) and name.isprintable() and name[0] not in ".-" and not set(name) & set('/\\:*?"<>|')


def _in_tree(root: str) -> list[DataSet]:
    """Folders below the root that hold images, or points if there are no images, and no further folders."""
    found = []
    top = os.path.abspath(root)
    for folder, below, files in os.walk(top):
        below[:] = sorted((name for name in below if not name.startswith(".")), key=natural_order)
        if below:
            continue
        images = [name for name in files if is_image(name) and not name.startswith(".")]
        points = sorted((name for name in files if name.lower().endswith(".csv")), key=natural_order)
        if not (images or points):
            continue
        inner = os.path.relpath(folder, top)
        name = os.path.basename(top) if inner == os.curdir else inner.replace(os.sep, "-")
        if not _is_name(name):
            raise InputError(f"{one_line(folder)}: cannot be the name of a folder of results; rename it")
        cells = {"images": os.curdir} if images else _of_points(points)
        if images and (board := _board_above(folder, top)):
            cells["board"] = board
        found.append(DataSet(name, cells, one_line(folder), folder))
    if not found:
        raise InputError(f"{one_line(root)}: no folder in it holds images or points; give another folder")
    return found


def _of_points(files: list[str]) -> dict[str, str]:
    """The columns of files of points: left.csv and right.csv are a pair, cam0.csv, cam1.csv, ... a rig."""
    named = {os.path.splitext(name)[0].lower(): name for name in files}
    if len(named) == len(files):
        if set(named) == {"left", "right"}:
            return {"points": named["left"], "right": named["right"]}
        if len(named) > 1 and all(re.fullmatch(r"cam\d+", name) for name in named):
            return named
    return {"points": ";".join(files)}


def _board_above(folder: str, top: str) -> str:
    """The board file of a folder, in it or the nearest one above it; "" if there is none."""
    while True:
        if os.path.isfile(path := os.path.join(folder, _BOARD)):
            return path
        if folder == top or folder == os.path.dirname(folder):
            return ""
        folder = os.path.dirname(folder)

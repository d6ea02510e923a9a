"""The summary of a fleet as CSV: a row for each camera of each job."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from typing import Any

from neurocal_cli.errors import FormatError
from neurocal_cli.files.reading import read_text

Row = Mapping[str, Any]

# The first and the last columns; parameters with their standard deviations stand between them.
_FIRST = ("name", "camera", "status", "verdict", "reasons", "n_views", "n_points", "n_rejected", "distortion")
_LAST = (
    "rmse_px", "held_out_px", "std_px", "seconds", "outlier", "drift", "drift_px", "drift_std_px",
    "drift_share", "file", "problem",
)  # fmt: skip


def columns_of(rows: Sequence[Row]) -> list[str]:
    """The columns of rows in their order: the common ones, and the parameters that any camera has."""
    others = (*_FIRST, *_LAST, "log")  # the last is for the page
    middle = dict.fromkeys(key for row in rows for key in row if key not in others)
    return [*_FIRST, *middle, *_LAST]


def format_fleet(rows: Sequence[Row]) -> str:
    """Text of the summary; numbers read back exactly, and what is unknown is empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    columns = columns_of(rows)
    writer.writerow(columns)
    for row in rows:
        writer.writerow(["" if row.get(column) is None else row[column] for column in columns])
    return buffer.getvalue()


def read_fleet(path: str) -> dict[tuple[str, str], str]:
    """Read an earlier summary: the file of each camera by the names of its job and the camera.

    Raises FormatError if the file is no summary.
    """
    text, source = read_text(path, "a summary")
    rows = csv.DictReader(io.StringIO(text))
    if not {"name", "camera", "file"} <= set(rows.fieldnames or ()):
        raise FormatError("is no summary of neurocal batch; give its summary.csv", source)
    folder = os.path.dirname(os.path.realpath(path))
    return {
        (row["name"], row["camera"]): os.path.join(folder, row["file"]) for row in rows if row.get("file")
    }

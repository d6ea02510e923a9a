"""CSV of pixels and of the points that they show on a plane, batch by batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.plane_points import PlanePoints
from neurocal_cli.errors import InputError
from neurocal_cli.files.table import stream_table
from neurocal_cli.files.table_header import Schema, quoted_field

PIXELS = Schema(
    kind="pixels",
    required=("u", "v"),
    optional=("point",),
    labels=frozenset({"point"}),
    headerless=True,
)
COLUMNS = ("X", "Y", "Z", "sXX", "sXY", "sYY", "flag")
_LARGEST = 1e100  # squares of pixels beyond this overflow
_FLAGS = np.array(["behind", "ok"])
_ROW = ",".join(["%.10g"] * 3 + ["%.6g"] * 3 + ["%s"])

Batch = tuple[Array, NDArray[Any] | None]  # pixels (N, 2) and the names of their points


def read_pixels(path: str | Path, notes: list[str]) -> Iterator[Batch]:
    """Read pixels in batches; remarks on columns that are not used are appended to `notes`."""
    for k, table in enumerate(stream_table(path, PIXELS)):
        if k == 0:
            table.note_unknown(notes)
        pixels = table.stack(PIXELS.required)
        sensible = np.abs(pixels).max(axis=1) <= _LARGEST
        if not sensible.all():
            line = table.lines[int(np.argmin(sensible))]
            raise InputError(
                f"{table.source}:{line}: u,v must be numbers of a sensible size; correct the row"
            )
        yield pixels, table.labels.get("point")


def format_plane_points(
    batches: Iterable[tuple[PlanePoints, NDArray[Any] | None]], *, view: str, unit: str, sigma: float
) -> Iterator[str]:
    """Text of a file, one part per batch of points and their names; the first includes the header."""
    header = [f"# plane: Z = 0 of the target of the view {view}", f"# unit: {unit}", f"# sigma: {sigma:.6g}"]
    for k, (found, labels) in enumerate(batches):
        if k == 0:
            names = COLUMNS if labels is None else ("point", *COLUMNS)
            yield "\n".join([*header, ",".join(names), ""])
        numbers = np.column_stack([found.points, found.covariance.reshape(-1, 4)[:, [0, 1, 3]]])
        columns: list[list[Any]] = [*numbers.T.tolist(), _FLAGS[found.seen.astype(int)].tolist()]
        row = _ROW
        if labels is not None:
            columns, row = [list(map(quoted_field, labels.tolist())), *columns], f"%s,{_ROW}"
        yield "\n".join(map(row.__mod__, zip(*columns, strict=True))) + "\n"

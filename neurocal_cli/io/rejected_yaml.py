"""The points that a calibration left out, as a block of its file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from neurocal_cli.calibration import Rejected
from neurocal_cli.errors import FormatError, InputError
from neurocal_cli.io.named_entries import named_lines, read_named
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import number, quoted
from neurocal_cli.points import Correspondences

__all__ = ["read_rejected", "rejected_lines"]

_NUMBERS = ("X", "Y", "Z", "u", "v", "error_px")


def rejected_lines(rejected: Rejected) -> Iterator[str]:
    """Lines of the block ``rejected``; none where nothing was."""
    if not len(rejected) and not rejected.views:
        return
    yield "rejected:"
    yield from (
        f"  {line}" for line in named_lines("views", rejected.views, map(quoted, rejected.views.values()))
    )
    points = rejected.points
    if points is None:
        yield "  columns: []"
        yield "  rows: []"
        return
    columns = ["view", *_NUMBERS]
    if points.point is not None:
        columns.insert(1, "point")
    if points.lines is not None:
        columns.insert(0, "line")
    yield f"  columns: [{', '.join(columns)}]"
    yield "  rows:"
    for row in range(len(points)):
        cells = [] if points.lines is None else [str(int(points.lines[row]))]
        cells.append(quoted(points.view_names[points.view_index[row]]))
        if points.point is not None:
            cells.append(quoted(str(points.point[row])))
        values = [*points.world[row].tolist(), *points.pixels[row].tolist(), float(rejected.error_px[row])]
        yield f"      - [{', '.join([*cells, *map(number, values)])}]"


def read_rejected(field: Field | None, unit: str) -> Rejected:
    """Read the block ``rejected`` back.

    Raises
    ------
    FormatError
        A table that is not as it was written.
    """
    if field is None:
        return Rejected()
    views = {name: entry.text() for name, entry in read_named(field["views"]).items()}
    names = [name.text() for name in field["columns"].items()]
    if not names:
        return Rejected(views=views)
    rows = [list(row.items()) for row in field["rows"].items()]
    if set(names) - {"line", "point"} != {"view", *_NUMBERS} or any(len(row) != len(names) for row in rows):
        field.fail(f"a table with view, {', '.join(_NUMBERS)}")
    columns: dict[str, Any] = dict(zip(names, zip(*rows, strict=True), strict=True))
    numbers = np.array([[cell.number_or_nan() for cell in columns[name]] for name in _NUMBERS])
    try:
        points = Correspondences(
            numbers[:3].T,
            numbers[3:5].T,
            view=[cell.text() for cell in columns["view"]],
            point=[cell.text() for cell in columns["point"]] if "point" in columns else None,
            lines=np.array([cell.integer() for cell in columns["line"]]) if "line" in columns else None,
            unit=unit,
            source=field.source,
        )
    except InputError as error:
        raise FormatError(str(error)) from error
    return Rejected(points, numbers[5], views)

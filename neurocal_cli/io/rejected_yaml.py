"""The points that a calibration rejected, as a block of its file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Rejected
from neurocal_cli.io.files import value_failures
from neurocal_cli.io.named_entries import named_lines, read_named
from neurocal_cli.io.text_columns import numbers_of, read_table, table_lines
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import quoted
from neurocal_cli.points import Correspondences

_NUMBERS = ("X", "Y", "Z", "u", "v", "error_px")


def rejected_lines(rejected: Rejected, long: bool) -> Iterator[str]:
    """Lines of the block ``rejected``; none if nothing was rejected."""
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
    columns: dict[str, NDArray[Any] | list[str]] = {}
    if points.lines is not None:
        columns["line"] = points.lines
    columns["view"] = [points.view_names[k] for k in points.view_index.tolist()]
    if points.point is not None:
        columns["point"] = [str(label) for label in points.point]
    numbers = np.column_stack([points.world, points.pixels, rejected.error_px])
    columns |= {name: numbers[:, k] for k, name in enumerate(_NUMBERS)}
    yield from (f"  {line}" for line in table_lines(columns, long))


def read_rejected(field: Field, unit: str) -> Rejected:
    """Read the block ``rejected`` back.

    Raises
    ------
    FormatError
        The table does not have the written form.
    """
    if field.value is None:
        return Rejected()
    views = {name: entry.text() for name, entry in read_named(field["views"]).items()}
    columns = read_table(field, frozenset(("view", "point")))
    if not columns:
        return Rejected(views=views)
    if set(columns) - {"line", "point"} != {"view", *_NUMBERS}:
        field.fail(f"a table with view, {', '.join(_NUMBERS)}")
    numbers = numbers_of(columns, _NUMBERS, unknown=True)
    with value_failures(""):
        points = Correspondences(
            numbers[:3].T,
            numbers[3:5].T,
            view=columns["view"].texts(),
            point=columns["point"].texts() if "point" in columns else None,
            lines=np.array([n.integer() for n in columns["line"].items()]) if "line" in columns else None,
            unit=unit,
            source=field.source,
        )
    return Rejected(points, numbers[5], views)

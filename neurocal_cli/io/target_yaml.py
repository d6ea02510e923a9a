"""The target that a calibration found, as a block of its file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import flow, mapping, number, quoted
from neurocal_cli.target import Target

__all__ = ["read_target", "target_lines"]

_NUMBERS = ("X", "Y", "Z", "X_given", "Y_given", "Z_given", "sX", "sY", "sZ")


def target_lines(target: Target | None) -> Iterator[str]:
    """Lines of the block ``target``; none where the target was taken as given."""
    if target is None:
        return
    yield "target:"
    yield f"  flat: {str(target.flat).lower()}"
    yield f"  evidence: {number(target.evidence)}"
    yield f"  sizes: {mapping(**{name: number(size) for name, size in target.sizes.items()})}"
    columns = ["plane", *_NUMBERS]
    heads = [f"    - [{plane}, " for plane in target.plane.tolist()]
    if target.point is not None:
        columns.insert(0, "point")
        heads = [
            f"    - [{quoted(str(label))}, {plane}, "
            for label, plane in zip(target.point.tolist(), target.plane.tolist(), strict=True)
        ]
    yield f"  columns: [{', '.join(columns)}]"
    yield "  rows:"
    rows = flow(np.hstack([target.found, target.given, target.std]))[2:-1].split(", [")
    yield from (head + row for head, row in zip(heads, rows, strict=True))


def read_target(field: Field | None) -> Target | None:
    """Read the block ``target`` back.

    Raises
    ------
    FormatError
        A table that is not as it was written.
    """
    if field is None:
        return None
    names = [name.text() for name in field["columns"].items()]
    rows = [list(row.items()) for row in field["rows"].items()]
    wanted = {"plane", *_NUMBERS}
    if not rows or set(names) - {"point"} != wanted or any(len(row) != len(names) for row in rows):
        field.fail(f"a table with plane, {', '.join(_NUMBERS)}")
    columns: dict[str, Any] = dict(zip(names, zip(*rows, strict=True), strict=True))
    numbers = np.array([[cell.number() for cell in columns[name]] for name in _NUMBERS]).T
    sizes = {name: field["sizes"][name].number() for name in field["sizes"].keys()}  # noqa: SIM118
    return Target(
        found=numbers[:, :3],
        given=numbers[:, 3:6],
        std=numbers[:, 6:],
        plane=np.array([cell.integer() for cell in columns["plane"]], dtype=np.intp),
        sizes=sizes,
        flat=field["flat"].boolean(),
        evidence=field["evidence"].number(),
        point=np.array([cell.text() for cell in columns["point"]]) if "point" in columns else None,
    )

"""The target shape that a calibration estimated, as a block of its file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bends import Bends
from neurocal_cli.io.text_columns import numbers_of, read_table, table_lines
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import mapping, number
from neurocal_cli.target import Target

_NUMBERS = ("X", "Y", "Z", "X_given", "Y_given", "Z_given", "sX", "sY", "sZ")
_STATED = ("sX_stated", "sY_stated", "sZ_stated")
_SHAPES = ("bowl", "saddle", "twist")


def target_lines(target: Target | None, long: bool) -> Iterator[str]:
    """Lines of the block ``target``; none if the target was used as given."""
    if target is None:
        return
    yield "target:"
    yield f"  flat: {str(target.flat).lower()}"
    yield f"  evidence: {number(target.evidence)}"
    yield f"  sizes: {mapping(**{name: number(size) for name, size in target.sizes.items()})}"
    columns: dict[str, NDArray[Any] | list[str]] = {}
    if target.point is not None:
        columns["point"] = [str(label) for label in target.point]
    columns["plane"] = target.plane
    numbers = np.hstack([target.found, target.given, target.std])
    columns |= {name: numbers[:, k] for k, name in enumerate(_NUMBERS)}
    if target.stated is not None:
        columns |= {name: target.stated[:, k] for k, name in enumerate(_STATED)}
    yield from (f"  {line}" for line in table_lines(columns, long, indent=2))
    if target.bends is not None:
        yield from (f"  {line}" for line in _bends_lines(target.bends, long))


def _bends_lines(bends: Bends, long: bool) -> Iterator[str]:
    yield "bends:  # of each view, from the points above"
    yield f"  size: {number(bends.size)}"
    columns = dict(zip(_SHAPES, bends.coefficients.T, strict=True))
    yield from (f"  {line}" for line in table_lines({"view": list(bends.names), **columns}, long, indent=2))


def read_target(field: Field) -> Target:
    """Read the block ``target`` back.

    Raises
    ------
    FormatError
        The table does not have the written form.
    """
    columns = read_table(field, frozenset(("point",)))
    stated = _STATED if set(_STATED) <= set(columns) else ()
    if set(columns) - {"point", *stated} != {"plane", *_NUMBERS}:
        field.fail(f"a table with plane, {', '.join(_NUMBERS)}")
    numbers = numbers_of(columns, _NUMBERS).T
    return Target(
        found=numbers[:, :3],
        given=numbers[:, 3:6],
        std=numbers[:, 6:],
        plane=np.array([cell.integer() for cell in columns["plane"].items()], dtype=np.intp),
        sizes={name: size.number() for name, size in field["sizes"].entries().items()},
        flat=field["flat"].boolean(),
        evidence=field["evidence"].number(),
        point=np.array(columns["point"].texts()) if "point" in columns else None,
        stated=numbers_of(columns, stated).T if stated else None,
        bends=field.read("bends", _read_bends),
    )


def _read_bends(field: Field) -> Bends:
    columns = read_table(field, frozenset(("view",)))
    if set(columns) != {"view", *_SHAPES}:
        field.fail(f"a table with view, {', '.join(_SHAPES)}")
    coefficients = numbers_of(columns, _SHAPES).T
    return Bends(field["size"].number(), tuple(columns["view"].texts()), coefficients)

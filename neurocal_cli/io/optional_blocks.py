"""Blocks that not every calibration file has: verdict, rejected points, and the estimated target."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bends import Bends
from neurocal_cli.calibration import Rejected, Verdict
from neurocal_cli.io.files import value_failures
from neurocal_cli.io.text_columns import named_lines, numbers_of, read_named, read_table, table_lines
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import boolean, indented, mapping, number, quoted, text
from neurocal_cli.points import Correspondences
from neurocal_cli.target import Target

_REJECTED = ("X", "Y", "Z", "u", "v", "error_px")
_TARGET = ("X", "Y", "Z", "X_given", "Y_given", "Z_given", "sX", "sY", "sZ")
_STATED = ("sX_stated", "sY_stated", "sZ_stated")
_SHAPES = ("bowl", "saddle", "twist")


def verdict_lines(verdict: Verdict | None) -> Iterator[str]:
    """Lines of the block ``verdict``; none if there is no verdict."""
    if verdict is None:
        return
    yield "verdict:"
    yield f"  word: {text(verdict.word)}"
    yield f"  reasons: [{', '.join(map(quoted, verdict.reasons))}]"
    yield f"  advice: [{', '.join(map(quoted, verdict.advice))}]"
    yield f"  measures: {mapping(**{name: number(value) for name, value in verdict.measures.items()})}"


def read_verdict(field: Field) -> Verdict:
    """Read the block ``verdict`` back."""
    return Verdict(
        field["word"].text(),
        tuple(field["reasons"].texts()),
        tuple(field["advice"].texts()),
        {name: measure.number_or_nan() for name, measure in field["measures"].entries().items()},
    )


def rejected_lines(rejected: Rejected, long: bool) -> Iterator[str]:
    """Lines of the block ``rejected``; none if nothing was rejected."""
    if not len(rejected) and not rejected.views:
        return
    yield "rejected:"
    yield from indented(named_lines("views", rejected.views, map(quoted, rejected.views.values())))
    points = rejected.points
    if points is None:
        yield from ("  columns: []", "  rows: []")
        return
    columns: dict[str, NDArray[Any] | list[str]] = {}
    if points.lines is not None:
        columns["line"] = points.lines
    columns["view"] = [points.view_names[k] for k in points.view_index.tolist()]
    if points.point is not None:
        columns["point"] = [str(label) for label in points.point]
    numbers = np.column_stack([points.world, points.pixels, rejected.error_px])
    columns |= {name: numbers[:, k] for k, name in enumerate(_REJECTED)}
    yield from indented(table_lines(columns, long))


def read_rejected(field: Field, unit: str) -> Rejected:
    """Read the block ``rejected`` back."""
    if field.value is None:
        return Rejected()
    views = {name: entry.text() for name, entry in read_named(field["views"]).items()}
    columns = read_table(field, frozenset(("view", "point")))
    if not columns:
        return Rejected(views=views)
    if set(columns) - {"line", "point"} != {"view", *_REJECTED}:
        field.fail(f"a table with view, {', '.join(_REJECTED)}")
    numbers = numbers_of(columns, _REJECTED, unknown=True)
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


def target_lines(target: Target | None, long: bool) -> Iterator[str]:
    """Lines of the block ``target``; none if the target was used as given."""
    if target is None:
        return
    yield "target:"
    yield f"  flat: {boolean(target.flat)}"
    yield f"  evidence: {number(target.evidence)}"
    yield f"  sizes: {mapping(**{name: number(size) for name, size in target.sizes.items()})}"
    columns: dict[str, NDArray[Any] | list[str]] = {}
    if target.point is not None:
        columns["point"] = [str(label) for label in target.point]
    columns["plane"] = target.plane
    numbers = np.hstack([target.found, target.given, target.std])
    columns |= {name: numbers[:, k] for k, name in enumerate(_TARGET)}
    if target.stated is not None:
        columns |= {name: target.stated[:, k] for k, name in enumerate(_STATED)}
    yield from indented(table_lines(columns, long, indent=2))
    if target.bends is not None:
        yield "  bends:  # of each view, from the points above"
        yield f"    size: {number(target.bends.size)}"
        shapes = dict(zip(_SHAPES, target.bends.coefficients.T, strict=True))
        yield from indented(table_lines({"view": list(target.bends.names), **shapes}, long, indent=2), 4)


def read_target(field: Field) -> Target:
    """Read the block ``target`` back."""
    columns = read_table(field, frozenset(("point",)))
    stated = _STATED if set(_STATED) <= set(columns) else ()
    if set(columns) - {"point", *stated} != {"plane", *_TARGET}:
        field.fail(f"a table with plane, {', '.join(_TARGET)}")
    numbers = numbers_of(columns, _TARGET).T
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

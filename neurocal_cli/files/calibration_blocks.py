"""Blocks of a calibration file: the poses of views, the verdict, rejected points, and the estimated target.

The views have an entry each, or columns in a long file.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Rejected, Verdict, ViewResult
from neurocal_cli.camera.geometry import Array, euler_to_rotation, rotation_to_euler
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import value_failures
from neurocal_cli.files.key_tables import (
    Keys,
    as_fields,
    column_lines,
    named_lines,
    numbers_of,
    read_columns,
    read_named,
    read_table,
    record,
    table_lines,
)
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import (
    block,
    flows,
    indented,
    number,
    quoted,
    text,
)
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Bends, Target

POSE_GROUPS = (("rotation", POSE_NAMES[:3]), ("translation", POSE_NAMES[3:]))
_R = [f"R{row}{col}" for row in (1, 2, 3) for col in (1, 2, 3)]

# The angles reproduce R except for the last bits; a larger difference means that one was edited.
_SAME = 1e-6

_REJECTED = ("X", "Y", "Z", "u", "v", "error_px")
_TARGET = ("X", "Y", "Z", "X_given", "Y_given", "Z_given", "sX", "sY", "sZ")
_STATED = ("sX_stated", "sY_stated", "sZ_stated")
_TARGET_KEYS = Keys("flat: boolean, evidence: number, sizes: measures")
_SHAPES = ("bowl", "saddle", "twist")


def have_same_std(views: Mapping[str, ViewResult]) -> bool:
    """Whether all views have standard deviations of the same parameters, so that they fit into columns."""
    return len({frozenset(view.std) for view in views.values()}) <= 1


def second_pose_lines(views: Mapping[str, ViewResult], K: Array) -> Iterator[str]:
    """Lines of the block ``second_poses``; none if there are none."""
    if views:
        yield from ["second_poses:", *list(view_lines(views, K, False))[1:]]


def view_lines(views: Mapping[str, ViewResult], K: Array, long: bool) -> Iterator[str]:
    """Lines of the block ``views``."""
    if not views:
        yield "views: []"
        return
    R, t = np.stack([v.pose.R for v in views.values()]), np.stack([v.pose.t for v in views.values()])
    pose = np.hstack([rotation_to_euler(R), t])
    error = np.array([view.rmse_px for view in views.values()], dtype=float)
    if long:
        known = [name for name in POSE_NAMES if all(name in view.std for view in views.values())]
        columns: dict[str, NDArray[Any] | list[str]] = {"name": list(views)}
        columns |= {name: pose[:, k] for k, name in enumerate(POSE_NAMES)}
        columns |= {f"std_{name}": np.array([view.std[name] for view in views.values()]) for name in known}
        columns["rmse_px"] = error
        columns["n_points"] = np.array([view.n_points for view in views.values()], dtype=int)
        columns["fixed"] = np.array([view.fixed for view in views.values()], dtype=int)
        if any(view.probability < 1 for view in views.values()):
            columns["probability"] = np.array([view.probability for view in views.values()])
        columns |= dict(zip(_R, R.reshape(-1, 9).T, strict=True))
        yield from block("views", column_lines(columns))
        return
    yield "views:"
    P = K @ np.concatenate([R, t[:, :, None]], axis=2)
    texts = _estimates(pose, views.values()), flows(P), flows(error), flows(R)
    for (name, view), entries, matrix, rmse, rotation in zip(views.items(), *texts, strict=True):
        yield f"  - name: {text(name)}"
        yield f"    rotation: {{{', '.join(entries[:3])}}}"
        yield f"    translation: {{{', '.join(entries[3:])}}}"
        yield f"    projection_matrix: {matrix}"
        yield f"    rmse_px: {rmse}"
        yield f"    n_points: {view.n_points}"
        yield f"    R: {rotation}"  # the angles do not reproduce the last bits
        if view.fixed:
            yield "    fixed: true"
        if view.probability < 1:
            yield f"    probability: {number(view.probability)}"


def _estimates(pose: Array, views: Collection[ViewResult]) -> Iterator[list[str]]:
    """Entries ``R_x: {value: ..., std: ...}`` of each view's pose; pose (V, 6)."""
    std = np.array([[view.std.get(name, np.nan) for name in POSE_NAMES] for view in views])
    for view, values, errors in zip(views, flows(pose), flows(std), strict=True):
        parts = zip(POSE_NAMES, values[1:-1].split(", "), errors[1:-1].split(", "), strict=True)
        yield [
            f"{name}: {{value: {value}, std: {error}}}" if name in view.std else f"{name}: {{value: {value}}}"
            for name, value, error in parts
        ]


def read_views(field: Field) -> dict[str, ViewResult]:
    """Read the block ``views`` in either form."""
    if isinstance(field.value, dict):
        return _from_columns(field)
    views: dict[str, ViewResult] = {}
    for entry in field.items():
        name = entry["name"].text()
        if name in views:
            entry["name"].fail("a name that no other view has")
        views[name] = _view(entry)
    return views


def _from_columns(field: Field) -> dict[str, ViewResult]:
    table = read_columns(field, frozenset(("name",)))
    columns = as_fields(table, field)
    known = [name for name in POSE_NAMES if f"std_{name}" in columns]
    for name in ("name", *POSE_NAMES, "rmse_px", "n_points", "fixed", *_R):
        field[name]  # raises an error that names the missing column
    if len(set(table["name"])) < len(table["name"]):
        field["name"].fail("names that differ")
    pose = numbers_of(columns, POSE_NAMES).T
    R = numbers_of(columns, _R).T.reshape(-1, 3, 3)
    std = numbers_of(columns, [f"std_{name}" for name in known], unknown=True).T
    probability = np.ones(len(pose))
    if "probability" in columns:
        probability = numbers_of(columns, ["probability"])[0]
    if np.abs(R - np.stack([euler_to_rotation(*angles) for angles in pose[:, :3]])).max() > _SAME:
        field.refuse(f"{field.path}: R11 to R33 and R_x, R_y, R_z disagree; correct those edited")
    return {
        name: ViewResult(
            pose=Pose(R[k], pose[k, 3:]),
            std=dict(zip(known, std[k].tolist(), strict=True)) if known else {},
            n_points=Field(table["n_points"][k], field.source, f"{field.path}.n_points").integer(),
            rmse_px=Field(table["rmse_px"][k], field.source, f"{field.path}.rmse_px").number_or_nan(),
            fixed=bool(table["fixed"][k]),
            probability=float(probability[k]),
        )
        for k, name in enumerate(table["name"])
    }


def _view(entry: Field) -> ViewResult:
    values: list[float] = []
    std: dict[str, float] = {}
    for group, names in POSE_GROUPS:
        for name in names:
            estimate = entry[group][name]
            values.append(estimate["value"].number())
            if "std" in estimate.value:
                std[name] = estimate["std"].number_or_nan()
    R = euler_to_rotation(*values[:3])
    if "R" in entry:
        exact = entry["R"].array(3, 3)
        if np.abs(exact - R).max() > _SAME:
            entry.refuse(f"{entry.path}: R and rotation disagree; correct the one edited")
        R = exact
    return ViewResult(
        pose=Pose(R, np.array(values[3:])),
        std=std,
        n_points=entry.get("n_points", 0).integer(),
        rmse_px=entry["rmse_px"].number_or_nan(),
        fixed=entry.get("fixed", False).boolean(),
        probability=entry.get("probability", 1.0).number(),
    )


VERDICT = record(Verdict, Keys("word: text, reasons: sentences, advice: sentences, measures: measures"))


def verdict_lines(verdict: Verdict | None) -> Iterable[str]:
    """Lines of the block ``verdict``; none if there is no verdict."""
    return [] if verdict is None else VERDICT.lines("verdict", verdict, False)


def rejected_lines(rejected: Rejected, long: bool) -> Iterator[str]:
    """Lines of the block ``rejected``; none if nothing was rejected."""
    if not len(rejected) and not rejected.views:
        return
    reasons = map(quoted, rejected.views.values())
    yield "rejected:"
    yield from indented(named_lines("views", rejected.views, reasons))
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
    yield from indented(_TARGET_KEYS.lines(target))
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
        **_TARGET_KEYS.read(field),
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

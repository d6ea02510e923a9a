"""Blocks of a calibration file: the poses of views, the verdict, rejected points, and the estimated target.

The views have an entry each, or columns in a long file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from neurocal_cli.calibration.calibration import Rejected, Verdict, ViewResult
from neurocal_cli.camera.geometry import Array, euler_to_rotation, rotation_to_euler
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import value_failures
from neurocal_cli.files.key_tables import (
    Columns,
    Keys,
    column_lines,
    inline,
    named_lines,
    read_columns,
    read_named,
    record,
)
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, indented, mapping, number, quoted
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Bends, Target

POSE_GROUPS = (("rotation", POSE_NAMES[:3]), ("translation", POSE_NAMES[3:]))

# The angles reproduce R except for the last bits; a larger difference means that one was edited.
_SAME = 1e-6


def _stated(field: Field) -> tuple[float, float | None]:
    return field["value"].number(), field["std"].number_or_nan() if "std" in field.entries() else None


def _stated_text(pair: tuple[float, float | None]) -> str:
    value, std = number(pair[0]), pair[1]
    return mapping(value=value) if std is None else mapping(value=value, std=number(std))


_GROUPS = {
    group: record(
        dict,
        Keys(", ".join(f"{name}: stated" for name in names), {"stated": inline(_stated, _stated_text)}),
        inline=True,
    )
    for group, names in POSE_GROUPS
}
_VIEW = Keys(
    "name: text, rotation: rotation, translation: translation, projection_matrix?: shown, rmse_px: measure,"
    "n_points: integer, R: 3x3, fixed?: boolean, probability?: probability",
    {**_GROUPS, "probability": inline(Field.number, number, 1.0)},
)
_VIEWS = Columns(
    "name: label, euler=R_x R_y R_z: number, t=t_x t_y t_z: number,"
    + "".join(f"std_{name}?: measure," for name in POSE_NAMES)
    + "rmse_px: measure, n_points: integer, fixed: integer, probability?: number,"
    f"R={' '.join(f'R{row}{col}' for row in (1, 2, 3) for col in (1, 2, 3))}: number"
)
_REJECTED = Columns(
    "lines=line?: integer, view: label, point?: label, world=X Y Z: measure, pixels=u v: measure,"
    "error_px: measure"
)
_TARGET_KEYS = Keys("flat: boolean, evidence: number, sizes: measures")
_TARGET = Columns(
    "point?: label, plane: integer, found=X Y Z: number, given=X_given Y_given Z_given: number,"
    "std=sX sY sZ: number, stated=sX_stated sY_stated sZ_stated?: number"
)
_BENDS = Columns("names=view: label, coefficients=bowl saddle twist: number")
VERDICT = record(Verdict, Keys("word: text, reasons: sentences, advice: sentences, measures: measures"))


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
    euler = rotation_to_euler(R)
    keys = ("rmse_px", "n_points", "fixed", "probability")
    if long:
        each = list(views.values())
        table: dict[str, Any] = {key: [getattr(view, key) for view in each] for key in keys}
        if min(table["probability"]) == 1:
            del table["probability"]
        for name in POSE_NAMES:
            if all(name in view.std for view in each):
                table[f"std_{name}"] = [view.std[name] for view in each]
        table |= {"name": list(views), "euler": euler, "t": t, "R": R}
        yield from block("views", column_lines(_VIEWS.of(table)))
        return
    yield "views:"
    pose = np.hstack([euler, t]).tolist()
    for (name, view), values in zip(views.items(), pose, strict=True):
        stated = {key: (value, view.std.get(key)) for key, value in zip(POSE_NAMES, values, strict=True)}
        P = K @ view.pose.D
        own = {key: getattr(view, key) for key in keys} | {"name": name, "R": view.pose.R}
        own |= {"rotation": stated, "translation": stated, "projection_matrix": P}
        first, *rest = _VIEW.lines(own)
        yield f"  - {first}"
        yield from indented(rest, 4)


def read_views(field: Field) -> dict[str, ViewResult]:
    """Read the block ``views`` in either form."""
    views: dict[str, ViewResult] = {}
    if isinstance(field.value, dict):
        table = read_columns(field, _VIEWS.labels)
        for _, columns, optional, _ in _VIEWS.groups:
            for name in columns:
                if not optional:
                    field[name]  # raises an error that names the missing column
        if len(set(table["name"])) < len(table["name"]):
            field["name"].fail("names that differ")
        found = _VIEWS.values(table, field)
        std = {name: found.pop(f"std_{name}") for name in POSE_NAMES}
        std = {name: values.tolist() for name, values in std.items() if values is not None}
        probability = found.pop("probability")
        names = found.pop("name")
        found["probability"] = np.ones(len(names)) if probability is None else probability
        found = {key: list(values) for key, values in found.items()}
        for k, name in enumerate(names):
            own = {key: values[k] for key, values in found.items()}
            R, stds = np.reshape(own.pop("R"), (3, 3)), {key: values[k] for key, values in std.items()}
            views[name] = _view(own.pop("euler"), R, own.pop("t"), stds, own, field)
        return views
    for entry in field.items():
        own = _VIEW.read(entry)
        name = own.pop("name")
        if name in views:
            entry["name"].fail("a name that no other view has")
        stated = {**own.pop("rotation"), **own.pop("translation")}
        del own["projection_matrix"]
        values = np.array([value for value, _ in stated.values()])
        stds = {key: std for key, (_, std) in stated.items() if std is not None}
        views[name] = _view(values[:3], own.pop("R"), values[3:], stds, own, entry)
    return views


def _view(
    euler: Array, R: Array, t: Array, std: dict[str, float], rest: dict[str, Any], field: Field
) -> ViewResult:
    if np.abs(R - euler_to_rotation(*euler)).max() > _SAME:
        both = "R and rotation" if "R" in field else "R11 to R33 and R_x, R_y, R_z"
        field.refuse(f"{field.path}: {both} disagree; correct those edited")
    return ViewResult(
        Pose(R, t),
        std,
        int(rest["n_points"]),
        float(rest["rmse_px"]),
        bool(rest["fixed"]),
        float(rest["probability"]),
    )


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
    names = ("lines", "point", "world", "pixels")
    table = {name: getattr(points, name) for name in names} | {"error_px": rejected.error_px}
    table["view"] = [points.view_names[k] for k in points.view_index.tolist()]
    yield from indented(_REJECTED.lines(table, long, indent=4))


def read_rejected(field: Field, unit: str) -> Rejected:
    """Read the block ``rejected`` back."""
    if field.value is None:
        return Rejected()
    views = {name: entry.text() for name, entry in read_named(field["views"]).items()}
    found = _REJECTED.read(field)
    if found is None:
        return Rejected(views=views)
    error = found.pop("error_px")
    with value_failures(""):
        return Rejected(Correspondences(**found, unit=unit, source=field.source), error, views)


def target_lines(target: Target | None, long: bool) -> Iterator[str]:
    """Lines of the block ``target``; none if the target was used as given."""
    if target is None:
        return
    yield "target:"
    yield from indented(_TARGET_KEYS.lines(target))
    yield from indented(_TARGET.lines(target, long))
    if target.bends is not None:
        yield "  bends:  # of each view, from the points above"
        yield f"    size: {number(target.bends.size)}"
        yield from indented(_BENDS.lines(target.bends, long), 4)


def read_target(field: Field) -> Target:
    """Read the block ``target`` back."""
    found = _TARGET.read(field)
    if found is None:
        field.fail("a table of points")
    point = found.pop("point")
    return Target(
        **found,
        **_TARGET_KEYS.read(field),
        point=None if point is None else np.array(point),
        bends=field.read("bends", _read_bends),
    )


def _read_bends(field: Field) -> Bends:
    found = _BENDS.read(field) or {"names": (), "coefficients": np.zeros((0, 3))}
    return Bends(field["size"].number(), tuple(found["names"]), found["coefficients"])

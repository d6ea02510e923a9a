"""The poses of views, as a block of a calibration file: an entry per view, or columns in a long file."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import ViewResult
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.geometry import Array, euler_to_rotation, rotation_to_euler
from neurocal_cli.io.text_columns import as_fields, column_lines, numbers_of, read_columns
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import block, flows, text

POSE_GROUPS = (("rotation", POSE_NAMES[:3]), ("translation", POSE_NAMES[3:]))
_NAME = "name"
_R = [f"R{row}{col}" for row in (1, 2, 3) for col in (1, 2, 3)]

# The angles reproduce R except for the last bits; a larger difference means that one was edited.
_SAME = 1e-6


def have_same_std(views: Mapping[str, ViewResult]) -> bool:
    """Whether all views have standard deviations of the same parameters, so that they fit into columns."""
    return len({frozenset(view.std) for view in views.values()}) <= 1


def view_lines(views: Mapping[str, ViewResult], K: Array, long: bool) -> Iterator[str]:
    """Lines of the block ``views``."""
    if not views:
        yield "views: []"
        return
    R, t = np.stack([v.pose.R for v in views.values()]), np.stack([v.pose.t for v in views.values()])
    pose = np.hstack([rotation_to_euler(R), t])
    error = np.array([view.rmse_px for view in views.values()], dtype=float)
    if long:
        yield from block("views", column_lines(_columns(views, pose, error, R)))
        return
    yield "views:"
    P = K @ np.concatenate([R, t[:, :, None]], axis=2)
    columns = _estimates(pose, views.values()), flows(P), flows(error), flows(R)
    for (name, view), entries, matrix, rmse, rotation in zip(views.items(), *columns, strict=True):
        yield f"  - name: {text(name)}"
        yield f"    rotation: {{{', '.join(entries[:3])}}}"
        yield f"    translation: {{{', '.join(entries[3:])}}}"
        yield f"    projection_matrix: {matrix}"
        yield f"    rmse_px: {rmse}"
        yield f"    n_points: {view.n_points}"
        yield f"    R: {rotation}"  # the angles do not reproduce the last bits
        if view.fixed:
            yield "    fixed: true"


def _columns(
    views: Mapping[str, ViewResult], pose: Array, error: Array, R: Array
) -> dict[str, NDArray[np.generic] | Sequence[str]]:
    known = [name for name in POSE_NAMES if all(name in view.std for view in views.values())]
    columns: dict[str, NDArray[np.generic] | Sequence[str]] = {_NAME: list(views)}
    columns |= {name: pose[:, k] for k, name in enumerate(POSE_NAMES)}
    columns |= {f"std_{name}": np.array([view.std[name] for view in views.values()]) for name in known}
    columns["rmse_px"] = error
    columns["n_points"] = np.array([view.n_points for view in views.values()], dtype=int)
    columns["fixed"] = np.array([view.fixed for view in views.values()], dtype=int)
    return columns | dict(zip(_R, R.reshape(-1, 9).T, strict=True))


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
    table = read_columns(field, frozenset((_NAME,)))
    columns = as_fields(table, field)
    known = [name for name in POSE_NAMES if f"std_{name}" in columns]
    for name in (_NAME, *POSE_NAMES, "rmse_px", "n_points", "fixed", *_R):
        field[name]  # raises an error that names the missing column
    if len(set(table[_NAME])) < len(table[_NAME]):
        field[_NAME].fail("names that differ")
    pose = numbers_of(columns, POSE_NAMES).T
    R = numbers_of(columns, _R).T.reshape(-1, 3, 3)
    std = numbers_of(columns, [f"std_{name}" for name in known], unknown=True).T
    if np.abs(R - np.stack([euler_to_rotation(*angles) for angles in pose[:, :3]])).max() > _SAME:
        field.refuse(f"{field.path}: R11 to R33 and R_x, R_y, R_z disagree; correct those edited")
    return {
        name: ViewResult(
            pose=Pose(R[k], pose[k, 3:]),
            std=dict(zip(known, std[k].tolist(), strict=True)) if known else {},
            n_points=Field(table["n_points"][k], field.source, f"{field.path}.n_points").integer(),
            rmse_px=Field(table["rmse_px"][k], field.source, f"{field.path}.rmse_px").number_or_nan(),
            fixed=bool(table["fixed"][k]),
        )
        for k, name in enumerate(table[_NAME])
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
        n_points=entry["n_points"].integer() if "n_points" in entry else 0,
        rmse_px=entry["rmse_px"].number_or_nan(),
        fixed="fixed" in entry and entry["fixed"].boolean(),
    )

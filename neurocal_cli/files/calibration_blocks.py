"""Blocks of a calibration file: poses of views, the verdict, the points and those rejected, and the target.

The views and the points have an entry each. In a long file the views are columns, and the points have each
place of the target once, and a row for each view, whose numbers are texts: decimals, or packed if PyYAML
would take too long to parse the decimals.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Rejected, Verdict, ViewResult
from neurocal_cli.camera.geometry import Array, euler_to_rotation, rotation_to_euler
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import value_failures
from neurocal_cli.files.key_tables import (
    LONGEST,
    Columns,
    Keys,
    Kind,
    column_lines,
    inline,
    join_ranges,
    named_lines,
    number_words,
    packed_text,
    read_columns,
    read_named,
    read_numbers,
    read_packed,
    read_ranges,
    record,
)
from neurocal_cli.files.points_csv import OPTIONAL, PIXEL, PLACE, value_columns
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, indented, number, quoted
from neurocal_cli.observations.distances import Distance
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Bends, Target

POSE_GROUPS = (("rotation", POSE_NAMES[:3]), ("translation", POSE_NAMES[3:]))

# The angles reproduce R except for the last bits; a larger difference means that one was edited.
_SAME = 1e-6


_GROUPS = {
    group: record(dict, Keys(", ".join(f"{name}: stated" for name in names)), inline=True)
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


def view_lines(key: str, pair: tuple[Mapping[str, ViewResult], Array], long: bool) -> Iterator[str]:
    """Lines of a block of views, from these and the camera matrix."""
    views, K = pair
    if not views:
        yield f"{key}: []"
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
        yield from block(key, column_lines(_VIEWS.of(table)))
        return
    yield f"{key}:"
    pose = np.hstack([euler, t]).tolist()
    for (name, view), values in zip(views.items(), pose, strict=True):
        stated = {
            one: (value, view.std.get(one), False) for one, value in zip(POSE_NAMES, values, strict=True)
        }
        P = K @ view.pose.D
        own = {key: getattr(view, key) for key in keys} | {"name": name, "R": view.pose.R}
        own |= {"rotation": stated, "translation": stated, "projection_matrix": P}
        first, *rest = _VIEW.lines(own)
        yield f"  - {first}"
        yield from indented(rest, 4)


def read_views(field: Field) -> dict[str, ViewResult]:
    """Read a block of views in either form."""
    views: dict[str, ViewResult] = {}
    parts = _long_views(field) if isinstance(field.value, dict) else map(_short_view, field.items())
    for place, name, euler, R, t, own in parts:
        if name in views:
            place["name"].fail("a name that no other view has" if "R" in place else "names that differ")
        if np.abs(R - euler_to_rotation(*euler)).max() > _SAME:
            both = "R and rotation" if "R" in place else "R11 to R33 and R_x, R_y, R_z"
            place.refuse(f"{place.path}: {both} disagree; correct those edited")
        views[name] = ViewResult(Pose(R, t), **own)
    return views


# A field for messages, the name, angles, R and t of a view, and its other values.
_Parts = tuple[Field, str, Array, Array, Array, dict[str, Any]]


def _short_view(entry: Field) -> _Parts:
    own = _VIEW.read(entry)
    stated = {**own.pop("rotation"), **own.pop("translation")}
    values = np.array([value for value, *_ in stated.values()])
    own["std"] = {key: std for key, (_, std, _) in stated.items() if std is not None}
    return entry, own.pop("name"), values[:3], own.pop("R"), values[3:], own


def _long_views(field: Field) -> Iterator[_Parts]:
    table = read_columns(field, _VIEWS.labels)
    for _, columns, optional, _ in _VIEWS.groups:
        for name in columns:
            if not optional:
                field[name]  # raises an error that names the missing column
    found = _VIEWS.values(table, field)
    names, R = found.pop("name"), found.pop("R").reshape(-1, 3, 3)
    place = zip(names, found.pop("euler"), R, found.pop("t"), strict=True)
    known = {name: std.tolist() for name in POSE_NAMES if (std := found.pop(f"std_{name}")) is not None}
    probability = found.pop("probability")
    found["fixed"] = found["fixed"].astype(bool)
    found["probability"] = np.ones(len(names)) if probability is None else probability
    rest = {key: values.tolist() for key, values in found.items()}
    for k, (name, *pose) in enumerate(place):
        own = {key: values[k] for key, values in rest.items()}
        yield field, name, *pose, own | {"std": {key: std[k] for key, std in known.items()}}


def rejected_lines(rejected: Rejected, long: bool) -> Iterator[str]:
    """Lines of the block ``rejected``."""
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
    views = {name: entry.text() for name, entry in read_named(field["views"]).items()}
    found = _REJECTED.read(field)
    if found is None:
        return Rejected(views=views)
    error = found.pop("error_px")
    with value_failures(""):
        return Rejected(Correspondences(**found, unit=unit, source=field.source), error, views)


def target_lines(target: Target, long: bool) -> Iterator[str]:
    """Lines of the block ``target``."""
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


def _distance(field: Field) -> Distance:
    cells = list(field.items())
    if len(cells) != 4:
        field.fail("a list of from, to, length, std")
    start, end, length, std = cells
    return Distance(start.text(), end.text(), length.number(), std.number())


def _distance_lines(key: str, distances: Iterable[Distance], long: bool) -> Iterator[str]:
    yield f"{key}:  # from, to, length, std"
    for one in distances:
        yield f"  - [{quoted(one.start)}, {quoted(one.end)}, {number(one.length)}, {number(one.std)}]"


_OF_POINTS = Keys(
    "undistorted?: text, board?: quoted, distances?: distances",
    {"distances": Kind(lambda field: tuple(map(_distance, field.items())), _distance_lines, ())},
)
_POINTS = Columns(
    f"view?: label, point?: label, world={' '.join(PLACE)}: number, pixels={' '.join(PIXEL)}: number, "
    + ", ".join(f"{attribute}={' '.join(names)}?: number" for attribute, names in OPTIONAL.items())
)
_MOST_CHARACTERS = 1_500_000  # of decimals; PyYAML parses them in half a second


def observation_lines(points: Correspondences, long: bool) -> list[str]:
    """Lines of the block ``observations``."""
    table = {name: getattr(points, name) for name in ("point", "world", "pixels", *OPTIONAL)}
    table["view"] = [points.view_names[k] for k in points.view_index.tolist()]
    lines = _POINTS.lines(table, long=False)
    head = [next(lines), *_OF_POINTS.lines(points)]
    return block("observations", [*head, *(_long_lines(points) if long and len(points) else lines)])


def _long_lines(points: Correspondences) -> Iterator[str]:
    values = np.hstack(value_columns(points)[1])
    place, first = _places(points)
    labels = {} if points.point is None else {"point": np.asarray(points.point)[first].astype(str).tolist()}
    coordinates = {name: points.world[first, k] for k, name in enumerate(PLACE)}
    yield "places:  # each place of the target once; its columns"
    yield from indented(column_lines({**labels, **coordinates}))
    words = [number_words(column) for column in values.T]
    characters = sum(len(word) + 1 for column in words for word in column)
    packed = characters > _MOST_CHARACTERS
    if packed:
        yield "numbers: packed"
    yield "views:  # name, its points among the places, and a text for each of the columns that follow Z"
    if packed:
        yield "  # np.frombuffer(text.encode('utf-32-le'), '<u4').astype('<u2').view('<f8')"
    starts = np.flatnonzero(np.diff(points.view_index, prepend=-1))
    for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(points)], strict=True):
        name = quoted(points.view_names[points.view_index[start]])
        for k in range(start, end, LONGEST):
            rows = slice(k, min(k + LONGEST, end))
            if packed:
                texts = [packed_text(column) for column in values[rows].T]
            else:
                texts = [f"'{','.join(column[rows])}'" for column in words]
            yield f"    - [{name}, {', '.join([repr(join_ranges(place[rows])), *texts])}]"


def _places(points: Correspondences) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of each row's place among the distinct places, and the first row of each place."""
    bits = np.ascontiguousarray(points.world).view(np.dtype((np.void, 24))).ravel().tolist()
    keys = bits if points.point is None else list(zip(bits, np.asarray(points.point).tolist(), strict=True))
    number: dict[Any, int] = {}
    place = np.array([number.setdefault(key, len(number)) for key in keys], dtype=np.int64)
    return place, np.unique(place, return_index=True)[1]


def read_observations(
    observations: Field,
    unit: str,
    image_size: tuple[int, int] | None,
    image_center: tuple[float, float] | None,
    none: bool,
) -> Correspondences:
    """Read the block ``observations`` in either form; it may be empty if `none`."""
    if "places" in observations:
        columns = _long_columns(observations)
        found = _POINTS.values(columns, observations["views"]) if columns else None
    else:
        found = _POINTS.read(observations)
    if none and not found:  # a camera from a zoom lens
        return Correspondences.none(image_size, unit)
    if not found:
        observations["rows"].fail("at least one row")

    with value_failures(""):
        return Correspondences(
            **found,
            **_OF_POINTS.read(observations),
            image_size=image_size,
            image_center=image_center,
            unit=unit,
            source=observations.source,
        )


def _long_columns(observations: Field) -> dict[str, list[Any]]:
    names = _POINTS.listed(observations["columns"])
    places = read_columns(observations["places"], frozenset(("point",)))
    measured = [name for name in names if name not in places and name != "view"]
    packed = "numbers" in observations
    if packed and observations["numbers"].text() != "packed":
        observations["numbers"].fail("packed, or not there")
    if set(places) - {"point"} != set(PLACE) or "view" not in names:
        observations["places"].fail("the columns X, Y, Z and point, if the points have names")
    columns: dict[str, list[Any]] = {name: [] for name in names}
    for entry in observations["views"].items():
        view, where, *texts = entry.items() if len(entry.value) == len(measured) + 2 else [entry] * 2
        if len(texts) != len(measured):
            entry.fail(f"a list of {len(measured) + 2} texts")
        rows = read_ranges(where, len(places["X"]))
        columns["view"] += [view.text()] * len(rows)
        for name, all_of in places.items():
            columns[name] += [all_of[row] for row in rows]
        for name, numbers in zip(measured, texts, strict=True):
            values = read_packed(numbers) if packed else read_numbers([numbers])
            if len(values) != len(rows):
                numbers.fail(f"{len(rows)} numbers")
            columns[name] += values
    return columns if columns["view"] else {}

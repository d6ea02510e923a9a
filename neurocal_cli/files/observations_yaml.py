"""The points of a calibration, as a block of its file.

The block has a row for each point. In a long file it has each place of the target once, and a row for each
view, whose numbers are texts: decimals, or packed if PyYAML would take too long to parse the decimals.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import value_failures
from neurocal_cli.files.key_tables import (
    LONGEST,
    Columns,
    Keys,
    Kind,
    column_lines,
    inline,
    join_ranges,
    number_words,
    packed_text,
    read_columns,
    read_numbers,
    read_packed,
    read_ranges,
)
from neurocal_cli.files.points_csv import OPTIONAL, PIXEL, PLACE, value_columns
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import block, indented, number, quoted
from neurocal_cli.observations.distances import Distance
from neurocal_cli.observations.points import Correspondences


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


_HEAD = Keys(
    "undistorted?: text, board?: quoted, distances?: distances",
    {
        "quoted": inline(Field.text, quoted, ""),
        "distances": Kind(lambda field: tuple(map(_distance, field.items())), _distance_lines, ()),
    },
)
_COLUMNS = Columns(
    f"view?: label, point?: label, world={' '.join(PLACE)}: number, pixels={' '.join(PIXEL)}: number, "
    + ", ".join(f"{attribute}={' '.join(names)}?: number" for attribute, names in OPTIONAL.items())
)
_MOST_CHARACTERS = 1_500_000  # of decimals; PyYAML parses them in half a second


def observation_lines(points: Correspondences, long: bool) -> list[str]:
    """Lines of the block ``observations``."""
    table = {name: getattr(points, name) for name in ("point", "world", "pixels", *OPTIONAL)}
    table["view"] = [points.view_names[k] for k in points.view_index.tolist()]
    lines = _COLUMNS.lines(table, long=False)
    head = [next(lines), *_HEAD.lines(points)]
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
        found = _COLUMNS.values(columns, observations["views"]) if columns else None
    else:
        found = _COLUMNS.read(observations)
    if none and not found:  # a camera from a zoom lens
        return Correspondences.none(image_size, unit)
    if not found:
        observations["rows"].fail("at least one row")

    with value_failures(""):
        return Correspondences(
            **found,
            **_HEAD.read(observations),
            image_size=image_size,
            image_center=image_center,
            unit=unit,
            source=observations.source,
        )


def _long_columns(observations: Field) -> dict[str, list[Any]]:
    names = _COLUMNS.listed(observations["columns"])
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

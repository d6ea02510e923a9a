"""The kinds of boards: their keys in files, and their short forms on the command line.

A board in short is ``kind:COLSxROWS:LENGTH...``, with lengths that are called as the keys. calib.io's
generator of patterns says as much in the name of a file, ``calib.io_KIND_SHEET_ROWSxCOLS_LENGTH...``, in mm.
"""

from __future__ import annotations

import os
import re
from typing import Any

from neurocal_cli.errors import FormatError, InputError, UsageError
from neurocal_cli.files.key_tables import Keys, inline
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import boolean, text
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane
from neurocal_cli.observations.markers import Markers


def _counts(field: Field) -> tuple[int, int]:
    counts = [one.integer(1) for one in field.items()]
    if len(counts) != 2:
        field.fail("two whole numbers, [columns, rows]")
    return counts[0], counts[1]


def _legacy(field: Field) -> bool | None:
    if not (isinstance(field.value, bool) or field.value == "auto"):
        field.fail("auto, true or false")
    return None if field.value == "auto" else field.value


_VALUES = {
    "counts": inline(_counts, lambda size: f"[{size[0]}, {size[1]}]"),
    "side": inline(lambda field: field.integer(2), str),
    "id": inline(Field.integer, str, 0),
    "legacy": inline(_legacy, lambda legacy: "auto" if legacy is None else boolean(legacy)),
    "family": inline(Field.text, text, "tag36h11"),
    "thick": inline(lambda field: field.integer(1), str, 2),
    "thin": inline(lambda field: field.integer(1), str, 1),
}
# Keys of each kind by the arguments of `plane_of`, which is called with the size as one counts it.
_OF_CIRCLES = "circles=size: counts, distance=square: number, diameter?: number"
KINDS = {
    kind: Keys(table, _VALUES)
    for kind, table in {
        "chessboard": "cols: side, rows: side, square: number",
        "charuco": "squares=size: counts, square: number, marker: number, dictionary?: text,"
        "legacy!: legacy, first_id!: id, inverted?: boolean",
        "aprilgrid": "tags=size: counts, tag=square: number, spacing: number, family=dictionary!: family,"
        "first_id!: id, border!: thick, inverted?: boolean",
        "arucogrid": "markers=size: counts, marker=square: number, spacing: number, dictionary: text,"
        "first_id!: id, border?: thin, inverted?: boolean",
        "circles": _OF_CIRCLES,
        "asymmetric_circles": _OF_CIRCLES,
    }.items()
}
COUNTED = Keys("squares=size: counts, square: number", _VALUES)  # of a chessboard whose squares are counted
# Keys that follow the size in short forms.
_SHORT = {
    "chessboard": "square",
    "charuco": "square marker dictionary?",
    "aprilgrid": "tag spacing family?",
    "arucogrid": "marker spacing dictionary",
    "circles": "distance diameter?",
    "asymmetric_circles": "distance diameter?",
}
_CALIB_IO = re.compile(r"calib\.io_(checker|charuco|circles)_[^_]+_(\d+)x(\d+)_(.+)\.\w+", re.IGNORECASE)


def short_form(kind: str) -> str:
    """A kind in short, such as ``charuco:COLSxROWS:SQUARE:MARKER[:DICTIONARY] (squares)``."""
    parts = [f"[:{word[:-1]}]" if word.endswith("?") else f":{word}" for word in _SHORT[kind].split()]
    counted = "inner vertices" if kind == "chessboard" else KINDS[kind].names[0]
    return f"{kind}:COLSxROWS{''.join(parts).upper()} ({counted})"


def kind_of(plane: Plane) -> str:
    """Name of a plane's kind in board files."""
    if isinstance(plane, TagPlane):
        return "arucogrid" if plane.downwards else "aprilgrid"
    if isinstance(plane, CirclePlane):
        return "asymmetric_circles" if plane.asymmetric else "circles"
    return "chessboard" if plane.markers is None else "charuco"


def plane_of(
    kind: str,
    size: tuple[int, int],
    square: float,
    *,
    marker: float = 0.0,
    dictionary: str = "",
    legacy: bool | None = None,
    first_id: int = 0,
    inverted: bool = False,
    spacing: float = 0.0,
    border: int = 2,
    diameter: float = 0.0,
    **place: Any,
) -> Plane:
    """A plane by the numbers of columns and rows of its squares, tags or circles, and the values of its keys.

    `place` are its name, origin and axes. An InputError begins with the name of the key that is out of range.
    """
    tags = kind in ("aprilgrid", "arucogrid")
    if tags:
        size, marker = (2 * size[0], 2 * size[1]), square
        dictionary = dictionary or ("tag36h11" if kind == "aprilgrid" else "")
    markers = Markers(marker, dictionary, legacy, first_id, inverted) if tags or kind == "charuco" else None
    if tags:
        return TagPlane(
            cols=size[0], rows=size[1], square=square, markers=markers, spacing=spacing, border=border,
            downwards=kind == "arucogrid", **place,
        )  # fmt: skip
    if kind in ("circles", "asymmetric_circles"):
        asymmetric = kind != "circles"
        return CirclePlane(
            cols=size[0], rows=size[1], square=square, diameter=diameter, asymmetric=asymmetric, **place
        )
    return Plane(cols=size[0] - 1, rows=size[1] - 1, square=square, markers=markers, **place)


def values_of(plane: Plane) -> dict[str, Any]:
    """The values of a plane by the attributes of `KINDS`."""
    names = ("cols", "rows", "square", "diameter", "spacing", "border")
    values: dict[str, Any] = {name: getattr(plane, name, None) for name in names}
    shift = 0 if isinstance(plane, CirclePlane) else 1
    values["size"] = plane.cols + shift, plane.rows + shift
    if (own := plane.markers) is not None:
        code = own.dictionary
        if isinstance(plane, TagPlane):
            values["size"] = plane.tags
            code = code if plane.downwards else code.replace("DICT_APRILTAG_", "tag")
        values |= {name: getattr(own, name) for name in ("legacy", "first_id", "inverted")}
        values |= {"marker": own.side, "dictionary": code}
    return values


def read_plane(field: Field, kind: str, **place: Any) -> Plane:
    """Read the plane of a kind from its keys; see `plane_of`."""
    table = COUNTED if kind == "chessboard" and "squares" in field else KINDS[kind]
    values = table.read(field)
    if "cols" in values:
        values["size"] = values.pop("cols") + 1, values.pop("rows") + 1
    return plane_of(kind, **values, **place)


def _of_calib_io(kind: str, rows: str, cols: str, rest: str) -> str:
    """The short form of what the name of a file says; a dictionary without its size is the largest."""
    lengths, _, dictionary = rest.upper().partition("_DICT_")
    words = lengths.split("_")[: 1 if kind == "checker" else 2]
    if kind.lower() == "checker":
        return f"chessboard:{int(cols) - 1}x{int(rows) - 1}:{words[0]}"
    if dictionary:
        words.append(f"{dictionary}_1000" if re.fullmatch(r"\dX\d", dictionary) else dictionary)
    return ":".join([kind.lower(), f"{cols}x{rows}", *words])


def short_board(form: str, unit: str = "mm") -> Board | None:
    """The board of a short form such as ``charuco:8x8:25.4:19.05``; None if the text is none.

    The name of a file of calib.io is one, too. Raises UsageError if it begins like one and is not.
    """
    if named := _CALIB_IO.fullmatch(os.path.basename(form)):
        return short_board(_of_calib_io(*named.groups()))
    kind, colon, rest = form.partition(":")
    if kind not in KINDS or not colon:
        return None
    size, *parts = rest.split(":")
    counts = re.fullmatch(r"(\d+)x(\d+)", size)
    words = _SHORT[kind].split()
    try:
        if counts is None or len(parts) > len(words):
            raise FormatError("the size is missing", "--board")
        both = [int(counts[1]), int(counts[2])]
        keys = {"cols": both[0], "rows": both[1]} if kind == "chessboard" else {KINDS[kind].names[0]: both}
        tree = {**keys, **{word.rstrip("?"): part for word, part in zip(words, parts, strict=False)}}
        return Board((read_plane(Field(tree, "--board"), kind, name=""),), unit)
    except FormatError as error:
        raise UsageError(f"--board {form[:60]}: give {short_form(kind)}") from error
    except InputError as error:
        raise UsageError(f"--board {form[:60]}: {error}") from error

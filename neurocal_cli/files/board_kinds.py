"""The kinds of boards in files and on the command line, each with its own keys, and Kalibr's target files.

On the command line a board is ``kind:COLSxROWS:LENGTH...``, with the lengths of `SHORT_FORMS`.
"""

from __future__ import annotations

import re
from typing import Any

from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import number, text
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane
from neurocal_cli.observations.markers import Markers

# Keys of each kind beside the name and the axes, those that are required first; `chessboard` has its own.
KIND_KEYS = {
    "chessboard": ("squares", "square", "cols", "rows"),
    "charuco": ("squares", "square", "marker", "dictionary", "legacy", "first_id", "inverted"),
    "aprilgrid": ("tags", "tag", "spacing", "family", "first_id", "border", "inverted"),
    "arucogrid": ("markers", "marker", "spacing", "dictionary", "first_id", "border", "inverted"),
    "circles": ("circles", "distance", "diameter"),
    "asymmetric_circles": ("circles", "distance", "diameter"),
}
SHORT_FORMS = {
    "chessboard": "chessboard:COLSxROWS:SQUARE (inner vertices)",
    "charuco": "charuco:COLSxROWS:SQUARE:MARKER[:DICTIONARY] (squares)",
    "aprilgrid": "aprilgrid:COLSxROWS:TAG:SPACING[:FAMILY] (tags)",
    "arucogrid": "arucogrid:COLSxROWS:MARKER:SPACING:DICTIONARY (markers)",
    "circles": "circles:COLSxROWS:DISTANCE[:DIAMETER]",
    "asymmetric_circles": "asymmetric_circles:COLSxROWS:DISTANCE[:DIAMETER]",
}


def kind_of(plane: Plane) -> str:
    """Name of a plane's kind in board files."""
    if isinstance(plane, TagPlane):
        return "arucogrid" if plane.downwards else "aprilgrid"
    if isinstance(plane, CirclePlane):
        return "asymmetric_circles" if plane.asymmetric else "circles"
    return "chessboard" if plane.markers is None else "charuco"


def read_plane(field: Field, kind: str, name: str, place: dict[str, Any]) -> Plane:
    """Read the plane of a kind from its keys; an InputError names the key that is out of range."""

    def pair(key: str) -> tuple[int, int]:
        counts = [one.integer(1) for one in field[key].items()]
        if len(counts) != 2:
            field[key].fail("two whole numbers, [columns, rows]")
        return counts[0], counts[1]

    if kind in ("aprilgrid", "arucogrid"):
        downwards = kind == "arucogrid"
        cols, rows = pair("markers" if downwards else "tags")
        tag = field["marker" if downwards else "tag"].number()
        family = (field["dictionary"] if downwards else field.get("family", "tag36h11")).text()
        first, inverted = field.get("first_id", 0).integer(0), field.get("inverted", False).boolean()
        markers = Markers(tag, family, None, first, inverted)
        spacing, border = field["spacing"].number(), field.get("border", 1 if downwards else 2).integer(1)
        return TagPlane(
            name, 2 * cols, 2 * rows, tag, markers=markers, spacing=spacing, border=border,
            downwards=downwards, **place,
        )  # fmt: skip
    if kind in ("circles", "asymmetric_circles"):
        cols, rows = pair("circles")
        distance, diameter = field["distance"].number(), field.get("diameter", 0.0).number()
        return CirclePlane(
            name, cols, rows, distance, diameter=diameter, asymmetric=kind != "circles", **place
        )
    if kind == "chessboard" and "squares" not in field:
        cols, rows = field["cols"].integer(2), field["rows"].integer(2)
        return Plane(name, cols, rows, field["square"].number(), **place)
    cols, rows = pair("squares")
    found = None
    if kind == "charuco":
        legacy = field.get("legacy", "auto")
        if legacy.value not in ("auto", True, False):
            legacy.fail("auto, true or false")
        found = Markers(
            field["marker"].number(),
            field.get("dictionary", "").text() if "dictionary" in field else "",
            None if legacy.value == "auto" else legacy.value,
            field.get("first_id", 0).integer(0),
            field.get("inverted", False).boolean(),
        )
    return Plane(name, cols - 1, rows - 1, field["square"].number(), markers=found, **place)


def kind_entries(plane: Plane) -> dict[str, str]:
    """Keys of a plane's kind, for a file; nothing for a chessboard, whose keys are the file's own."""
    markers = plane.markers
    inverted = {"inverted": "true"} if markers is not None and markers.inverted else {}
    if isinstance(plane, TagPlane) and markers is not None and plane.downwards:
        return {
            "kind": "arucogrid",
            "markers": f"[{plane.tags[0]}, {plane.tags[1]}]",
            "marker": number(plane.square),
            "spacing": number(plane.spacing),
            "dictionary": text(markers.dictionary),
            "first_id": str(markers.first_id),
            **({} if plane.border == 1 else {"border": str(plane.border)}),
            **inverted,
        }
    if isinstance(plane, TagPlane) and markers is not None:
        family = markers.dictionary.removeprefix("DICT_APRILTAG_")
        known = f"tag{family}" if family != markers.dictionary else markers.dictionary
        return {
            "kind": "aprilgrid",
            "tags": f"[{plane.tags[0]}, {plane.tags[1]}]",
            "tag": number(plane.square),
            "spacing": number(plane.spacing),
            "family": text(known or "tag36h11"),
            "first_id": str(markers.first_id),
            "border": str(plane.border),
            **inverted,
        }
    if isinstance(plane, CirclePlane):
        entries = {
            "kind": kind_of(plane),
            "circles": f"[{plane.cols}, {plane.rows}]",
            "distance": number(plane.square),
        }
        return entries | ({"diameter": number(plane.diameter)} if plane.diameter else {})
    if markers is None:
        return {}
    legacy = "auto" if markers.legacy is None else str(markers.legacy).lower()
    return {
        "kind": "charuco",
        "squares": f"[{plane.cols + 1}, {plane.rows + 1}]",
        "square": number(plane.square),
        "marker": number(markers.side),
        **({"dictionary": text(markers.dictionary)} if markers.dictionary else {}),
        "legacy": legacy,
        "first_id": str(markers.first_id),
        **inverted,
    }


def short_board(form: str, unit: str = "mm") -> Board | None:
    """The board of a short form such as ``charuco:8x8:25.4:19.05``; None if the text is none.

    Raises UsageError if it begins like one and is not.
    """
    kind, colon, rest = form.partition(":")
    if kind not in SHORT_FORMS or not colon:
        return None
    size, *parts = rest.split(":")
    counts = re.fullmatch(r"(\d+)x(\d+)", size)
    wrong = UsageError(f"--board {form[:60]}: give {SHORT_FORMS[kind]}")
    if counts is None:
        raise wrong
    cols, rows = int(counts[1]), int(counts[2])
    words = {"charuco": 2, "aprilgrid": 2, "arucogrid": 2}.get(kind)
    code = parts.pop() if words is not None and len(parts) == words + 1 else ""
    if kind == "arucogrid" and not code:
        raise wrong
    try:
        lengths = [float(part) for part in parts]
    except ValueError:
        raise wrong from None
    if not (words or 1) <= len(lengths) <= (words or {"chessboard": 1}.get(kind, 2)):
        raise wrong
    try:
        if kind == "chessboard":
            return Board((Plane("", cols, rows, lengths[0]),), unit)
        if kind == "charuco":
            return Board(
                (Plane("", cols - 1, rows - 1, lengths[0], markers=Markers(lengths[1], code)),), unit
            )
        if kind == "aprilgrid":
            return Board((TagPlane.of((cols, rows), lengths[0], lengths[1], code or "tag36h11"),), unit)
        if kind == "arucogrid":
            side, spacing = lengths
            return Board((TagPlane.of((cols, rows), side, spacing, code, border=1, downwards=True),), unit)
        diameter = lengths[1] if len(lengths) > 1 else 0.0
        asymmetric = kind != "circles"
        plane = CirclePlane("", cols, rows, lengths[0], diameter=diameter, asymmetric=asymmetric)
    except InputError as error:
        raise UsageError(f"--board {form[:60]}: {error}") from error
    return Board((plane,), unit)


def is_kalibr(root: Field) -> bool:
    """Whether the tree is a target file of Kalibr."""
    return "target_type" in root


def kalibr_plane(root: Field) -> Plane:
    """Plane of Kalibr's aprilgrid, checkerboard or circlegrid; lengths are in metres."""
    kind = root["target_type"].text()
    if kind == "aprilgrid":
        tags = root["tagCols"].integer(1), root["tagRows"].integer(1)
        # Older files name the distance of two tags' sides, newer ones its ratio; both name it tagSpacing.
        first = root.get("codeOffset", 0).integer(0)
        return TagPlane.of(tags, root["tagSize"].number(), root["tagSpacing"].number(), first_id=first)
    cols, rows = (root[key].integer(2) for key in ("targetCols", "targetRows"))
    if kind == "circlegrid":
        asymmetric = bool(root.get("asymmetricGrid", False).value)
        return CirclePlane("", cols, rows, root["spacingMeters"].number(), asymmetric=asymmetric)
    if kind != "checkerboard":
        root["target_type"].fail("aprilgrid, checkerboard or circlegrid")
    down, along = root["rowSpacingMeters"].number(), root["colSpacingMeters"].number()
    if down != along:
        root.refuse(
            f"the squares are {along:g} x {down:g} m; neurocal describes boards of squares",
            "correct rowSpacingMeters and colSpacingMeters",
        )
    return Plane("", cols, rows, along)

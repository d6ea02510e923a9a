"""Board files: YAML of a target of one or several planes as users write it, and those of other programs.

A board of one plane may stand at the top of the file with its ``kind``, or in the list of planes. The files
of other programs are told by their keys: OpenCV's settings, those of PhotonVision and caliscope, and boards
that are described by the arguments of OpenCV's classes, as many scripts write them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli.errors import value_failures
from neurocal_cli.files.board_kinds import KIND_KEYS, is_kalibr, kalibr_plane, kind_entries, read_plane
from neurocal_cli.files.camera_tree import parse_tree
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import flow, mapping, number, parse_yaml, quoted, text
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane
from neurocal_cli.observations.distances import Distance
from neurocal_cli.observations.markers import Markers

# Numbers of OpenCV's predefined dictionaries, as scripts write them.
_DICTIONARIES = (
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11", "DICT_ARUCO_MIP_36h12",
)  # fmt: skip
# Names of the same thing, without capitals and underscores.
_COLS = ("squaresx", "squaresacross", "numsquaresx", "patternwidth", "boardwidth", "columns", "cols", "width")
_ROWS = ("squaresy", "squaresdown", "numsquaresy", "patternheight", "boardheight", "rows", "height")
_SQUARE = ("squarelength", "squaresize", "squaresizein", "squaresizemeters", "squaresizemm", "squarelengthmm",
           "checkerwidth", "checkersize", "checkerlength", "gridsize", "square")  # fmt: skip
_MARKER = ("markerlength", "markersize", "markersizein", "markersizemeters", "markersizemm", "markerlengthmm",
           "arucosize", "marker")  # fmt: skip
_DICTIONARY = ("dictionary", "dictionaryname", "arucodict", "arucodictname", "arucodictionary", "tagfamily",
               "markerdictionary", "dictionaryid", "dict")  # fmt: skip
_LEGACY = ("legacypattern", "useoldpattern", "legacy")
_SECTIONS = ("charuco", "Settings", "board", "target", "pattern", "startPnpCalibration", "startCalibration")


def other_board(root: Field) -> Board | None:
    """The board of a file of another program; None if the keys are those of none."""
    if "Settings" in root and "BoardSize_Width" in root["Settings"]:
        return _settings(root["Settings"])
    if "opencv_storage" in root:
        return other_board(root["opencv_storage"])
    known = _Keys(root)
    if known.find(("arucoscale",)) is not None:
        return _caliscope(known)
    if known.find(_MARKER) is not None or known.find(("boardtype",)) is not None:
        return _described(known)
    for name in _SECTIONS:
        if name in root and isinstance(root[name].value, dict):
            return other_board(root[name])
    return None


class _Keys:
    """Fields of a mapping by their names without capitals and underscores."""

    def __init__(self, root: Field) -> None:
        self.root = root
        entries = root.entries() if isinstance(root.value, dict) else {}
        self._by_name = {re.sub("[_ -]", "", name.lower()): field for name, field in entries.items()}

    def find(self, names: Iterable[str]) -> Field | None:
        """The first field that has one of the names."""
        return next((self._by_name[name] for name in names if name in self._by_name), None)

    def need(self, names: tuple[str, ...]) -> Field:
        """The same; a FormatError if there is none."""
        field = self.find(names)
        if field is None:
            self.root.refuse(
                f"a board of markers without {names[0]}", "describe the board by --board in short"
            )
        return field

    def name_of(self, field: Field) -> str:
        return next(name for name, one in self._by_name.items() if one is field)


def _settings(root: Field) -> Board:
    """OpenCV's sample camera_calibration: sizes count inner vertices, or circles."""
    kind = root["Calibrate_Pattern"].text()
    cols, rows = (root[f"BoardSize_{side}"].integer(2) for side in ("Width", "Height"))
    square = root["Square_Size"].number()
    if "CIRCLES" in kind:
        return Board((CirclePlane("", cols, rows, square, asymmetric="ASYMMETRIC" in kind),))
    if "CHARUCO" not in kind:
        return Board((Plane("", cols, rows, square),))
    name = _dictionary(root.get("ArUco_Dict_Name", ""))
    return Board((Plane("", cols, rows, square, markers=Markers(root["Marker_Size"].number(), name)),))


def _caliscope(known: _Keys) -> Board:
    """Caliscope's charuco.toml: the squares of a sheet, or of a measured side in cm."""
    cols, rows = known.need(("columns", "cols")).integer(3), known.need(("rows",)).integer(3)
    measured = known.find(("squaresizeoveridecm", "squaresizeoverridecm"))
    if measured is not None and measured.value not in (None, False, 0, ""):
        square, unit = measured.number(), "cm"
    else:
        width, height = (known.need((f"board{side}",)).number() for side in ("width", "height"))
        square = min(width / cols, height / rows)
        units = known.find(("units",))
        unit = "cm" if units is None else units.text()
    scale = known.need(("arucoscale",)).number()
    return Board((_charuco(known, (cols, rows), square, scale * square),), unit)


def _described(known: _Keys) -> Board | None:
    """A board by the arguments of OpenCV's classes, or as PhotonVision names them: squares are counted."""
    counts = tuple(known.need(names).integer(2) for names in (_COLS, _ROWS))
    size = counts[0], counts[1]
    side = known.need(_SQUARE)
    unit = _unit(known, side)
    kind = known.find(("boardtype", "type", "patterntype", "targettype"))
    word = "" if kind is None or not isinstance(kind.value, str) else kind.text().lower()
    number = kind.value if kind is not None and isinstance(kind.value, int) else None
    # PhotonVision's types are 0 for a chessboard and 1 for ChArUco.
    if number == 0 or (word and "charuco" not in word and ("chess" in word or "checker" in word)):
        return Board((Plane("", size[0] - 1, size[1] - 1, side.number()),), unit)
    if word and "charuco" not in word and "grid" in word:
        known.root.refuse(f"a board of the kind {word[:30]!r} is not read", "describe it by --board in short")
    marker = known.need(_MARKER)
    return Board((_charuco(known, size, side.number(), marker.number()),), unit)


def _unit(known: _Keys, side: Field) -> str:
    name = known.name_of(side)
    for ending, unit in (("meters", "m"), ("mm", "mm"), ("in", "inch")):
        if name.endswith(ending):
            return unit
    units = known.find(("unit", "units"))
    return "mm" if units is None else units.text()


def _charuco(known: _Keys, size: tuple[int, int], square: float, marker: float) -> Plane:
    legacy, first = known.find(_LEGACY), known.find(("firstid", "startid", "firstmarker", "idoffset"))
    inverted = known.find(("inverted",))
    markers = Markers(
        marker,
        _dictionary(known.find(_DICTIONARY)),
        None if legacy is None or legacy.value is None else legacy.boolean(),
        0 if first is None else first.integer(0),
        inverted is not None and inverted.boolean(),
    )
    return Plane("", size[0] - 1, size[1] - 1, square, markers=markers)


def _dictionary(field: Field | None) -> str:
    """Name of a dictionary that is given by name or by OpenCV's number; empty if it is not given."""
    if field is None or field.value in (None, ""):
        return ""
    if isinstance(field.value, int) and not isinstance(field.value, bool):
        number = field.integer(0)
        if number >= len(_DICTIONARIES):
            field.fail(f"a number of OpenCV's dictionaries, up to {len(_DICTIONARIES) - 1}")
        return _DICTIONARIES[number]
    return field.text()


_COUNTS = ("cols", "rows")
_VECTORS = ("origin", "x_axis", "y_axis")
_OWN_KEYS = ("name", *_VECTORS, "points", "kind")


def read_board(path: str | Path) -> Board:
    """Read a board.

    Parameters
    ----------
    path : str or Path
        A board file, or one of another program, in YAML, JSON, XML or TOML; ``-`` is stdin.

    Raises
    ------
    FormatError
        The file cannot be read or is not a board; the message names the file and the key.
    """
    content, source = read_text(path, "a board file")
    if str(path).lower().endswith(".toml"):
        from neurocal_cli.files.exchange.document import sections

        return _board(Field(sections(content, source), source))
    return _board(parse_tree(content, source))


def parse_board(content: str, source: str = "board") -> Board:
    """Read a board from the text of a file; see `read_board`."""
    return _board(Field(parse_yaml(content, source), source))


def write_board(board: Board, path: str | Path) -> None:
    """Write a board; `read_board` gives back the same numbers to the last bit."""
    write_whole(path, format_board(board))


def format_board(board: Board) -> str:
    """Text of a board file."""
    lines = [f"unit: {text(board.unit)}", "planes:"]
    for plane in board.planes:
        entries = _entries(plane)
        if not plane.measured:
            lines.append(f"  - {mapping(**entries)}")
            continue
        first, *others = [f"{key}: {value}" for key, value in entries.items()]
        rows = flow(np.array(plane.measured))[2:-2].split("], [")
        lines += [f"  - {first}", *(f"    {entry}" for entry in others)]
        lines += ["    points:  # column, row, X, Y, Z", *(f"      - [{row}]" for row in rows)]
    if board.distances:
        lines.append("distances:")
    for one in board.distances:
        ends = {"from": quoted(one.start), "to": quoted(one.end)}
        lines.append(f"  - {mapping(**ends, length=number(one.length), std=number(one.std))}")
    return "\n".join([*lines, ""])


def board_line(board: Board) -> str:
    """Text of a board file on one line, without measured points; empty for plain chessboards."""
    if not any(map(kind_entries, board.planes)):
        return ""
    planes = ", ".join(mapping(**_entries(plane)) for plane in board.planes)
    return mapping(unit=text(board.unit), planes=f"[{planes}]")


def _entries(plane: Plane) -> dict[str, str]:
    """Keys of a plane in a file, without its measured points."""
    counts = {key: str(getattr(plane, key)) for key in _COUNTS}
    return {
        **({"name": text(plane.name)} if plane.name else {}),
        **(kind_entries(plane) or {**counts, "square": number(plane.square)}),
        **{key: flow(np.array(getattr(plane, key))) for key in _VECTORS},
    }


def _board(root: Field) -> Board:
    if is_kalibr(root):
        with value_failures(root.source):
            return Board((kalibr_plane(root),), "m")
    if "kind" not in root and "planes" not in root:
        with value_failures(root.source):
            other = other_board(root)
        if other is not None:
            return other
    unit = root.get("unit", "mm").text()
    if "kind" in root:
        planes: tuple[Plane, ...] = (_plane(root, alone=True, more=("unit", "distances")),)
    else:
        _only(root, ("unit", "planes", "distances"))
        fields = list(root["planes"].items())
        if not fields:
            root["planes"].fail("a list of at least one plane")
        planes = tuple(_plane(field, alone=len(fields) == 1) for field in fields)
    with value_failures(root.source, "planes: "):
        board = Board(planes, unit)
    if "distances" not in root:
        return board
    distances = []
    for field in root["distances"].items():
        _only(field, ("from", "to", "length", "std"))
        start, end = (field[key].text() for key in ("from", "to"))
        with value_failures(field.source, f"{field.path}: "):
            distances.append(Distance(start, end, field["length"].number(), field["std"].number()))
            for label in (start, end):
                board.place(label)
    return replace(board, distances=tuple(distances))


def _plane(field: Field, *, alone: bool, more: tuple[str, ...] = ()) -> Plane:
    """Read a plane, which may have `more` keys; a single plane needs no name, origin and axes."""
    kind = field.get("kind", "chessboard").text()
    if kind not in KIND_KEYS:
        field["kind"].fail(f"one of {', '.join(KIND_KEYS)}")
    _only(field, (*_OWN_KEYS, *KIND_KEYS[kind], *more))
    place: dict[str, Any] = {
        key: tuple(field[key].array(3).tolist()) for key in _VECTORS if not alone or key in field
    }
    if "points" in field:
        place["measured"] = tuple(map(tuple, field["points"].array(-1, 5).tolist()))
    name = field["name"].text() if not alone or "name" in field else ""
    with value_failures(field.source, f"{field.path}." if field.path else ""):
        return read_plane(field, kind, name, place)


def _only(field: Field, known: tuple[str, ...]) -> None:
    """Refuse unknown keys; otherwise a misspelt axis would silently become the default axis."""
    for key in field.entries():
        if key not in known:
            where = f"{field.path}: " if field.path else ""
            field.refuse(f"{where}the key {key[:60]!r} is not known; use one of {', '.join(known)}")

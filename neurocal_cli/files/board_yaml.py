"""Board files: YAML of a target of one or several planes as users write it, and those of other programs.

A board of one plane may stand at the top of the file with its ``kind``, or in the list of planes.

In files of other programs, names are compared without capitals and marks. A file is told by a key; the word
under it may choose among kinds, whose keys are a text such as ``"cols=tagCols, first_id?=codeOffset"``: what
is said, and the names of the key, each perhaps with the unit that it tells. A file needs one of them unless
there is a question mark.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import value_failures
from neurocal_cli.files.board_kinds import COUNTED, KINDS, kind_of, plane_of, read_plane, values_of
from neurocal_cli.files.camera_tree import parse_tree
from neurocal_cli.files.key_tables import Keys
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field, plain
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import flow, indented, list_lines, mapping, parse_yaml, text
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.distances import Distance
from neurocal_cli.observations.markers import DICTIONARIES

_VECTORS = ("origin", "x_axis", "y_axis")
_OWN_KEYS = ("name", *_VECTORS, "points", "kind")
_DISTANCE = Keys("from=start: quoted, to=end: quoted, length: number, std: number")


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
        if not plane.measured:
            lines.append(f"  - {_in_line(plane)}")
            continue
        first, *others = _entries(plane)
        rows = flow(np.array(plane.measured))[2:-2].split("], [")
        lines += [f"  - {first}", *indented(others, 4)]
        lines += ["    points:  # column, row, X, Y, Z", *(f"      - [{row}]" for row in rows)]
    lines += list_lines("distances", map(_DISTANCE.flow, board.distances)) if board.distances else []
    return "\n".join([*lines, ""])


def board_line(board: Board) -> str:
    """Text of a board file on one line, without measured points; empty for plain chessboards."""
    if all(kind_of(plane) == "chessboard" for plane in board.planes):
        return ""
    return mapping(unit=text(board.unit), planes=f"[{', '.join(map(_in_line, board.planes))}]")


def _entries(plane: Plane) -> list[str]:
    """Lines of a plane in a file, without its measured points."""
    kind = kind_of(plane)
    head = [f"name: {text(plane.name)}"] if plane.name else []
    head += [f"kind: {kind}"] if kind != "chessboard" else []
    place = [f"{key}: {flow(np.array(getattr(plane, key)))}" for key in _VECTORS]
    return [*head, *KINDS[kind].lines(values_of(plane)), *place]


def _in_line(plane: Plane) -> str:
    return f"{{{', '.join(_entries(plane))}}}"


def _board(root: Field) -> Board:
    if isinstance(root.value, dict) and {"kind", "planes"}.isdisjoint(root.value):
        with value_failures(root.source):
            other = other_board(root)
        if other is not None:
            return other
        if "square" not in root and (near := nearest_board(root)):
            root.refuse("is not the file of a board", near)
    unit = root.get("unit", "mm").text()
    if "planes" not in root and ("kind" in root or "square" in root):
        planes: tuple[Plane, ...] = (_plane(root, alone=True, more=("unit", "distances")),)
    else:
        _only(root, ("unit", "planes", "distances"))
        fields = list(root["planes"].items())
        if not fields:
            root["planes"].fail("a list of at least one plane")
        planes = tuple(_plane(field, alone=len(fields) == 1) for field in fields)
    with value_failures(root.source, "planes: "):
        board = Board(planes, unit)
    distances = []
    for field in root["distances"].items() if "distances" in root else ():
        _only(field, _DISTANCE.names)
        with value_failures(field.source, f"{field.path}: "):
            distances.append(Distance(**_DISTANCE.read(field)))
            for label in (distances[-1].start, distances[-1].end):
                board.place(label)
    return replace(board, distances=tuple(distances))


def _plane(field: Field, *, alone: bool, more: tuple[str, ...] = ()) -> Plane:
    """Read a plane, which may have `more` keys; a single plane needs no name, origin and axes."""
    kind = field.get("kind", "chessboard").text()
    if kind not in KINDS:
        field["kind"].fail(f"one of {', '.join(KINDS)}")
    counted = COUNTED.names if kind == "chessboard" else ()
    _only(field, tuple(dict.fromkeys((*_OWN_KEYS, *counted, *KINDS[kind].names, *more))))
    place: dict[str, Any] = {
        key: tuple(field[key].array(3).tolist()) for key in _VECTORS if not alone or key in field
    }
    if "points" in field:
        place["measured"] = tuple(map(tuple, field["points"].array(-1, 5).tolist()))
    place["name"] = field["name"].text() if not alone or "name" in field else ""
    with value_failures(field.source, f"{field.path}." if field.path else ""):
        return read_plane(field, kind, **place)


def _only(field: Field, known: tuple[str, ...]) -> None:
    """Refuse unknown keys; otherwise a misspelt axis would silently become the default axis."""
    for key in field.entries():
        if key not in known:
            where = f"{field.path}: " if field.path else ""
            field.refuse(f"{where}the key {key[:60]!r} is not known; use one of {', '.join(known)}")


_SECTIONS = (
    "opencv_storage", "Settings", "charuco", "board", "target", "pattern", "startPnpCalibration",
    "startCalibration",
)  # fmt: skip


@frozen_dataclass
class BoardFormat:
    """Board files of another program."""

    program: str
    files: str
    told: str  # names of keys by which a file is told; the first has the word
    kinds: Mapping[str, tuple[str, str]]  # by words, our name of the kind, and its keys
    unit: str = "mm"  # of lengths, unless a key says
    word: str = ""  # names of another key of the word; a file without one that is known is of the first kind
    inner: bool = False  # whether inner vertices are counted


_CHARUCO = (
    "dictionary?=dictionary dictionary_name dictionary_id dict aruco_dict aruco_dict_name aruco_dictionary "
    "tag_family marker_dictionary, legacy?=legacy_pattern use_old_pattern legacy, inverted?=inverted,"
    "first_id?=first_id start_id first_marker id_offset"
)
_SQUARES = (
    "cols=squares_x squares_across num_squares_x pattern_width board_width columns cols width,"
    "unit?=unit units, rows=squares_y squares_down num_squares_y pattern_height board_height rows height,"
    "square=square_length square_size square_size_in:inch square_size_meters:m square_size_mm:mm "
    "square_length_mm:mm checker_width checker_size checker_length grid_size square"
)
_MARKER = (
    "marker_length marker_size marker_size_in marker_size_meters marker_size_mm marker_length_mm aruco_size "
    "marker"
)
_SHEET = (
    "unit?=units, cols=columns cols, rows=rows, square?=square_size_overide_cm:cm square_size_override_cm:cm,"
    f"width?=board_width, height?=board_height, ratio=aruco_scale, {_CHARUCO}"
)
_GRID = "cols=targetCols, rows=targetRows"
_INNER = "cols=BoardSize_Width, rows=BoardSize_Height, square=Square_Size"
# Kalibr's older files name the distance of two tags' sides, newer ones its ratio; both name it tagSpacing.
_TAGS = "cols=tagCols, rows=tagRows, square=tagSize, spacing=tagSpacing, first_id?=codeOffset"
FORMATS = (
    BoardFormat(
        "Kalibr",
        "`target.yaml`",
        "target_type",
        {
            "aprilgrid": ("aprilgrid", _TAGS),
            "checkerboard": ("chessboard", f"{_GRID}, square=colSpacingMeters, down=rowSpacingMeters"),
            "circlegrid": ("circles", f"{_GRID}, square=spacingMeters, asymmetric?=asymmetricGrid"),
        },
        unit="m",
        inner=True,
    ),
    BoardFormat(
        "OpenCV",
        "settings of its sample `camera_calibration`",
        "Calibrate_Pattern BoardSize_Width",
        {
            "chessboard": ("chessboard", _INNER),
            "charucoboard": ("charuco", f"{_INNER}, marker=Marker_Size, dictionary?=ArUco_Dict_Name"),
            "circlesgrid": ("circles", _INNER),
            "asymmetriccirclesgrid": ("asymmetric_circles", _INNER),
        },
        inner=True,
    ),
    BoardFormat("caliscope", "`charuco.toml`", "aruco_scale", {"": ("charuco", _SHEET)}, "cm", "board_type"),
    # It does not tell a ChArUco board from a chessboard.
    BoardFormat(
        "PhotonVision",
        "its calibration",
        "calobjectSize",
        {"": ("chessboard", "cols=calobjectSize/width, rows=calobjectSize/height, square=calobjectSpacing")},
        "m",
        "board_type",
        inner=True,
    ),
    BoardFormat(
        "PhotonVision or OpenCV's classes",
        "its settings, and what scripts write with the names of OpenCV's arguments",
        f"{_MARKER} board_type",
        {
            "*charuco* 1": ("charuco", f"{_SQUARES}, marker={_MARKER}, {_CHARUCO}"),
            "*chess* *checker* 0": ("chessboard", _SQUARES),
        },
        word="board_type type pattern_type target_type",
    ),
)


def _dictionary(field: Field) -> str:
    """Name of a dictionary that is given by name or by OpenCV's number."""
    if isinstance(field.value, bool) or not isinstance(field.value, int):
        return field.text()
    number = field.integer()
    if number >= len(DICTIONARIES):
        field.fail(f"a number of OpenCV's dictionaries, up to {len(DICTIONARIES) - 1}")
    return list(DICTIONARIES)[number]


_READ: dict[str, Callable[[Field], Any]] = {
    **dict.fromkeys(("cols", "rows"), lambda field: field.integer(1)),
    **dict.fromkeys(("legacy", "inverted", "asymmetric"), Field.boolean),
    "dictionary": _dictionary,
    "first_id": Field.integer,
    "unit": Field.text,
}  # all others are numbers


def other_board(root: Field) -> Board | None:
    """The board of a file of another program; None if the keys are those of none."""
    told = (one for one in FORMATS if _first(root, one.told)[0] is not None)
    if (found := next(told, None)) is not None:
        return _of_program(found, root)
    sections = (other_board(root[name]) for name in _SECTIONS if name in root)
    return next((board for board in sections if board is not None), None)


def nearest_board(root: Field) -> str:
    """The program most of whose keys a file has, and what it lacks; "" if none has half of them."""
    found = [(0.5, "")]
    tables = [(one, table) for one in FORMATS for _, table in one.kinds.values()]
    for part in (root, *(root[name] for name in _SECTIONS if name in root)):
        for one, table in tables:
            needed = [one.told, *(names for _, optional, names in _keys(table) if not optional)]
            lacks = [names.split()[0] for names in needed if _first(part, names)[0] is None]
            said = f"{one.program} is the nearest of the known programs, which has {', '.join(lacks)} as well"
            found.append((1 - len(lacks) / len(needed), said))
    return max(found, key=lambda one: one[0])[1]


def _first(root: Field, names: str) -> tuple[Field | None, str]:
    """The first value under one of the names, some of them ``key/key``, and the unit that the name tells."""
    for name, _, unit in (word.partition(":") for word in names.split()):
        field: Field | None = root
        for key in name.split("/"):
            field = None if field is None else field.called(key)
        if field is not None:
            return field, unit
    return None, ""


def _keys(table: str) -> Iterator[tuple[str, bool, str]]:
    """What keys say, whether a file may lack them, and their names."""
    for entry in table.split(","):
        said, _, names = entry.strip().partition("=")
        yield said.removesuffix("?"), said.endswith("?"), names


def _of_program(one: BoardFormat, root: Field) -> Board:
    def lacks(name: str) -> NoReturn:
        root.refuse(f"a board of {one.program} without {name}", "describe the board by --board in short")

    field, _ = _first(root, one.word or one.told.split()[0])
    if field is None and not one.word:
        lacks(one.told.split()[0])
    kind, table = _kind(one, field)
    values: dict[str, Any] = {"unit": one.unit}
    for said, optional, names in _keys(table):
        entry, unit = _first(root, names)
        empty = (None, "", False) if said == "square" else (None, "")
        if entry is not None and not (optional and entry.value in empty):
            values |= {said: _READ.get(said, Field.number)(entry), **({"unit": unit} if unit else {})}
        elif not optional:
            lacks(names.split()[0])
    shift = int(one.inner and kind in ("chessboard", "charuco"))
    size = values.pop("cols") + shift, values.pop("rows") + shift
    sheet = [values.pop(side, 0.0) for side in ("width", "height")]
    unit, ratio = values.pop("unit"), values.pop("ratio", None)
    if ratio is not None:  # of caliscope, where the squares fill a sheet unless one was measured
        if 0 in sheet and not values.get("square"):
            lacks("board_width and board_height")
        square = values.get("square") or min(sheet[0] / size[0], sheet[1] / size[1])
        values |= {"square": square, "marker": ratio * square}
    if values.pop("asymmetric", False):
        kind = "asymmetric_circles"
    if (down := values.pop("down", values["square"])) != values["square"]:
        root.refuse(
            f"the squares are {values['square']:g} x {down:g} m; neurocal describes boards of squares",
            "correct rowSpacingMeters and colSpacingMeters",
        )
    return Board((plane_of(kind, size, **values, name=""),), unit)


def _kind(one: BoardFormat, field: Field | None) -> tuple[str, str]:
    """Our name of a kind, and its keys."""
    word = plain(str(field.value)) if field is not None and isinstance(field.value, (str, int)) else ""
    for words, kind in one.kinds.items():
        if any(fnmatchcase(word, form) for form in words.split()):
            return kind
    if field is not None and (not one.word or "grid" in word):
        *others, last = (words.split()[0].strip("*") for words in one.kinds)
        field.fail(f"{', '.join(others)} or {last}")
    return next(iter(one.kinds.values()))  # the key has another meaning

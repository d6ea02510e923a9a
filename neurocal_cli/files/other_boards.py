"""Board files of other programs: the names of their keys, and what these say of a board.

Names are compared without capitals and marks. A file is told by a key; the word under it may choose among
kinds, whose keys are a text such as ``"cols=tagCols, first_id?=codeOffset"``: what is said, and the names of
the key, each perhaps with the unit that it tells. A file needs one of them unless there is a question mark.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any, NoReturn

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.files.board_kinds import plane_of
from neurocal_cli.files.tree_fields import Field, plain
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.markers import DICTIONARIES

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
    BoardFormat(
        "PhotonVision or OpenCV's classes",
        "its settings, and what calib.io and scripts write with the names of OpenCV's arguments",
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
        return _board(found, root)
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
    """The first value that has one of the names, and the unit that the name tells."""
    for name, _, unit in (word.partition(":") for word in names.split()):
        if (field := root.called(name)) is not None:
            return field, unit
    return None, ""


def _keys(table: str) -> Iterator[tuple[str, bool, str]]:
    """What keys say, whether a file may lack them, and their names."""
    for entry in table.split(","):
        said, _, names = entry.strip().partition("=")
        yield said.removesuffix("?"), said.endswith("?"), names


def _board(one: BoardFormat, root: Field) -> Board:
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

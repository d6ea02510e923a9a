"""Board files: YAML of a target of one or several planes as users write it; see also `other_boards`.

A board of one plane may stand at the top of the file with its ``kind``, or in the list of planes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli.errors import value_failures
from neurocal_cli.files.board_kinds import COUNTED, KINDS, kind_of, read_plane, values_of
from neurocal_cli.files.camera_tree import parse_tree
from neurocal_cli.files.key_tables import Keys, inline
from neurocal_cli.files.other_boards import nearest_board, other_board
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import flow, indented, list_lines, mapping, parse_yaml, quoted, text
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.distances import Distance

_VECTORS = ("origin", "x_axis", "y_axis")
_OWN_KEYS = ("name", *_VECTORS, "points", "kind")
_DISTANCE = Keys(
    "from=start: quoted, to=end: quoted, length: number, std: number", {"quoted": inline(Field.text, quoted)}
)


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
        if near := nearest_board(root):
            root.refuse("is not the file of a board", near)
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

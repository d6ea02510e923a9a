"""Board YAML: a target of one or several planes, as a file that users write.

A board of one plane may stand at the top of the file with its ``kind``, or in the list of planes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurocal_cli.files.board_kinds import KIND_KEYS, is_kalibr, kalibr_plane, kind_entries, read_plane
from neurocal_cli.files.failures import value_failures
from neurocal_cli.files.file_storage import parse_tree
from neurocal_cli.files.other_boards import other_board
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.writing import write_whole
from neurocal_cli.files.yaml_text import flow, mapping, number, parse_yaml, quoted, text
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.distances import Distance

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

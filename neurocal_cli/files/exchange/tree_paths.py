"""Values in the trees of files by the paths of their keys, and trees as JSON, YAML, TOML or Python.

A path is a chain of keys joined by ``/``; numbers index lists. A path of several numbers is that of a list or
a matrix in any form, or ends in the keys of each, joined by commas. The form in which it is written follows a
colon: ``list``, ``matrix`` of nested rows; by columns are ``transposed``, a nested matrix, and ``columns``,
one list, and so they are read.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError
from neurocal_cli.files.camera_tree import matrix_data
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import flow, number, text

_LONGEST = 5000  # characters of a text of numbers in rows
_RANGE = re.compile(r"(.*?)(\d+)-(\d+)").fullmatch
_BY_COLUMNS = ("transposed", "columns")


def find(root: Field, path: str) -> Field | None:
    """Value at a path; None if it is not there, or null."""
    here = root
    for key in path.partition(":")[0].split("/"):
        if isinstance(here.value, list) and key.isdecimal() and int(key) < len(here.value):
            here = Field(here.value[int(key)], here.source, f"{here.path}[{key}]")
        elif key in here:
            here = here[key]
        else:
            return None
    return here


def at(root: Field, path: str) -> Field:
    """Value at a path; a FormatError names the first key that is missing."""
    here = root
    for key in path.partition(":")[0].split("/"):
        found = find(here, key)
        if found is None and key.isdecimal() and not isinstance(here.value, dict):
            here.fail(f"a list of {int(key) + 1} or more")
        here = here[key] if found is None else found
    return here


def split(path: str) -> list[str]:
    """The paths of each number, of one that ends in several keys; the path alone without."""
    folder, _, keys = path.partition(":")[0].rpartition("/")
    return [f"{folder}/{key}" if folder else key for key in keys.split(",")]


def listed(paths: str) -> list[str]:
    """The paths in a text, each of one number unless there is but one; ``k1-3`` are k1, k2 and k3."""
    found: list[str] = []
    for path in paths.split():
        if (ends := _RANGE(path)) is not None:
            found += [f"{ends[1]}{k}" for k in range(int(ends[2]), int(ends[3]) + 1)]
        else:
            found += split(path) if "," in path else [path]
    return found


def numbers_at(root: Field, path: str) -> Array:
    """Numbers at a path in one row; those of a matrix by its rows."""
    if len(paths := split(path)) > 1:
        return np.array([at(root, one).number() for one in paths])
    values = matrix_data(at(root, path), -1)
    if path.endswith(_BY_COLUMNS):
        side = {9: 3, 16: 4}.get(len(values), 1)
        values = values.reshape(-1, side).T.ravel()
    return values


def put(tree: dict[str, Any], path: str, value: Any) -> None:
    """Set the value at a path, in the form that its end names."""
    if len(paths := split(path)) > 1:
        for one, entry in zip(paths, value, strict=True):
            put(tree, one, entry)
        return
    path, _, form = path.partition(":")
    *folders, last = path.split("/")
    here: Any = tree
    for folder, key in zip(folders, path.split("/")[1:], strict=True):
        here = here.setdefault(folder, [] if key.isdecimal() else {})
    value = np.transpose(value) if form in _BY_COLUMNS else value
    if isinstance(value, np.ndarray):
        value = (value.ravel() if form in ("list", "columns") else value).tolist()
    if isinstance(here, list):
        here += [0.0] * (int(last) + 1 - len(here))
        here[int(last)] = value
    else:
        here[last] = value


def in_order(table: str, words: Any, source: str) -> Field:
    """The tree of numbers that a file has in a fixed order.

    A table is ``"fx fy R:9 D:"``: single numbers, lists of a length, and perhaps a list of all that follow.
    """
    values = matrix_data(Field(words, source), -1).tolist()
    tree: dict[str, Any] = {}
    for entry in table.split():
        name, listed, count = entry.partition(":")
        end = int(count or len(values)) if listed else 1
        if len(values) < end:
            raise FormatError(f"holds too few numbers, and not all of {name}; write it again", source)
        tree[name], values = (values[:end] if listed else values[0]), values[end:]
    if values:
        raise FormatError(f"holds {len(values)} numbers too many; write it again", source)
    return Field(tree, source)


def in_rows(table: str, text: str, source: str = "") -> Field | None:
    """The tree of a text of numbers in fixed rows, perhaps with comments after ``#``; None for others.

    A table is that of `in_order` with commas between the rows; ``R:9/3`` are nine numbers in three rows.
    """
    rows = [line.split() for line in text[:_LONGEST].splitlines() if line.strip() and line.lstrip()[0] != "#"]
    tree: dict[str, Any] = {}
    for part in table.split(","):
        entries, _, count = part.partition("/")
        own, rows = rows[: int(count or 1)], rows[int(count or 1) :]
        if len(set(map(len, own))) != 1:
            return None
        try:
            tree |= in_order(entries, [word for row in own for word in row], source).value
        except FormatError:
            return None
    return None if rows else Field(tree, source)


def arrays(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The tree with matrices of doubles for lists of numbers."""
    return {
        key: np.atleast_2d(np.array(value, dtype=float))
        if isinstance(value, list)
        else arrays(value)
        if isinstance(value, dict)
        else value
        for key, value in tree.items()
    }


def json_text(tree: Any) -> str:
    """A tree as JSON."""
    return json.dumps(tree, indent=1, allow_nan=False) + "\n"


def yaml_text(tree: Mapping[str, Any], head: str = "") -> str:
    """A tree as YAML, below the lines `head`."""
    return head + "".join(f"{line}\n" for line in _yaml_lines(tree))


def _yaml_lines(tree: Mapping[str, Any]) -> list[str]:
    lines = []
    for key, value in tree.items():
        if isinstance(value, dict):
            lines += [f"{key}:", *(f"   {line}" for line in _yaml_lines(value))]
        else:
            lines.append(f"{key}: {_yaml_value(value)}")
    return lines


def _yaml_value(value: Any) -> str:
    if isinstance(value, (int, str)):
        return str(value) if isinstance(value, int) else text(value)
    if isinstance(value, list) and all(isinstance(entry, int) for entry in value):
        return str(value)
    return number(value) if isinstance(value, float) else flow(np.array(value))


def toml_text(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Tables of texts, numbers and lists as TOML."""
    parts = []
    for name, table in tables.items():
        parts += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items()), ""]
    return "\n".join(parts)


def python_text(tree: Mapping[str, Any]) -> str:
    """A tree as a dictionary of Python."""
    return "{\n" + "".join(f"    {key!r}: {value!r},\n" for key, value in tree.items()) + "}\n"

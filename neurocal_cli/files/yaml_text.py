"""Write YAML text that every reader reads back exactly, and parse YAML, which may be untrusted.

For a file of 100 views, PyYAML's ``CSafeDumper`` takes 180 ms and this module 20 ms, nearly all of it for the
shortest decimal form of each number.

A tree of dicts, lists, strings and numbers is built here from the events of PyYAML (libyaml if it is
available), not by its loaders. That is 5 times faster on calibration files (19,000 rows of points: 0.17 s, by
``CSafeLoader`` 0.95 s), and aliases can be refused (a few lines of them can expand to gigabytes), as can
duplicate keys and absurd nesting. Tags are ignored, so OpenCV's ``!!opencv-matrix`` is read like any mapping.
Keys of mappings stay text: a view called ``1e5`` or ``null`` keeps its name.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from typing import Any, NoReturn

import numpy as np
import yaml

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError

DEEPEST = 40
TOO_DEEP = "is nested too deeply to be a camera file; give another"

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./+-]*").fullmatch
_RESERVED = frozenset(("null", "true", "false", "yes", "no", "on", "off", "y", "n"))
# Characters that YAML would fold, refuse or show wrongly; \uXXXX has the same meaning in YAML and JSON.
_UNSAFE = "[\x7f-\xa0\xad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff0-\uffff]"
_SURROGATE = "[\ud800-\udfff]"
_encode = json.JSONEncoder(ensure_ascii=False).encode

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]{0,4000})").fullmatch
# PyYAML's rule, so that names which it writes without quotes (1e5, 1.5e5, -.5) stay names.
_FLOAT = re.compile(r"(?:[-+]?[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+][0-9]+)?").fullmatch
_WORDS: dict[str, Any] = {
    "": None,
    "~": None,
    **dict.fromkeys(("null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), float("-inf")),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
}
_OPENCV = re.compile(r"%YAML:[^\n]*\n")


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


def indented(lines: Iterable[str], by: int = 2) -> list[str]:
    """Lines with some blanks before each."""
    blanks = " " * by
    return [blanks + line for line in list(lines)]


def block(key: str, lines: Iterable[str]) -> list[str]:
    """Lines of a key whose value are these lines."""
    return [f"{key}:", *indented(lines)]


def boolean(value: bool) -> str:
    """Write true or false."""
    return "true" if value else "false"


def words(names: Iterable[str]) -> str:
    """Write names as a flow sequence, each like `text`."""
    return f"[{', '.join(map(text, names))}]"


def quoted_words(names: Iterable[str]) -> str:
    """Write names as a flow sequence, each in quotes."""
    return f"[{', '.join(map(quoted, names))}]"


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


def parse_yaml(text: str, source: str) -> Any:
    """Parse YAML text to dicts with text keys, lists, str, int, float, bool and None; without aliases."""
    if source == "<stdin>" and not text.strip():
        raise FormatError("is empty; check the command before it", source)
    text = text.replace("\r\n", "\n")
    if (cut := _OPENCV.match(text)) is not None:  # OpenCV needs no blank after a colon
        text = cut[0] + re.sub(r"(?m)^( *[A-Za-z_][\w.-]*):(?=[^\s:/\\])", r"\1: ", text[cut.end() :])
    text = re.sub(r"\A%YAML[: ][^\n]*", "", text)  # OpenCV writes %YAML:1.0, which YAML parsers refuse
    text = re.sub(r"\n---[ \t]*\s*\Z", "\n", text)  # rostopic echo ends each message so
    try:
        return _assemble(text, source)
    except yaml.YAMLError as error:
        raise _syntax_error(error, text, source) from error
    except (RecursionError, UnicodeError) as error:
        raise FormatError("is not readable YAML; write it again", source) from error


def _assemble(text: str, source: str) -> Any:
    """Build the tree from the parser's events without recursion."""
    root: list[Any] = []
    containers: list[Any] = [root]  # innermost last
    keys: list[str | None] = [None]  # for each container, the key that still needs a value
    events: Iterator[Any] = yaml.parse(text, Loader=_LOADER)
    for event in events:
        kind = type(event)
        if kind is yaml.ScalarEvent:
            value: Any = event.value
            if type(containers[-1]) is dict and keys[-1] is None:
                if value in containers[-1]:
                    _fail(f"the key {value[:60]!r} appears twice; remove one", event, source)
                keys[-1] = value
                continue
            if not event.style:
                value = value if str(event.tag).endswith(":str") else plain_value(value)
        elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
            if type(containers[-1]) is dict and keys[-1] is None:
                _fail("a key must be a word, not a list or mapping; correct it", event, source)
            if len(containers) > DEEPEST:
                _fail(TOO_DEEP, event, source)
            containers.append({} if kind is yaml.MappingStartEvent else [])
            keys.append(None)
            continue
        elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
            value = containers.pop()
            keys.pop()
        elif kind is yaml.AliasEvent:
            _fail("aliases (*name) are not read; write the value out", event, source)
        elif kind is yaml.DocumentStartEvent and root:
            _fail("a second YAML document begins; keep one", event, source)
        else:
            continue
        container = containers[-1]
        if type(container) is list:
            container.append(value)
        else:
            container[keys[-1]] = value
            keys[-1] = None
    return root[0] if root else None


def plain_value(text: str) -> Any:
    """Value of a plain scalar as in PyYAML, but without dates and number bases other than ten."""
    if text[:1] in "+-.0123456789":  # also true for empty text
        if _FLOAT(text):
            return float(text)
        if _INTEGER(text):
            return int(text)
    return _WORDS.get(text, text)


def _fail(problem: str, event: Any, source: str) -> NoReturn:
    raise FormatError(problem, source, event.start_mark.line + 1)


def _syntax_error(error: yaml.YAMLError, text: str, source: str) -> FormatError:
    mark = getattr(error, "problem_mark", None)
    if mark is not None:
        problem = str(getattr(error, "problem", "")) or "it cannot be parsed"
        if "nesting depth" in problem:  # libyaml has a limit of its own since 0.2.6, and looks ahead
            return FormatError(TOO_DEEP, source, mark.line + 1)
        return FormatError(f"is not valid YAML ({problem}); correct it", source, mark.line + 1)
    position = getattr(error, "position", None)  # a character that YAML does not allow
    line = None if position is None else text.count("\n", 0, position) + 1
    return FormatError("holds a character that YAML does not allow; remove it", source, line)

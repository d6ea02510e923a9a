"""Text on a terminal: lines are wrapped at words, and tables know how wide they may be."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

_HANGING = "  "  # how much farther than its first line the rest of a wrapped line is indented
_NARROWEST = 20  # columns; below, nothing is legible
# Blanks between a number and its unit, or the two numbers of a size, where a line is not broken.
_UNIT = r"(?:px|mm|cm|m|s|rad|degrees|%)(?:[\s,;.:)]|$)"
_KEPT = re.compile(rf"(?<=\d) (?={_UNIT})|(?<=\d) (?=x \d)|(?<=\d x) (?=\d)")
_UNBROKEN = "\xa0"

# The width of the terminal for which text is being made; None: there is none.
_WIDTH: ContextVar[int | None] = ContextVar("width", default=None)


def is_terminal(stream: TextIO | None) -> bool:
    """Whether the stream is a terminal."""
    return stream is not None and not stream.closed and stream.isatty()


def columns(stream: TextIO | None) -> int | None:
    """Width of a terminal; None for another stream, or if it does not tell."""
    if stream is None or not is_terminal(stream):
        return None
    try:
        width = int(os.environ.get("COLUMNS", "0")) or os.get_terminal_size(stream.fileno()).columns
    except (ValueError, OSError):
        return None
    return max(width, _NARROWEST) if width > 0 else None


@contextmanager
def drawn_on(stream: TextIO | None) -> Iterator[None]:
    """Make tables for this stream meanwhile; see `table_width`."""
    token = _WIDTH.set(columns(stream))
    try:
        yield
    finally:
        _WIDTH.reset(token)


def table_width() -> int | None:
    """How wide a table may be; None: as wide as it is."""
    return _WIDTH.get()


def wrapped(text: str, stream: TextIO | None) -> str:
    """Text whose lines fit on a terminal, broken at blanks and with a hanging indent; elsewhere as it is."""
    width = columns(stream)
    if width is None:
        return text
    return "\n".join(part for line in text.split("\n") for part in _wrapped(line, width))


def _wrapped(line: str, width: int) -> list[str]:
    if len(line) <= width:
        return [line]
    indent = line[: len(line) - len(line.lstrip(" "))] + _HANGING
    words = _KEPT.sub(_UNBROKEN, line)
    lines = textwrap.wrap(
        words, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [one.replace(_UNBROKEN, " ") for one in lines] or [line]

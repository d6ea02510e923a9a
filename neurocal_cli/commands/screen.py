"""Text on a terminal: lines are wrapped at words, and tables know how wide they may be."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

import click

_HANGING = "  "  # how much farther than its first line the rest of a wrapped line is indented
_NARROWEST = 20  # columns; below, nothing is legible
# Blanks between a number and its unit, or the two numbers of a size, where a line is not broken.
_UNIT = r"(?:px|mm|cm|m|s|rad|degrees|%)(?:[\s,;.:)]|$)"
_KEPT = re.compile(rf"(?<=\d) (?={_UNIT})|(?<=\d) (?=x \d)|(?<=\d x) (?=\d)")
_TYPED = re.compile(r"`[^`]+`")  # what to type, which is not broken either
# Words of a line of a shell; an option and its value are one.
_WORDS = re.compile(r"""(?:(?:--?\w[\w-]*|[|>])\s+(?![-|>\\]))?(?:[^\s"']|"[^"]*"|'[^']*')+""")
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
    words = _TYPED.sub(lambda typed: typed[0].replace(" ", _UNBROKEN), _KEPT.sub(_UNBROKEN, line))
    lines = textwrap.wrap(
        words, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [one.replace(_UNBROKEN, " ") for one in lines] or [line]


class _Help(click.HelpFormatter):
    """Help in which examples and tables, which click leaves as they are, fit on the screen, too."""

    def write_text(self, text: str) -> None:
        """Write paragraphs; lines of examples that are too long go on below, as a shell reads them."""
        paragraphs = re.split(r"\n\s*\n", text)
        fitted = "\n\n".join(self._fitted(p) if p.startswith("\b") else p for p in paragraphs)
        indent = " " * self.current_indent
        self.write(f"{click.wrap_text(fitted, self.width, indent, indent, preserve_paragraphs=True)}\n")

    def _fitted(self, paragraph: str) -> str:
        room, fitted, before = self.width - self.current_indent, list[str](), ""
        for line in paragraph.split("\n"):
            if len(line) <= room:
                fitted.append(line)
            elif paragraph.startswith("\b\nExamples:"):
                fitted += _continued(line, room, "" if before.endswith("\\") else 2 * _HANGING)
            else:  # a row of a table, whose last column is wrapped
                start = re.match(r"\s*(?:\S+\s{2,})?", line)
                indent = " " * (start.end() if start else 0)
                fitted += textwrap.wrap(line, room, subsequent_indent=indent)
            before = line
        return "\n".join(fitted)


def _continued(line: str, room: int, hanging: str) -> list[str]:
    """Lines of a shell that are one for it: all but the last end in a backslash."""
    indent = line[: len(line) - len(line.lstrip(" "))]
    lines, last = [indent], " \\" * line.endswith("\\")
    for word in _WORDS.findall(line.removesuffix("\\")):
        if lines[-1].strip() and len(lines[-1]) + len(word) + 3 > room:
            lines[-1] += "\\"
            lines.append(indent + hanging)
        lines[-1] += f"{word} "
    return [*lines[:-1], lines[-1].rstrip() + last]


class HelpContext(click.Context):
    """A context whose help fits on the screen."""

    formatter_class = _Help

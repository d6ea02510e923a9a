"""What a command says: all on stderr, so that stdout holds results only, such as a summary for programs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextvars import ContextVar
from typing import Any, TextIO

import click

TYPED = "neurocal.typed"  # where a context keeps the words of the command line

# -1: warnings only, -2: not even these, 1: how the work goes as well. Errors are always told.
_VERBOSITY: ContextVar[int] = ContextVar("verbosity", default=0)


def set_verbosity(level: int) -> None:
    """Choose what is told until the end of this command."""
    _VERBOSITY.set(level)


def verbose() -> bool:
    """Whether the user asked how the work goes."""
    return _VERBOSITY.get() > 0


def one_line(text: str) -> str:
    """Put a text on one line, without control characters that a file may have put in it."""
    line = " ".join(text.splitlines())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def say(text: str) -> None:
    """Show a text that is not a result, unless the user wants quiet."""
    if _VERBOSITY.get() >= 0:
        click.echo(text, err=True)


def complain(text: str) -> None:
    """Tell on one line what is wrong with a part of the input."""
    if _VERBOSITY.get() >= -1:
        click.echo(one_line(text), err=True)


def note(texts: Iterable[str]) -> None:
    """Tell what was done with the input that the user may not expect."""
    for text in texts:
        say(f"note: {one_line(text)}")


def warn(texts: Iterable[str]) -> None:
    """Tell what may make the result worse than it looks."""
    for text in texts:
        complain(f"warning: {text}")


def tell_more(text: str) -> None:
    """Tell how the work goes, to who asked for it."""
    if verbose():
        click.echo(one_line(text), err=True)


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a person is looking at the stream."""
    return stream is not None and not stream.closed and stream.isatty()


def some_of(names: Sequence[str]) -> str:
    """The first of several names, and how many there are more."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def print_summary(tree: dict[str, Any]) -> None:
    """Print what a command found as JSON on stdout; None for numbers that do not exist."""
    click.echo(json.dumps(tree, indent=2, allow_nan=False))

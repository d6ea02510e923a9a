"""Messages of the commands, all on stderr, so that stdout holds only results."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from typing import Any, TextIO

import click

from neurocal_cli.errors import NeurocalError

TYPED = "neurocal.typed"  # key of the words of the command line in click's context

# -1: warnings only, -2: no warnings either, 1: progress as well. Errors are always shown.
_VERBOSITY: ContextVar[int] = ContextVar("verbosity", default=0)


class _ClosedOutput(io.RawIOBase):
    """A standard output that the shell has closed: nothing can be written to it."""

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        raise NeurocalError("stdout is closed; give a file")


def stand_in_for_closed_stdout() -> None:
    """Make it an error to print when the shell has closed standard output (``>&-``).

    Python then has no such stream, and click prints nothing without a word.
    """
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(_ClosedOutput(), encoding="utf-8", write_through=True)


def set_verbosity(level: int) -> None:
    """Set the verbosity until the end of this command."""
    _VERBOSITY.set(level)


def verbose() -> bool:
    """Whether the user gave --verbose."""
    return _VERBOSITY.get() > 0


def one_line(text: str) -> str:
    """Put a text on one line, and replace control characters that may come from a file."""
    line = " ".join(text.splitlines())
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def tell(text: str) -> None:
    """Show a text on stderr. A full or closed stderr must not cost the user the result."""
    with suppress(OSError):
        click.echo(text, err=True)


def say(text: str) -> None:
    """Show a text that is not a result, unless the user gave --quiet."""
    if _VERBOSITY.get() >= 0:
        tell(text)


def complain(text: str) -> None:
    """Report on one line what is wrong with a part of the input."""
    if _VERBOSITY.get() >= -1:
        tell(one_line(text))


def refer_to(what: str) -> str:
    """Tell where the lines of `complain` are, which -qq leaves out."""
    return f"see the {what} above" if _VERBOSITY.get() >= -1 else f"the {what} are shown without -qq"


def note(texts: Iterable[str]) -> None:
    """Report how the input was treated, if the user may not expect it."""
    for text in texts:
        say(f"note: {one_line(text)}")


def warn(texts: Iterable[str]) -> None:
    """Warn of problems that may make the result worse than it looks."""
    for text in texts:
        complain(f"warning: {text}")


def tell_more(text: str) -> None:
    """Report progress if the user gave --verbose."""
    if verbose():
        tell(one_line(text))


def is_terminal(stream: TextIO | None) -> bool:
    """Whether the stream is a terminal."""
    return stream is not None and not stream.closed and stream.isatty()


def some_of(names: Sequence[str]) -> str:
    """List the first names, and the number of further ones."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def print_summary(tree: dict[str, Any]) -> None:
    """Print the summary of a result as JSON on stdout; None for numbers that do not exist."""
    click.echo(json.dumps(tree, indent=2, allow_nan=False))

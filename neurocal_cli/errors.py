"""The exceptions of the library, under one base class, and how other failures become such exceptions.

The library deliberately raises only these; the command layer turns each into one line and the exit status of
its class. A message says what is wrong, where, and what to do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path


class NeurocalError(Exception):
    """Base class of all errors that a caller of neurocal may want to catch."""

    exit_code = 1


class InputError(NeurocalError, ValueError):
    """An array or a value that cannot be used: wrong shape, not finite, too few."""


class FormatError(NeurocalError, ValueError):
    """A file that cannot be read as the expected format.

    `problem` says what is wrong, and what to do unless that is the `advice`. The source is the file's name,
    ``<stdin>`` for a stream, and its lines are counted from 1.
    """

    def __init__(self, problem: str, source: str = "", line: int | None = None, advice: str = "") -> None:
        place = source if line is None else f"{source}:{line}"
        self.reason = f"{place}: {problem}" if place else problem
        super().__init__(f"{self.reason}; {advice}" if advice else self.reason)
        self.problem = f"{problem}; {advice}" if advice else problem
        self.source = source
        self.line = line


class DegenerateGeometryError(NeurocalError):
    """Points that are well formed but do not determine the requested parameters."""


class CoincidentCamerasError(DegenerateGeometryError):
    """Two cameras at one place, as when one camera's points are given twice: nothing can be triangulated."""


class UsageError(NeurocalError):
    """A request that is invalid whatever the data, and that the user must change."""

    exit_code = 2


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse a value that is not one of an option's choices, with a UsageError that names them."""
    if value not in choices:
        raise UsageError(f"{name} must be one of {', '.join(choices)}, not {value!r}")


def check_seed(seed: object) -> None:
    """Refuse a seed that NumPy's generators do not take, with a UsageError."""
    if not isinstance(seed, Integral) or int(seed) < 0:  # NumPy's integers are Integral, too
        raise UsageError("seed must be a whole number of at least 0")


def plural(count: int, noun: str) -> str:
    """A number with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


@contextmanager
def reading_failures(source: str) -> Iterator[None]:
    """Turn errors of reading a file into one-line messages."""
    try:
        yield
    except FileNotFoundError as error:
        raise FormatError("there is no such file; check the path", source) from error
    except IsADirectoryError as error:
        raise FormatError("is a folder; give a file in it", source) from error
    except PermissionError as error:
        raise FormatError("may not be read; change its permissions", source) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise FormatError(f"cannot be read ({reason(error)}); check the path", source) from error


@contextmanager
def value_failures(source: str, where: str = "", line: int | None = None, advice: str = "") -> Iterator[None]:
    """Turn errors about values into messages that name the file and the place in it, and end in `advice`."""
    try:
        yield
    except InputError as error:
        raise FormatError(f"{where}{error}", source, line, advice) from error


def reason(error: BaseException) -> str:
    """The system's text about a failure."""
    return (getattr(error, "strerror", None) or str(error)).lower()


def source_of(path: str | Path) -> str:
    """Name of a file for messages; ``-`` is stdin."""
    return "<stdin>" if str(path) == "-" else one_line(path)


def one_line(path: str | Path) -> str:
    """Make a path, or any text, printable on one line."""
    text = str(path)
    return text if text.isprintable() else repr(text)[1:-1]

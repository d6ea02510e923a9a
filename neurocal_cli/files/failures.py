"""Turn errors about files and their values into one-line messages that name the place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neurocal_cli.errors import FormatError, InputError


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
def value_failures(source: str, where: str = "", line: int | None = None) -> Iterator[None]:
    """Turn errors about values into messages that name the file and the place in it."""
    try:
        yield
    except InputError as error:
        raise FormatError(f"{where}{error}", source, line) from error


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

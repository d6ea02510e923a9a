"""The outputs of a command: all or none are written, and never over a file that the command reads.

Within `all_or_none` every file is written under a temporary name, and all are renamed together at the end.
Files are compared by device and inode, not by name, because links lead to the same file.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar

from neurocal_cli.errors import UsageError

_Identity = tuple[int, int]  # device and inode


class Outputs:
    """The files that one command reads and writes."""

    def __init__(self) -> None:
        self._inputs: set[_Identity] = set()
        self._staged: list[tuple[str, str]] = []
        self._stdout: list[bytes] = []

    def protect(self, *paths: str | None) -> None:
        """Never write over these files; their readers report those that do not exist.

        ``-`` is standard input, which the shell may have opened from a file: ``< FILE``.
        """
        for path in paths:
            if path is not None:
                with suppress(AttributeError, OSError, ValueError):  # stdin may be closed or no file
                    self.protect_status(os.stat(sys.stdin.fileno() if path == "-" else path))

    def protect_status(self, status: os.stat_result) -> None:
        """Never write over the file of this status."""
        self._inputs.add((status.st_dev, status.st_ino))

    def check(self, shown: str, former: os.stat_result | None) -> None:
        """Refuse to write over an input.

        Raises
        ------
        UsageError
        """
        if former is not None and (former.st_dev, former.st_ino) in self._inputs:
            raise UsageError(f"{shown} is an input and would be overwritten; give another output")

    def stage(self, temporary: str, target: str) -> None:
        """Register a temporary file, to be renamed at the end."""
        self._staged.append((temporary, target))

    def hold(self, data: bytes) -> None:
        """Keep this for stdout until the end."""
        self._stdout.append(data)

    def commit(self) -> list[bytes]:
        """Rename all files to their final names; return what is for stdout."""
        while self._staged:
            temporary, target = self._staged[0]
            os.replace(temporary, target)
            del self._staged[0]
        held, self._stdout = self._stdout, []
        return held

    def discard(self) -> None:
        """Leave everything as it was."""
        for temporary, _ in self._staged:
            with suppress(OSError):
                os.unlink(temporary)
        self._staged, self._stdout = [], []


_CURRENT: ContextVar[Outputs | None] = ContextVar("outputs", default=None)


def held_back() -> Outputs | None:
    """The outputs of the running command; None outside `all_or_none`, where files are written at once."""
    return _CURRENT.get()


@contextmanager
def all_or_none(finishing: Iterable[type[BaseException]] = ()) -> Iterator[Outputs]:
    """Hold back all outputs until the end of the block; write none of them if it fails.

    A nested block is part of the outer one.

    Parameters
    ----------
    finishing : exception types
        Exceptions that end the block successfully.
    """
    outer = _CURRENT.get()
    if outer is not None:
        yield outer
        return
    outputs = Outputs()
    token = _CURRENT.set(outputs)
    try:
        yield outputs
    except tuple(finishing):
        _finish(outputs)
        raise
    except BaseException:
        outputs.discard()
        raise
    else:
        _finish(outputs)
    finally:
        _CURRENT.reset(token)


def _finish(outputs: Outputs) -> None:
    from neurocal_cli.io.writing import write_stdout

    try:
        for data in outputs.commit():
            write_stdout(data)
    except BaseException:
        outputs.discard()
        raise

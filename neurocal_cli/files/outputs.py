"""Write either all outputs of a command or none, and never overwrite a file that it reads.

Within `all_or_none` every file is written to a temporary file in its folder, and all are moved to their
places at the end. Folders that are made for them are removed if the command fails. Files are identified by
device and inode, not by name, because links lead to the same file. The name of a temporary file contains the
computer and the process that created it. If that process of this computer has ended, the next process that
writes to the same folder removes the file.
"""

from __future__ import annotations

import os
import platform
import re
import signal
import sys
from binascii import crc32
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar

from neurocal_cli.errors import NeurocalError, UsageError
from neurocal_cli.files.failures import reason

_Identity = tuple[int, int]  # device and inode
_NAME = r"\.neurocal-([0-9a-f]{8})-(\d{1,10})-[0-9a-f]{16}\.tmp"
_seen: set[str] = set()  # folders that this process has cleared


class Outputs:
    """Inputs and pending outputs of a command."""

    def __init__(self) -> None:
        self._inputs: set[_Identity] = set()
        self._staged: list[tuple[str, str]] = []
        self._folders: list[str] = []
        self._stdout: list[bytes] = []

    def protect(self, *paths: str | None) -> None:
        """Protect input files from being overwritten; missing files are ignored here."""
        for path in paths:
            if path is not None:
                with suppress(AttributeError, OSError, ValueError):  # stdin may be closed or no file
                    self.protect_status(os.stat(sys.stdin.fileno() if path == "-" else path))

    def protect_status(self, status: os.stat_result) -> None:
        """Protect the file with this status from being overwritten."""
        self._inputs.add((status.st_dev, status.st_ino))

    def check(self, shown: str, former: os.stat_result | None) -> None:
        """Refuse to overwrite an input, with a UsageError."""
        if former is not None and (former.st_dev, former.st_ino) in self._inputs:
            raise UsageError(f"{shown} is an input and would be overwritten; give another output")

    def stage(self, temporary: str, target: str) -> None:
        """Move a temporary file to its target at the end."""
        self._staged.append((temporary, target))

    def make_folder(self, folder: str) -> None:
        """Make a folder, and the folders that it is in; those that are new are removed again by `discard`."""
        folder = os.path.realpath(folder)
        if os.path.isdir(folder):
            return
        if not os.path.exists(os.path.dirname(folder)):
            self.make_folder(os.path.dirname(folder))
        self._folders.append(folder)
        try:
            os.mkdir(folder)
        except FileExistsError:
            if not os.path.isdir(folder):  # another process may have made it meanwhile
                raise

    def hold(self, data: bytes) -> None:
        """Write data to stdout at the end."""
        self._stdout.append(data)

    def commit(self) -> list[bytes]:
        """Move all files to their targets, and return the data for stdout."""
        with _undisturbed():
            while self._staged:
                temporary, target = self._staged[0]
                os.replace(temporary, target)
                del self._staged[0]
        self._folders = []
        held, self._stdout = self._stdout, []
        return held

    def discard(self) -> None:
        """Remove the temporary files and the new folders, and leave the targets unchanged."""
        for temporary, _ in self._staged:
            with suppress(OSError):
                os.unlink(temporary)
        for folder in reversed(self._folders):
            with suppress(OSError):  # another program has put something into it
                os.rmdir(folder)
        self._staged, self._folders, self._stdout = [], [], []


_CURRENT: ContextVar[Outputs | None] = ContextVar("outputs", default=None)


def held_back() -> Outputs | None:
    """Outputs of the current command; None outside of `all_or_none`, where files are written at once."""
    return _CURRENT.get()


@contextmanager
def all_or_none(finishing: Iterable[type[BaseException]] = ()) -> Iterator[Outputs]:
    """Hold back all outputs until the end of the block, and discard them if it fails.

    An exception of one of the types `finishing` ends the block successfully. A nested block is a part of the
    outer one.
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


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore interrupts for the moment in which the results get their names."""
    former = {}
    try:
        with suppress(ValueError):  # in a thread, which interrupts do not reach
            for number in (signal.SIGINT, signal.SIGTERM):
                former[number] = signal.signal(number, signal.SIG_IGN)
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _finish(outputs: Outputs) -> None:
    try:
        for data in outputs.commit():
            write_stdout(data)
    except BaseException:
        outputs.discard()
        raise


def write_stdout(data: bytes) -> None:
    """Write to stdout, after flushing earlier output."""
    if sys.stdout is None:  # the shell closed it: >&-
        raise NeurocalError("stdout is closed; give a file")
    try:
        buffer = getattr(sys.stdout, "buffer", None)
        if buffer is None:  # stdout was replaced by a text-only stream
            sys.stdout.write(data.decode("utf-8"))
        else:
            sys.stdout.flush()
            buffer.write(data)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (AttributeError, ValueError, OSError) as error:
        raise NeurocalError(f"stdout cannot be written ({reason(error)}); give a file") from error


def temporary_name() -> str:
    """Make a name that no other process chooses."""
    return f".neurocal-{_computer()}-{os.getpid()}-{os.urandom(8).hex()}.tmp"


def remove_stale(folder: str) -> None:
    """Remove the files that killed processes left in a folder, once per folder and process."""
    # On Windows, os.kill is no harmless test of a process.
    if folder in _seen or os.name != "posix":
        return
    _seen.add(folder)
    with suppress(OSError):
        for name in os.listdir(folder or "."):
            match = re.fullmatch(_NAME, name)
            if match and match[1] == _computer() and not _runs(int(match[2])):
                with suppress(OSError):
                    os.unlink(os.path.join(folder, name))


def _computer() -> str:
    return f"{crc32(platform.node().encode()):08x}"


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)  # only tests whether the process exists
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # a process of another user
        return True
    return True

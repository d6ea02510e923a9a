"""Write files completely or not at all, and either all outputs of a command or none.

A file is written to a temporary file in its folder, which then replaces it, so no reader sees a partial file,
and a failure keeps the old content. Within `all_or_none` all files are moved to their places at the end, and
folders that were made for them are removed if the command fails. A command never overwrites a file that it
reads. Files are identified by device and inode, not by name, because links lead to the same file.

The name of a temporary file contains the computer and the process that created it. If that process of this
computer has ended, the next process that writes to the same folder removes the file. ``-`` is stdout.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import signal
import stat
import sys
from binascii import crc32
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import IO

from neurocal_cli.errors import InputError, NeurocalError, UsageError, one_line, reason

# Opening these would truncate a file that the shell appends to, so they are written like stdout.
STDOUT_NAMES = frozenset({"-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"})

_Identity = tuple[int, int]  # device and inode
# Of a temporary file: its computer and its process.
_NAME = r"\.neurocal-([0-9a-f]{8})-(\d{1,10})-[0-9a-f]{16}\.tmp"
_FAILURES = {
    IsADirectoryError: "is a folder; give the name of a file",
    FileNotFoundError: "its folder does not exist; create it first",
    PermissionError: "may not be written; change the permissions of it or its folder",
}
# None where files are written at once.
_CURRENT: ContextVar[Outputs | None] = ContextVar("outputs", default=None)


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a whole file or, on any failure, nothing; text is written as UTF-8.

    An existing file keeps its permissions. A symbolic link is kept, and its target is replaced. Pipes and
    devices are written directly. Within `all_or_none` the file is replaced at the end of the command. If the
    reader closes a pipe, the BrokenPipeError is passed on, because commands then end quietly.
    """
    data, outputs = _encode(content), held_back()
    if outputs is not None and str(path) in STDOUT_NAMES:
        outputs.stdout.append(data)
    else:
        write_chunks(path, [data])


def write_chunks(path: str | Path, chunks: Iterable[str | bytes]) -> None:
    """Write a file part by part, or nothing if a part fails; see `write_whole`.

    Data already written to stdout or a pipe cannot be taken back.
    """
    if str(path) in STDOUT_NAMES:
        for chunk in chunks:
            _write_stdout(_encode(chunk))
        return
    with _writing_failures(path):
        former, outputs = _status(path), held_back()
        if former is not None and not stat.S_ISREG(former.st_mode):
            with _open_unlike_a_file(path, former) as file:
                for chunk in chunks:
                    file.write(_encode(chunk))
            return
        _check_place(path, former)
        target = os.path.realpath(path)
        temporary = _written_beside(target, chunks, former)
        if outputs is not None:
            outputs.staged.append((temporary, target, str(path)))
        else:
            os.replace(temporary, target)


def write_at_once(path: str | Path, content: str | bytes) -> None:
    """Write a whole file now, even within `all_or_none`, and keep it if the command fails; see `write_whole`.

    Such a file is no output of the command: a cache, or a frame of a video that is read back.
    """
    token = _CURRENT.set(None)
    try:
        write_whole(path, content)
    finally:
        _CURRENT.reset(token)


def make_folder(folder: str) -> None:
    """Make a folder for outputs and those that it is in, unless they exist; see `Outputs.make_folder`."""
    try:
        (held_back() or Outputs()).make_folder(folder)
    except (OSError, ValueError) as error:
        raise NeurocalError(
            f"{one_line(folder)}: the folder cannot be made ({reason(error)}); give another place"
        ) from error


def check_places(*paths: str | None) -> None:
    """Refuse outputs that cannot be written, before any work is done; None is left out.

    A UsageError says that an output is an input of the command (`Outputs.protect`), or that two outputs are
    the same file or stdout.
    """
    taken = set[str]()
    for path in paths:
        if path is None:
            continue
        if path in STDOUT_NAMES:
            if "-" in taken:
                raise UsageError("two results would go to standard output; give files")
            taken.add("-")
            continue
        with _writing_failures(path):
            former, target = _status(path), os.path.realpath(path)
            if former is not None and not (stat.S_ISREG(former.st_mode) or stat.S_ISDIR(former.st_mode)):
                continue
            _check_place(path, former)
            if target in taken:
                raise UsageError(f"{one_line(path)} is given for two outputs; give each a place of its own")
            taken.add(target)


def _write_stdout(data: bytes) -> None:
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


@contextmanager
def all_or_none(finishing: Iterable[type[BaseException]] = ()) -> Iterator[Outputs]:
    """Hold back all outputs until the end of the block, and discard them if it fails.

    An exception of one of the types `finishing` ends the block successfully.
    """
    outputs = Outputs()
    token = _CURRENT.set(outputs)
    try:
        yield outputs
    except tuple(finishing):
        outputs.finish()
        raise
    except BaseException:
        outputs.discard()
        raise
    else:
        outputs.finish()
    finally:
        _CURRENT.reset(token)


def held_back() -> Outputs | None:
    """Outputs of the current command; None outside of `all_or_none`, where files are written at once."""
    return _CURRENT.get()


class Outputs:
    """Inputs and pending outputs of a command."""

    def __init__(self) -> None:
        self.inputs: set[_Identity] = set()
        self.staged: list[tuple[str, str, str]] = []  # temporary files, their targets, and these as named
        self.stdout: list[bytes] = []  # what is written there at the end
        self._folders: list[str] = []
        self.read: dict[str, bytes] = {}  # stdin and pipes by their names, which can be read only once
        self.written: list[str] = []  # files that have got their contents, as they were named

    def protect(self, *paths: str | None) -> None:
        """Protect input files from being overwritten; missing files are ignored here."""
        for path in paths:
            if path is not None:
                with suppress(AttributeError, OSError, ValueError):  # stdin may be closed or no file
                    self.protect_status(os.stat(sys.stdin.fileno() if path == "-" else path))

    def protect_status(self, status: os.stat_result) -> None:
        """Protect the file with this status from being overwritten."""
        self.inputs.add((status.st_dev, status.st_ino))

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

    def finish(self) -> None:
        """Move all files to their targets, and write to stdout; a failure discards what is left."""
        try:
            with _undisturbed():
                while self.staged:
                    temporary, target, name = self.staged[0]
                    os.replace(temporary, target)
                    del self.staged[0]
                    self.written.append(name)
            self._folders = []
            for data in self.stdout:
                _write_stdout(data)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Remove the temporary files and the new folders, and leave the targets unchanged."""
        for temporary, *_ in self.staged:
            with suppress(OSError):
                os.unlink(temporary)
        for folder in reversed(self._folders):
            with suppress(OSError):  # another program has put something into it
                os.rmdir(folder)
        self.staged, self._folders, self.stdout = [], [], []


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore interrupts for the moment in which the results get their names."""
    former = {}
    try:
        with suppress(ValueError):  # in a thread, which interrupts do not reach
            for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
                former[number] = signal.signal(number, signal.SIG_IGN)
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def _writing_failures(path: str | Path) -> Iterator[None]:
    """Turn errors of writing a file into one-line messages."""
    try:
        yield
    except (BrokenPipeError, NeurocalError):
        raise
    except (OSError, ValueError) as error:
        other = f"cannot be written ({reason(error)}); give another place"
        said = next((text for kind, text in _FAILURES.items() if isinstance(error, kind)), other)
        raise NeurocalError(f"{one_line(path)}: {said}") from error


def _check_place(path: str | Path, former: os.stat_result | None) -> None:
    """Refuse an input of the command, and a place where no file can be written."""
    outputs = held_back()
    if outputs and former is not None and (former.st_dev, former.st_ino) in outputs.inputs:
        raise UsageError(f"{one_line(path)} is an input and would be overwritten; give another output")
    folder = os.path.dirname(os.path.realpath(path))
    if str(path).endswith(os.sep) or (former is not None and stat.S_ISDIR(former.st_mode)):
        raise IsADirectoryError(errno.EISDIR, "is a folder")
    if not os.path.isdir(folder):
        raise FileNotFoundError(errno.ENOENT, "no such folder")
    if not os.access(path if former is not None else folder, os.W_OK):
        raise PermissionError(errno.EACCES, "write-protected")


def _status(path: str | Path) -> os.stat_result | None:
    try:
        return os.stat(path)
    except FileNotFoundError:
        return None


def _open_unlike_a_file(path: str | Path, status: os.stat_result) -> IO[bytes]:
    """Open a pipe or a device; refuse a named pipe without a reader, which would block forever."""
    if not stat.S_ISFIFO(status.st_mode):
        return open(path, "wb")
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise NeurocalError(
                f"{one_line(path)}: nothing reads this pipe; start its reader first"
            ) from error
        raise
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")


def _written_beside(target: str, chunks: Iterable[str | bytes], former: os.stat_result | None) -> str:
    """Write a temporary file next to the target, with owner and permissions of the file it replaces."""
    folder = os.path.dirname(target)
    remove_stale(folder)
    temporary = os.path.join(folder, temporary_name())
    try:
        # os.open applies the umask to 0o666, as usual for a new file.
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(temporary, flags, 0o666), "wb") as file:
            for chunk in chunks:
                file.write(_encode(chunk))
            file.flush()
            os.fsync(file.fileno())
        if former is not None:
            if hasattr(os, "chown"):
                with suppress(OSError):  # only root may give files away
                    os.chown(temporary, former.st_uid, former.st_gid)
            os.chmod(temporary, stat.S_IMODE(former.st_mode))
    except BaseException:  # includes interrupts
        with suppress(OSError):
            os.unlink(temporary)
        raise
    return temporary


def _encode(content: str | bytes) -> bytes:
    if isinstance(content, bytes):
        return content
    try:
        return content.encode("utf-8")
    except UnicodeEncodeError as error:
        bad = content[error.start]
        raise InputError(f"a name holds {bad!a}, which no UTF-8 file can hold; rename the view") from error


def temporary_name() -> str:
    """Make a name that no other process chooses."""
    return f".neurocal-{_computer()}-{os.getpid()}-{os.urandom(8).hex()}.tmp"


@cache
def remove_stale(folder: str) -> None:
    """Remove the files that killed processes left in a folder, once per folder and process."""
    if os.name != "posix":  # on Windows, os.kill is no harmless test of a process
        return
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

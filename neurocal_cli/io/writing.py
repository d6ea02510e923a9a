"""Atomic writing of files: a reader never sees half a file, and a failure leaves the old content.

``-`` is stdout.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING

from neurocal_cli.errors import InputError, NeurocalError, UsageError
from neurocal_cli.io.files import one_line, reason
from neurocal_cli.io.outputs import held_back
from neurocal_cli.io.temporary_files import remove_stale, temporary_name

if TYPE_CHECKING:
    from pathlib import Path

# Opening these anew would truncate what the shell appends to, so they are written as stdout is.
_STDOUT_NAMES = frozenset({"-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"})


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a whole file or, on any failure, nothing.

    The content goes to a temporary file in the same folder, which then takes the file's place. An
    existing file keeps its permissions; a symbolic link stays and its target is replaced; what is
    not a regular file (a pipe, a device) is written directly; ``-`` is stdout. While a command holds
    its outputs back (`outputs.all_or_none`), the file takes its place at the command's end.

    Parameters
    ----------
    path : str or Path
    content : str or bytes
        Text is written as UTF-8.

    Raises
    ------
    NeurocalError
        The file cannot be written. A reader that closed its pipe stays a BrokenPipeError, which
        command lines end quietly on.
    """
    data, outputs = _encode(content), held_back()
    if outputs is not None and str(path) in _STDOUT_NAMES:
        outputs.hold(data)
    else:
        write_chunks(path, [data])


def write_chunks(path: str | Path, chunks: Iterable[str | bytes]) -> None:
    """Write a file from parts as they are produced, or nothing if one of them fails; see `write_whole`.

    Parts already sent to stdout or a pipe stay there.
    """
    if str(path) in _STDOUT_NAMES:
        for chunk in chunks:
            write_stdout(_encode(chunk))
        return
    with _writing_failures(path):
        former, outputs = _status(path), held_back()
        if former is not None and not stat.S_ISREG(former.st_mode):
            with _open_unlike_a_file(path, former) as file:
                for chunk in chunks:
                    file.write(_encode(chunk))
            return
        if outputs is not None:
            outputs.check(one_line(path), former)
        _check_place(path, former)
        target = os.path.realpath(path)
        temporary = _written_beside(target, chunks, former)
        if outputs is not None:
            outputs.stage(temporary, target)
        else:
            os.replace(temporary, target)


def check_places(*paths: str | None) -> None:
    """Refuse places that a file cannot be written to, before any work is done.

    Parameters
    ----------
    paths : str or None
        None and ``-`` need no place.

    Raises
    ------
    UsageError
        A file that the command reads (`Outputs.protect`), two outputs in one place.
    NeurocalError
        A folder that does not exist or may not be written to.
    """
    outputs, taken = held_back(), set[str]()
    for path in paths:
        if path is None or path in _STDOUT_NAMES:
            continue
        with _writing_failures(path):
            former, target = _status(path), os.path.realpath(path)
            if former is not None and not (stat.S_ISREG(former.st_mode) or stat.S_ISDIR(former.st_mode)):
                continue
            if outputs is not None:
                outputs.check(one_line(path), former)
            _check_place(path, former)
            if target in taken:
                raise UsageError(f"{one_line(path)} is given for two outputs; give each a place of its own")
            taken.add(target)


def _check_place(path: str | Path, former: os.stat_result | None) -> None:
    folder = os.path.dirname(os.path.realpath(path))
    if former is not None and stat.S_ISDIR(former.st_mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder")
    if not os.path.isdir(folder):
        raise FileNotFoundError(errno.ENOENT, "no such folder")
    if not os.access(path if former is not None else folder, os.W_OK):
        raise PermissionError(errno.EACCES, "write-protected")


@contextmanager
def _writing_failures(path: str | Path) -> Iterator[None]:
    """Turn failures to write a file into one-line errors."""
    try:
        yield
    except (BrokenPipeError, NeurocalError):
        raise
    except (OSError, ValueError) as error:
        raise NeurocalError(f"{one_line(path)}: {_write_failure(path, error)}") from error


def _open_unlike_a_file(path: str | Path, status: os.stat_result) -> IO[bytes]:
    """Open a pipe or a device; a named pipe that nobody reads would block for ever."""
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


def write_stdout(data: bytes) -> None:
    """Write to stdout, after what was printed before."""
    if sys.stdout is None:  # the shell closed it: >&-
        raise NeurocalError("stdout is closed; give a file")
    try:
        buffer = getattr(sys.stdout, "buffer", None)
        if buffer is None:  # replaced by something that takes text alone
            sys.stdout.write(data.decode("utf-8"))
        else:
            sys.stdout.flush()  # what was printed before comes first
            buffer.write(data)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (AttributeError, ValueError, OSError) as error:
        raise NeurocalError(f"stdout cannot be written ({reason(error)}); give a file") from error


def _encode(content: str | bytes) -> bytes:
    if isinstance(content, bytes):
        return content
    try:
        return content.encode("utf-8")
    except UnicodeEncodeError as error:
        bad = content[error.start]
        raise InputError(f"a name holds {bad!a}, which no UTF-8 file can hold; rename the view") from error


def _status(path: str | Path) -> os.stat_result | None:
    try:
        return os.stat(path)
    except FileNotFoundError:
        return None


def _written_beside(target: str, chunks: Iterable[str | bytes], former: os.stat_result | None) -> str:
    """Write the content to a temporary file in the target's folder, with the permissions of the old file."""
    folder = os.path.dirname(target)
    remove_stale(folder)
    temporary = os.path.join(folder, temporary_name())
    try:
        # os.open applies the umask to 0o666, as for any new file.
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(temporary, flags, 0o666), "wb") as file:
            for chunk in chunks:
                file.write(_encode(chunk))
            file.flush()
            os.fsync(file.fileno())
        if former is not None:
            _take_over(temporary, former)
    except BaseException:  # an interrupt leaves nothing behind either
        with suppress(OSError):
            os.unlink(temporary)
        raise
    return temporary


def _take_over(temporary: str, former: os.stat_result) -> None:
    """Give the new file the permissions and, if allowed, the owner of the file that it replaces."""
    if hasattr(os, "chown"):
        with suppress(OSError):
            os.chown(temporary, former.st_uid, former.st_gid)
    os.chmod(temporary, stat.S_IMODE(former.st_mode))


def _write_failure(path: str | Path, error: Exception) -> str:
    if isinstance(error, IsADirectoryError):
        return "is a folder; give the name of a file"
    if isinstance(error, FileNotFoundError):
        return "its folder does not exist; create it first"
    if isinstance(error, PermissionError):
        return "may not be written; change the permissions of it or its folder"
    return f"cannot be written ({reason(error)}); give another place"

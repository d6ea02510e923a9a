"""Write files completely or not at all: no reader sees a partial file, and a failure keeps the old content.

``-`` is stdout.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from neurocal_cli.errors import InputError, NeurocalError, UsageError
from neurocal_cli.files.failures import one_line, reason
from neurocal_cli.files.outputs import Outputs, held_back, remove_stale, temporary_name, write_stdout

# Opening these would truncate a file that the shell appends to, so they are written like stdout.
STDOUT_NAMES = frozenset({"-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"})
_FAILURES = {
    IsADirectoryError: "is a folder; give the name of a file",
    FileNotFoundError: "its folder does not exist; create it first",
    PermissionError: "may not be written; change the permissions of it or its folder",
}


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a whole file or, on any failure, nothing; text is written as UTF-8.

    The content is written to a temporary file in the same folder, which then replaces the file. An existing
    file keeps its permissions. A symbolic link is kept, and its target is replaced. Pipes and devices are
    written directly. While a command holds its outputs back (`outputs.all_or_none`), the file is replaced at
    the end of the command. If the reader closes a pipe, the BrokenPipeError is passed on, because commands
    then end quietly.
    """
    data, outputs = _encode(content), held_back()
    if outputs is not None and str(path) in STDOUT_NAMES:
        outputs.hold(data)
    else:
        write_chunks(path, [data])


def write_chunks(path: str | Path, chunks: Iterable[str | bytes]) -> None:
    """Write a file part by part, or nothing if a part fails; see `write_whole`.

    Data already written to stdout or a pipe cannot be taken back.
    """
    if str(path) in STDOUT_NAMES:
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
        _check_place(path, former)
        target = os.path.realpath(path)
        temporary = _written_beside(target, chunks, former)
        if outputs is not None:
            outputs.stage(temporary, target)
        else:
            os.replace(temporary, target)


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


def _check_place(path: str | Path, former: os.stat_result | None) -> None:
    """Refuse an input of the command, and a place where no file can be written."""
    if outputs := held_back():
        outputs.check(one_line(path), former)
    folder = os.path.dirname(os.path.realpath(path))
    if str(path).endswith(os.sep) or (former is not None and stat.S_ISDIR(former.st_mode)):
        raise IsADirectoryError(errno.EISDIR, "is a folder")
    if not os.path.isdir(folder):
        raise FileNotFoundError(errno.ENOENT, "no such folder")
    if not os.access(path if former is not None else folder, os.W_OK):
        raise PermissionError(errno.EACCES, "write-protected")


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

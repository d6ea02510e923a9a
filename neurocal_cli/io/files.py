"""The only place that opens files: whole files in, whole files out, failures in one line.

``-`` is stdin or stdout. A file that is written appears complete or not at all: a reader never
sees half of it and a failure leaves the former content untouched.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING

from neurocal_cli.errors import FormatError, InputError, NeurocalError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["decode", "one_line", "read_blocks", "read_bytes", "read_text", "write_chunks", "write_whole"]

# Opening these anew would truncate what the shell appends to, so they are written as stdout is.
_STDOUT_NAMES = frozenset({"-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"})

_WIDE_MARKS = (
    (b"\xff\xfe\x00\x00", "UTF-32"),  # begins like UTF-16's mark, so it is tried first
    (b"\x00\x00\xfe\xff", "UTF-32"),
    (b"\xff\xfe", "UTF-16"),
    (b"\xfe\xff", "UTF-16"),
)


def read_bytes(path: str | Path) -> tuple[bytes, str]:
    """Read a whole file, or stdin for ``-``.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    data : bytes
    source : str
        The name to show in messages, ``<stdin>`` for stdin.

    Raises
    ------
    FormatError
        The file cannot be read: missing, a folder, not permitted.
    """
    if str(path) == "-":
        return _read_stdin(), "<stdin>"
    source = one_line(path)
    with _reading_failures(source), open(path, "rb") as file:
        return file.read(), source


def read_blocks(path: str | Path, size: int) -> Iterator[bytes]:
    """Read a file, or stdin for ``-``, in blocks of whole lines of about `size` bytes; see `read_bytes`.

    A file without line ends comes as one block.
    """
    if str(path) == "-":
        with _stdin_failures():
            yield from _whole_lines(sys.stdin.buffer, size)
        return
    with _reading_failures(one_line(path)):
        file = open(path, "rb")  # noqa: SIM115 - the caller's own errors are not the file's
    with file:
        blocks = _whole_lines(file, size)
        while True:
            with _reading_failures(one_line(path)):
                block = next(blocks, None)
            if block is None:
                return
            yield block


def _whole_lines(file: IO[bytes], size: int) -> Iterator[bytes]:
    rest: list[bytes] = []
    while block := file.read(size):
        end = block.rfind(b"\n") + 1
        if end:
            yield b"".join([*rest, block[:end]])
            rest = []
        rest.append(block[end:])
    if any(rest):
        yield b"".join(rest)


@contextmanager
def _reading_failures(source: str) -> Iterator[None]:
    """Turn what can go wrong with a file into a line."""
    try:
        yield
    except FileNotFoundError as error:
        raise FormatError("there is no such file; check the path", source) from error
    except IsADirectoryError as error:
        raise FormatError("is a folder; give a file in it", source) from error
    except PermissionError as error:
        raise FormatError("may not be read; change its permissions", source) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise FormatError(f"cannot be read ({_reason(error)}); check the path", source) from error


def read_text(path: str | Path, kind: str = "a text file") -> tuple[str, str]:
    """Read a whole UTF-8 file; see `read_bytes` and `decode`."""
    data, source = read_bytes(path)
    return decode(data, source, kind), source


def decode(data: bytes, source: str, kind: str = "a text file") -> str:
    """Decode UTF-8, with or without a byte order mark.

    Parameters
    ----------
    data : bytes
    source : str
        Name for messages.
    kind : str
        What the file should be, for the message about a binary file.

    Raises
    ------
    FormatError
        UTF-16 or UTF-32 text, a binary file, bytes that are not UTF-8.
    """
    if data.isascii() and b"\0" not in data:
        return data.decode("ascii")
    for mark, name in _WIDE_MARKS:
        if data.startswith(mark):
            raise FormatError(f"is {name} text; save it as UTF-8", source)
    if b"\0" in data:
        if _alternates_with_nul(data):
            raise FormatError("is UTF-16 text; save it as UTF-8", source)
        raise FormatError(f"is a binary file, not {kind}; give {kind}", source)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(
            f"byte 0x{data[error.start]:02x} is not UTF-8 text; save the file as UTF-8", source, line
        ) from error


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a whole file or, on any failure, nothing.

    The content goes to a temporary file in the same folder, which then takes the file's place. An
    existing file keeps its permissions; a symbolic link stays and its target is replaced; what is
    not a regular file (a pipe, a device) is written directly; ``-`` is stdout.

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
    write_chunks(path, [_encode(content)])


def write_chunks(path: str | Path, chunks: Iterable[str | bytes]) -> None:
    """Write a file from its parts as they come, or, where one of them fails, nothing; see `write_whole`.

    What has gone to stdout or a pipe by then stays there.
    """
    if str(path) in _STDOUT_NAMES:
        for chunk in chunks:
            _write_stdout(_encode(chunk))
        return
    shown = one_line(path)
    try:
        former = _status(path)
        if former is not None and not stat.S_ISREG(former.st_mode):
            with open(path, "wb") as file:
                for chunk in chunks:
                    file.write(_encode(chunk))
            return
        if former is not None and not os.access(path, os.W_OK):
            raise PermissionError("write-protected")
        _replace(os.path.realpath(path), chunks, former)
    except (BrokenPipeError, NeurocalError):
        raise
    except (OSError, ValueError) as error:
        raise NeurocalError(f"{shown}: {_write_failure(path, error)}") from error


def _read_stdin() -> bytes:
    with _stdin_failures():
        return sys.stdin.buffer.read()


@contextmanager
def _stdin_failures() -> Iterator[None]:
    try:
        yield
    except NeurocalError:  # the caller's own
        raise
    except (AttributeError, ValueError, OSError) as error:  # absent or closed
        raise FormatError("stdin cannot be read; give a file", "<stdin>") from error


def _write_stdout(data: bytes) -> None:
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
        raise NeurocalError(f"stdout cannot be written ({_reason(error)}); give a file") from error


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


def _replace(target: str, chunks: Iterable[str | bytes], former: os.stat_result | None) -> None:
    temporary = os.path.join(os.path.dirname(target), f".neurocal-{os.urandom(8).hex()}.tmp")
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
        os.replace(temporary, target)
    except BaseException:  # an interrupt leaves nothing behind either
        with suppress(OSError):
            os.unlink(temporary)
        raise


def _take_over(temporary: str, former: os.stat_result) -> None:
    """Give the new file the owner, where allowed, and the permissions of the one it replaces."""
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
    return f"cannot be written ({_reason(error)}); give another place"


def _reason(error: BaseException) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()


def one_line(path: str | Path) -> str:
    """Put a path, or any text, on one printable line."""
    text = str(path)
    return text if text.isprintable() else repr(text)[1:-1]


def _alternates_with_nul(data: bytes) -> bool:
    """Whether ASCII text was written two bytes a character, without a mark."""
    head = data[:1000]
    even, odd = head[::2].count(0), head[1::2].count(0)
    return max(even, odd) >= 0.8 * (len(head) // 2) and min(even, odd) == 0

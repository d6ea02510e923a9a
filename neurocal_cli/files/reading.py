"""Read files as bytes or text, with one-line error messages. ``-`` is stdin."""

from __future__ import annotations

import io
import os
import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from neurocal_cli.errors import FormatError, one_line, reading_failures
from neurocal_cli.files.writing import held_back

_IMAGES = (b"\x89PNG", b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*")  # how PNG, JPEG, BMP and TIFF begin
_POINTS_HEADER = re.compile(r"\s*(?:#[^\n]*\n\s*)*(?!#)[^\n:]*\bX[,;\t ]\s*Y[,;\t ]\s*Z\b").match
_WIDE_MARKS = (
    (b"\xff\xfe\x00\x00", "UTF-32"),  # must come first, because it begins with the mark of UTF-16
    (b"\x00\x00\xfe\xff", "UTF-32"),
    (b"\xff\xfe", "UTF-16"),
    (b"\xfe\xff", "UTF-16"),
)
_STDIN = "<stdin>"


def read_bytes(path: str | Path) -> tuple[bytes, str]:
    """Read a whole file, or stdin for ``-``, and its name for messages.

    A command may read stdin and pipes again: several readers look at a file in turn.
    """
    with _opened(path) as (file, source):
        data = _read(file, source)
        outputs = held_back()
        if outputs is not None and (source == _STDIN or not file.seekable()):
            outputs.read[str(path)] = data
    return data, source


def read_blocks(path: str | Path, size: int) -> Iterator[bytes]:
    """Read a file in blocks of whole lines of about `size` bytes; without line ends it is one block."""
    rest: list[bytes] = []
    with _opened(path) as (file, source):
        while block := _read(file, source, size):
            end = block.rfind(b"\n") + 1
            if end:
                yield b"".join([*rest, block[:end]])
                rest = []
            rest.append(block[end:])
    if any(rest):
        yield b"".join(rest)


@contextmanager
def _opened(path: str | Path) -> Iterator[tuple[IO[bytes], str]]:
    """A file, or stdin or what was kept of it, and its name; the current command may not overwrite it."""
    outputs = held_back()
    source = _STDIN if str(path) == "-" else one_line(path)
    if outputs and str(path) in outputs.read:
        yield io.BytesIO(outputs.read[str(path)]), source
        return
    if source == _STDIN:
        if outputs:
            outputs.protect("-")
        with _failures(source):
            file = sys.stdin.buffer
        yield file, source
        return
    with _failures(source):
        opened = open(path, "rb")  # noqa: SIM115 - errors of the caller must not count as reading failures
    with opened:
        if outputs:
            outputs.protect_status(os.fstat(opened.fileno()))
        yield opened, source


def _read(file: IO[bytes], source: str, size: int = -1) -> bytes:
    with _failures(source):
        return file.read(size)


@contextmanager
def _failures(source: str) -> Iterator[None]:
    if source != _STDIN:
        with reading_failures(source):
            yield
        return
    try:
        yield
    except (AttributeError, ValueError, OSError) as error:  # stdin is absent or closed
        raise FormatError("stdin cannot be read; give a file", source) from error


def read_text(path: str | Path, kind: str = "a text file") -> tuple[str, str]:
    """Read a whole UTF-8 file; see `read_bytes` and `decode`."""
    data, source = read_bytes(path)
    return decode(data, source, kind), source


def is_point_table(text: str) -> bool:
    """Whether a text begins as a table of points does."""
    return _POINTS_HEADER(text) is not None


def detect_line(image: str) -> str:
    """The line to type for the points of an image and those that differ from it in their numbers."""
    stem, ending = os.path.splitext(image)
    folder, name = os.path.split(stem)
    start = name.rstrip("0123456789")
    images = f"{shlex.quote(os.path.join(folder, start))}*{ending}" if start != name else shlex.quote(image)
    return f"`neurocal detect {images} --square 25 -o points.csv`, with the side of your squares in mm"


def decode(data: bytes, source: str, kind: str = "a text file", instead: str = "") -> str:
    """Decode UTF-8; a message about a binary file names the `kind` that is wanted, and ends in `instead`."""
    if data.isascii() and b"\0" not in data:
        return data.decode("ascii")
    for mark, name in _WIDE_MARKS:
        if data.startswith(mark):
            raise FormatError(f"is {name} text; save it as UTF-8", source)
    if b"\0" in data:
        # Is it ASCII text with two bytes per character and no byte order mark?
        head = data[:1000]
        even, odd = head[::2].count(0), head[1::2].count(0)
        if max(even, odd) >= 0.8 * (len(head) // 2) and min(even, odd) == 0:
            raise FormatError("is UTF-16 text; save it as UTF-8", source)
        from neurocal_cli.files.image_files import VIDEO, other_kind

        what = "an image" if data.startswith(_IMAGES) else "a video" if other_kind(data) == VIDEO else ""
        if what:
            advice = f"find its points first: {detect_line(source)}" if "points" in kind else f"give {kind}"
            raise FormatError(f"is {what}, not {kind}", source, advice=advice)
        raise FormatError(f"is a binary file, not {kind}; give {kind}{instead}", source)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(
            f"byte 0x{data[error.start]:02x} is not UTF-8 text; save the file as UTF-8", source, line
        ) from error

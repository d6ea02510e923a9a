"""Read tables of numbers and labels with named columns, the common part of all our CSV files.

NumPy's C reader reads the rows in bulk, a million per second. It is less strict than the format, so text in
which the two could differ (quotes, comments among the rows, blank lines, other alphabets, ...) is read line
by line. So is text that NumPy refuses, to find the line for the message. Both ways give the same table.
Without NumPy's reader, by `str.split` or the `csv` module and `float`, a million rows take 4 s.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError, one_line, source_of
from neurocal_cli.files.reading import decode, read_blocks, read_bytes
from neurocal_cli.files.table_header import (
    Layout,
    Metadata,
    Schema,
    decimal_commas,
    find_layout,
    is_decimal_comma,
    split_fields,
)
from neurocal_cli.files.tree_fields import is_number

_BLOCK = 1 << 22  # bytes of a stream read at a time, some ten thousand rows
# Printable ASCII without quotes, with tabs and line ends: characters that both readers treat alike.
_PLAIN = bytes(c for c in range(32, 127) if c != ord('"')) + b"\t\n"


@frozen_dataclass(eq=False)
class Table:
    """Columns of one file, or of a part of it."""

    source: str  # name of the file, for messages
    numbers: dict[str, Array]  # (N,) arrays by column name
    labels: dict[str, NDArray[Any]]  # (N,) arrays of str
    lines: NDArray[np.int64]  # line number of each row
    metadata: Metadata  # from the lines that begin with #
    unknown: tuple[str, ...]  # names of ignored columns

    def __len__(self) -> int:
        return len(self.lines)

    def stack(self, names: tuple[str, ...]) -> Array:
        """(N, k) array of some columns."""
        columns = np.empty((len(self), len(names)))
        for k, name in enumerate(names):
            columns[:, k] = self.numbers[name]
        columns.setflags(write=False)
        return columns

    def note_unknown(self, notes: list[str]) -> None:
        """Append remarks that name the ignored columns and misspelt metadata."""
        notes += [f"{self.source}:{remark}" for remark in self.metadata.misspelt]
        if self.unknown:
            names = ", ".join(repr(name[:40]) for name in self.unknown)
            notes.append(f"{self.source}: column{'s' * (len(self.unknown) > 1)} not used: {names}")


def read_table(path: str | Path, schema: Schema) -> Table:
    """Read one file."""
    return parse_table(*read_bytes(path), schema)


def parse_table(data: bytes, source: str, schema: Schema) -> Table:
    """Read a table from bytes; see `read_table`."""
    data = _plain_lines(data, source, schema)
    layout = find_layout(data, source, schema)
    table = _read_rows(data, source, schema, layout)
    if not len(table):
        raise _no_rows(source, schema, layout)
    return table


def stream_table(path: str | Path, schema: Schema, block: int = _BLOCK) -> Iterator[Table]:
    """Read a file that need not fit into memory, as tables with some of its rows each; see `read_table`.

    It reads `block` bytes at a time, into which the lines above the header must fit. Before an error in a
    line, earlier blocks have been yielded.
    """
    source = source_of(path)
    layout, rows = None, False
    for data in read_blocks(path, block):
        data = _plain_lines(data, source, schema)
        if layout is None:
            layout = find_layout(data, source, schema)
        table = _read_rows(data, source, schema, layout) if data[layout.offset :].strip() else None
        if table is not None and len(table):
            rows = True
            yield table
        # The first line of the next block follows the last line of this one.
        layout = replace(layout, offset=0, line=layout.line + data.count(b"\n", layout.offset))
    if layout is None:
        find_layout(b"", source, schema)  # raises the error about an empty file
    elif not rows:
        raise _no_rows(source, schema, layout)


def _no_rows(source: str, schema: Schema, layout: Layout) -> FormatError:
    return FormatError(f"there are no {schema.kind} below the header; add rows", source, layout.line)


def _plain_lines(data: bytes, source: str, schema: Schema) -> bytes:
    r"""Remove the byte order mark and convert line ends to ``\n``; refuse bytes that are not UTF-8."""
    if not data.isascii() or b"\0" in data:
        decode(data, source, f"a CSV file of {schema.kind}", schema.instead)
    data = data.removeprefix(b"\xef\xbb\xbf")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


def _read_rows(data: bytes, source: str, schema: Schema, layout: Layout) -> Table:
    table = read_in_bulk(data, source, schema, layout) or read_line_by_line(data, source, schema, layout)
    return replace(table, numbers={**table.numbers, "Z": np.zeros(len(table))}) if layout.flat else table


def read_in_bulk(data: bytes, source: str, schema: Schema, layout: Layout) -> Table | None:
    """Read the rows below a header by NumPy; None if NumPy may read them wrongly."""
    if not _is_plain(data, schema, layout):
        return None
    n_lines = data.count(b"\n", layout.offset) + (not data.endswith(b"\n"))
    kinds = {name: "O" if name in schema.labels else "f8" for name in schema.known}
    stream = io.BytesIO(data)
    stream.seek(layout.offset)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            records = np.loadtxt(
                stream,
                dtype=[(f"c{k}", kinds.get(name, "U1")) for k, name in enumerate(layout.names)],
                delimiter=layout.separator,
                comments=None,
                max_rows=n_lines,
                ndmin=1,
                encoding="ascii",
            )
        except (ValueError, Warning):
            return None
    columns = {name: records[f"c{k}"] for k, name in enumerate(layout.names) if name in kinds}
    labels = {name: column.astype(str) for name, column in columns.items() if name in schema.labels}
    numbers = {name: column for name, column in columns.items() if name not in schema.labels}
    if len(records) != n_lines or any((column == "").any() for column in labels.values()):
        return None  # NumPy skips blank lines
    if not all(np.isfinite(column).all() for column in numbers.values()):
        return None
    lines = np.arange(layout.line + 1, layout.line + 1 + n_lines, dtype=np.int64)
    return Table(source, numbers, labels, lines, layout.metadata, layout.unknown(schema))


def _is_plain(data: bytes, schema: Schema, layout: Layout) -> bool:
    """Whether NumPy and `read_line_by_line` split all rows alike."""
    separator = layout.separator
    before = max(layout.offset - 1, 0)  # includes the line end before the first row
    if layout.offset >= len(data) or data.translate(None, _PLAIN):
        return False
    if data.find(b"#", layout.offset) >= 0 and data.find(b"\n#", before) >= 0:
        return False
    if separator is None:
        return True
    if data.find(b" ", layout.offset) >= 0 and any(name in schema.labels for name in layout.names):
        return False  # NumPy would keep the blanks around labels
    return separator == "\t" or data.find(b"\t", layout.offset) < 0


def read_line_by_line(data: bytes, source: str, schema: Schema, layout: Layout) -> Table:
    """Read the rows below a header, in any form that the format allows; errors name the first wrong line."""
    places = [(name, k) for k, name in enumerate(layout.names) if name in schema.known]
    columns: dict[str, list[Any]] = {name: [] for name, _ in places}
    lines: list[int] = []
    text = data[layout.offset :].decode("utf-8")
    number = layout.line
    try:
        for number, line in enumerate(text.split("\n"), start=layout.line + 1):
            if fields := _fields(line, number, layout):
                for name, k in places:
                    value = _label if name in schema.labels else _number
                    columns[name].append(value(fields[k], name))
                lines.append(number)
    except InputError as error:
        raise FormatError(str(error), source, number) from error
    labels = {name: np.array(columns.pop(name), dtype=np.str_) for name in schema.labels & columns.keys()}
    numbers = {name: np.array(column, dtype=float) for name, column in columns.items()}
    rows = np.array(lines, dtype=np.int64)
    return Table(source, numbers, labels, rows, layout.metadata, layout.unknown(schema))


def _fields(line: str, number: int, layout: Layout) -> list[str]:
    """Fields of a row; none of a blank line, or of metadata, which are read."""
    line = line.strip(" \t") if layout.separator != "\t" else line.strip(" ")
    if not line.strip("\t"):
        return []
    if line.startswith("#"):
        layout.metadata.take(line, number)
        return []
    fields, expected = split_fields(line, layout.separator), len(layout.names)
    if len(fields) != expected:
        advice = decimal_commas(len(fields), expected, layout.separator) or "complete or remove the row"
        raise InputError(
            f"expected {expected} values ({one_line(','.join(layout.names)[:80])}), found {len(fields)}; "
            f"{advice}"
        )
    return fields


def _label(text: str, name: str) -> str:
    if not text:
        raise InputError(f"{name} is empty; fill it in or leave the column out")
    return text


def _number(text: str, name: str) -> float:
    if is_number(text) and math.isfinite(value := float(text)):
        return value
    if not text:
        raise InputError(f"{name} is empty; fill it in or remove the row")
    if is_decimal_comma(text):
        point = text[:40].replace(",", ".")
        raise InputError(f"{name} is {text[:40]!r}, with a decimal comma; write {point}")
    if is_number(text) or text.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        raise InputError(f"{name} is {text[:40]}, but must be a finite number; correct or remove the row")
    raise InputError(f"{name} is {text[:40]!r}, not a number; correct or remove the row")

"""Tables of numbers and labels as text, columns found by name: what all our CSV files share.

`read_table` tries a fast reader, which takes well-formed ASCII files without quotes only and
gives up on anything else, and then a careful one, which takes everything allowed and finds the
line to complain about. Both give the same table.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import FormatError
from neurocal_cli.geometry import Array
from neurocal_cli.io.files import decode, read_bytes
from neurocal_cli.io.table_careful import read_carefully
from neurocal_cli.io.table_fast import read_fast
from neurocal_cli.io.table_layout import Layout, Metadata, Schema, find_layout

__all__ = ["Schema", "Table", "parse_rows", "plain_lines", "read_table"]

Labels = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one file.

    Attributes
    ----------
    source : str
        The file's name for messages.
    numbers : dict of (N,) arrays by column name
    labels : dict of (N,) str arrays by column name
    lines : (N,) int array
        Line of each row.
    metadata : Metadata
        From the lines that begin with ``#``.
    unknown : tuple of str
        Names of columns that were kept out.
    """

    source: str
    numbers: dict[str, Array]
    labels: dict[str, Labels]
    lines: NDArray[np.int64]
    metadata: Metadata
    unknown: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.lines)

    def stack(self, names: tuple[str, ...]) -> Array:
        """(N, k) array of some columns."""
        first = self.numbers[names[0]]
        columns = np.empty((len(first), len(names)))
        for k, name in enumerate(names):
            columns[:, k] = self.numbers[name]
        columns.setflags(write=False)
        return columns


def read_table(path: str | Path, schema: Schema) -> Table:
    """Read one file.

    Parameters
    ----------
    path : str or Path
        ``-`` is stdin.
    schema : Schema
        The columns to look for.

    Raises
    ------
    FormatError
        The file cannot be read, or a line of it is wrong; the message names the line.
    """
    data, source = read_bytes(path)
    return parse_table(data, source, schema)


def parse_table(data: bytes, source: str, schema: Schema) -> Table:
    """Read a table from bytes; see `read_table`."""
    data = plain_lines(data, source, schema)
    layout = find_layout(data, source, schema)
    table = parse_rows(data, source, schema, layout)
    if not len(table):
        raise FormatError(f"there are no {schema.kind} below the header; add rows", source, layout.line)
    return table


def plain_lines(data: bytes, source: str, schema: Schema) -> bytes:
    r"""UTF-8 without a mark and with ``\n`` line ends.

    Raises
    ------
    FormatError
        Bytes that are not UTF-8.
    """
    if not data.isascii() or b"\0" in data:
        decode(data, source, f"a CSV file of {schema.kind}")  # refuses what is not UTF-8
    data = data.removeprefix(b"\xef\xbb\xbf")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data


def parse_rows(data: bytes, source: str, schema: Schema, layout: Layout) -> Table:
    """Read the rows below a header, if there are any."""
    columns = read_fast(data, layout, schema) or read_carefully(data, layout, schema, source)
    return Table(
        source, columns.numbers, columns.labels, columns.lines, columns.metadata, layout.unknown(schema)
    )

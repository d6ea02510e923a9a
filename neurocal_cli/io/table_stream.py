"""Tables that need not fit into memory, block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from neurocal_cli.errors import FormatError
from neurocal_cli.io.files import one_line, read_blocks
from neurocal_cli.io.table import Schema, Table, parse_rows, plain_lines
from neurocal_cli.io.table_layout import find_layout

__all__ = ["stream_table"]

_BLOCK = 1 << 22  # bytes: some ten thousand rows


def stream_table(path: str | Path, schema: Schema, block: int = _BLOCK) -> Iterator[Table]:
    """Read a file as a sequence of tables with some of its rows each; see `table.read_table`.

    Parameters
    ----------
    path : str or Path
        ``-`` is stdin.
    schema : Schema
    block : int
        Bytes to read at a time; the lines above the header must fit into them.

    Raises
    ------
    FormatError
        The file cannot be read, or a line of it is wrong; the rows before it have come by then.
    """
    source = "<stdin>" if str(path) == "-" else one_line(path)
    layout, rows = None, False
    for data in read_blocks(path, block):
        data = plain_lines(data, source, schema)
        if layout is None:
            layout = find_layout(data, source, schema)
        table = parse_rows(data, source, schema, layout) if data[layout.offset :].strip() else None
        if table is not None and len(table):
            rows = True
            yield table
        # The next block's first line follows on this one's last.
        layout = replace(layout, offset=0, line=layout.line + data.count(b"\n", layout.offset))
    if layout is None:
        find_layout(b"", source, schema)  # says that the file is empty
    elif not rows:
        raise FormatError(f"there are no {schema.kind} below the header; add rows", source, layout.line)

"""Rows of a well-formed table, in bulk: about a million rows a second.

NumPy's C reader does the work. It is laxer than our format, so every file in which the two could
differ (quotes, comments among the rows, blank lines, other alphabets, ...) is left to the careful
reader.
"""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.io.table_layout import Columns, Layout, Schema

__all__ = ["read_fast"]

# Printable ASCII without quotes, tabs and line ends: nothing here is blank in one reader's eyes only.
_PLAIN = bytes(c for c in range(32, 127) if c != ord('"')) + b"\t\n"
_SAMPLE = 1 << 16  # bytes at each end of the file from which the labels' width is guessed
_WIDEST = 64  # characters; longer labels are rare and would cost memory


def read_fast(data: bytes, layout: Layout, schema: Schema) -> Columns | None:
    r"""Read the rows below a header, or return None when the file is not of the plain kind.

    Parameters
    ----------
    data : bytes
        The whole file, ``\\n`` line ends.
    layout : Layout
    schema : Schema
    """
    if not _is_plain(data, layout, schema):
        return None
    n_lines = data.count(b"\n", layout.offset) + (not data.endswith(b"\n"))
    widths = _guess_widths(data, layout, schema)
    while widths is not None:
        records = _load(data, layout, schema, widths, n_lines)
        if records is None or len(records) != n_lines:  # NumPy skips blank lines
            return None
        labels = {name: np.ascontiguousarray(records[f"c{k}"]) for name, k in _places(layout, schema.labels)}
        full = {name for name, column in labels.items() if _characters(column)[:, -1].any()}
        if not full:
            return _columns(records, labels, layout, schema)
        widths = _widened(widths, full)  # these may have been cut off
    return None


def _is_plain(data: bytes, layout: Layout, schema: Schema) -> bool:
    separator = layout.separator
    before = max(layout.offset - 1, 0)  # so that the first line has a line end in front, too
    if layout.offset >= len(data) or data.translate(None, _PLAIN):
        return False
    if data.find(b"#", layout.offset) >= 0 and data.find(b"\n#", before) >= 0:
        return False
    if separator is None:
        return True
    if data.find(b" ", layout.offset) >= 0 and any(name in schema.labels for name in layout.names):
        # Labels would keep the blanks around them.
        mark = separator.encode()
        blanks = (mark + b" ", b" " + mark, b"\n ", b" \n")
        if any(data.find(blank, before) >= 0 for blank in blanks) or data.endswith(b" "):
            return False
        if data[layout.offset : layout.offset + 1] == b" ":
            return False
    return separator == "\t" or data.find(b"\t", layout.offset) < 0


def _places(layout: Layout, wanted: frozenset[str]) -> list[tuple[str, int]]:
    return [(name, k) for k, name in enumerate(layout.names) if name in wanted]


def _guess_widths(data: bytes, layout: Layout, schema: Schema) -> dict[str, int] | None:
    places = _places(layout, schema.labels)
    if not places:
        return {}
    head = data[layout.offset : layout.offset + _SAMPLE]
    tail = data[max(layout.offset, len(data) - _SAMPLE) :]
    separator = None if layout.separator is None else layout.separator.encode()
    # One more than the longest: a label that fills its place may have been cut off.
    widths = {name: 2 for name, _ in places}
    for line in (head + b"\n" + tail).split(b"\n"):
        fields = line.split(separator)
        if len(fields) == len(layout.names):
            for name, k in places:
                widths[name] = max(widths[name], len(fields[k]) + 1)
    return widths if max(widths.values()) <= _WIDEST else None


def _widened(widths: dict[str, int], full: set[str]) -> dict[str, int] | None:
    wider = {name: width * 2 if name in full else width for name, width in widths.items()}
    return wider if max(wider.values()) <= _WIDEST else None


def _load(
    data: bytes, layout: Layout, schema: Schema, widths: dict[str, int], n_lines: int
) -> NDArray[Any] | None:
    """Load records with the fields c0, c1, ...; None where NumPy finds a fault."""
    known = set(schema.known)
    kinds = [
        f"U{widths[name]}" if name in widths else "f8" if name in known else "U1" for name in layout.names
    ]
    stream = io.BytesIO(data)
    stream.seek(layout.offset)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.loadtxt(
                stream,
                dtype=[(f"c{k}", kind) for k, kind in enumerate(kinds)],
                delimiter=layout.separator,
                comments=None,
                max_rows=n_lines,
                ndmin=1,
                encoding="ascii",
            )
        except (ValueError, Warning):
            return None


def _columns(
    records: NDArray[Any], labels: dict[str, NDArray[Any]], layout: Layout, schema: Schema
) -> Columns | None:
    number_names = frozenset(schema.known) - schema.labels
    numbers = {name: records[f"c{k}"] for name, k in _places(layout, number_names)}
    if not all(np.isfinite(column).all() for column in numbers.values()):
        return None
    for name, column in labels.items():
        characters = _characters(column)
        if not characters[:, 0].all():  # an empty label
            return None
        width = column.dtype.itemsize // 4
        while width > 1 and not characters[:, width - 1].any():
            width -= 1
        labels[name] = column.astype(f"U{width}")
    lines = np.arange(layout.line + 1, layout.line + 1 + len(records), dtype=np.int64)
    return Columns(numbers, labels, lines, layout.metadata)


def _characters(column: NDArray[Any]) -> NDArray[np.uint32]:
    """(N, width) code points of a label column, 0 beyond the end of a label."""
    return column.view(np.uint32).reshape(len(column), -1)

"""Rows of any table, line by line: slower, and able to say which line is wrong and why."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from neurocal_cli.errors import FormatError
from neurocal_cli.io.files import one_line
from neurocal_cli.io.table_layout import Columns, Layout, Schema, is_decimal_comma, is_number, split_fields

__all__ = ["read_carefully"]


def read_carefully(data: bytes, layout: Layout, schema: Schema, source: str) -> Columns:
    r"""Read the rows below a header.

    Parameters
    ----------
    data : bytes
        The whole file, ``\\n`` line ends.
    layout : Layout
    schema : Schema
    source : str
        Name for messages.

    Raises
    ------
    FormatError
        The first line that is wrong.
    """
    places = [(name, k) for k, name in enumerate(layout.names) if name in schema.known]
    texts: dict[str, list[str]] = {name: [] for name, _ in places if name in schema.labels}
    values: dict[str, list[float]] = {name: [] for name, _ in places if name not in schema.labels}
    lines: list[int] = []
    for number, fields in _rows(data, layout, source):
        for name, k in places:
            if name in texts:
                texts[name].append(_label(fields[k], name, source, number))
            else:
                values[name].append(_number(fields[k], name, source, number))
        lines.append(number)
    return Columns(
        {name: np.array(column, dtype=float) for name, column in values.items()},
        {name: np.array(column, dtype=np.str_) for name, column in texts.items()},
        np.array(lines, dtype=np.int64),
        layout.metadata,
    )


def _rows(data: bytes, layout: Layout, source: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of each row; metadata among them is taken note of."""
    expected = len(layout.names)
    text = data[layout.offset :].decode("utf-8")
    for number, line in enumerate(text.split("\n"), start=layout.line + 1):
        line = line.strip(" \t") if layout.separator != "\t" else line.strip(" ")
        if not line.strip("\t"):
            continue
        if line.startswith("#"):
            layout.metadata.take(line, source, number)
            continue
        fields = split_fields(line, layout.separator)
        if fields is None:
            raise FormatError('a quote (") is not closed; close it', source, number)
        if len(fields) != expected:
            raise FormatError(
                f"expected {expected} values ({one_line(','.join(layout.names)[:80])}), found {len(fields)}; "
                "complete or remove the row",
                source,
                number,
            )
        yield number, fields


def _label(text: str, name: str, source: str, line: int) -> str:
    if not text:
        raise FormatError(f"{name} is empty; fill it in or leave the column out", source, line)
    return text


def _number(text: str, name: str, source: str, line: int) -> float:
    if is_number(text):
        value = float(text)
        if math.isfinite(value):
            return value
    raise FormatError(_complaint(text, name), source, line)


def _complaint(text: str, name: str) -> str:
    if not text:
        return f"{name} is empty; fill it in or remove the row"
    if is_decimal_comma(text):
        return f"{name} is {text[:40]!r}, with a decimal comma; write {text[:40].replace(',', '.')}"
    if is_number(text) or text.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return f"{name} is {text[:40]}, but must be a finite number; correct or remove the row"
    return f"{name} is {text[:40]!r}, not a number; correct or remove the row"

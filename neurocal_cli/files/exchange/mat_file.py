"""MATLAB's ``.mat`` files of versions 5 to 7.

``scipy.io.loadmat`` is not used, because damaged files crash it. The format is MathWorks' "MAT-File Format":
each element has a type, a length and data, and matrices consist of further elements.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from neurocal_cli.errors import FormatError

MARK = b"MATLAB 5.0 MAT-file"
_HEADER = 128  # bytes
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXT_TYPES = {2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16", 1: "utf-8"}
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMBERS = range(6, 16)  # double to uint64
_DEEPEST = 12
_MOST_BYTES = 500_000_000  # unpacked


def read_variables(data: bytes, source: str) -> dict[str, Any]:
    """Read the variables of a file of version 5 to 7: arrays, strings, lists for cells and dicts for structs.

    Objects of classes are left out.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise FormatError("is no .mat file of version 5 to 7; save it again with -v7", source)
    variables = {}
    try:
        for kind, content in _elements(data[_HEADER:], order, padded=False):
            if kind == _COMPRESSED:
                unpacker = zlib.decompressobj()
                content = unpacker.decompress(content, _MOST_BYTES)
                if unpacker.unconsumed_tail:
                    raise ValueError("too large")
                ((kind, content),) = _elements(content, order)
            if kind != _MATRIX:
                raise ValueError("no matrix")
            name, value = _matrix(content, order, _DEEPEST)
            if value is not None:
                variables[name] = value
    except (struct.error, ValueError, KeyError, IndexError, zlib.error, UnicodeError, OverflowError) as error:
        raise FormatError("is a damaged .mat file; save it again with -v7", source) from error
    return variables


def _elements(data: bytes, order: str, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """Iterate over types and contents of elements, which are padded to 8 bytes unless compressed."""
    k = 0
    while k < len(data):
        (word,) = struct.unpack_from(f"{order}I", data, k)
        if word >> 16:  # small element: type and length in one word, and the content in the next
            kind, count, start, step = word & 0xFFFF, word >> 16, k + 4, 8
            if count > 4:
                raise ValueError("too long")
        else:
            (count,) = struct.unpack_from(f"{order}I", data, k + 4)
            kind, start = word, k + 8
            step = 8 + (count if kind == _COMPRESSED and not padded else -(-count // 8) * 8)
        if start + count > len(data):
            raise ValueError("cut off")
        yield kind, data[start : start + count]
        k += step


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix; the value is None for unsupported classes."""
    if depth == 0:
        raise ValueError("nested too deeply")
    if not data:
        return "", np.zeros((0, 0))
    parts = list(_elements(data, order))
    kind = struct.unpack(f"{order}II", parts[0][1])[0] & 0xFF
    if kind not in (_CELL, _STRUCT, _CHAR, *_NUMBERS):
        return "", None
    shape = _values(parts[1], order).tolist()
    count = int(np.prod(shape, dtype=object))
    if len(shape) < 2 or min(shape) < 0 or count > _MOST_BYTES:
        raise ValueError("no shape")
    name = parts[2][1].decode("ascii")
    if kind == _CHAR:
        form, content = parts[3] if len(parts) > 3 else (1, b"")
        encoding = _TEXT_TYPES[form]
        if encoding == "utf-16":
            encoding += "-le" if order == "<" else "-be"
        return name, content.decode(encoding)
    if kind == _CELL:
        return name, [_matrix(content, order, depth - 1)[1] for _, content in parts[3 : 3 + count]]
    if kind == _STRUCT:
        length = int(_values(parts[3], order)[0])
        if length <= 0:
            raise ValueError("no names")
        names = [
            parts[4][1][k : k + length].split(b"\0")[0].decode("ascii")
            for k in range(0, len(parts[4][1]), length)
        ]
        values = [_matrix(content, order, depth - 1)[1] for _, content in parts[5:]]
        if count != 1 or len(values) != len(names):
            return name, None  # an array of structs
        return name, {key: value for key, value in zip(names, values, strict=True) if value is not None}
    return name, _values(parts[3], order).astype(float).reshape(shape, order="F")


def _values(part: tuple[int, bytes], order: str) -> np.ndarray[Any, Any]:
    kind, content = part
    return np.frombuffer(content, dtype=np.dtype(order + _TYPES[kind]))


def lists(value: Any) -> Any:
    """Nested lists for matrices, lists for rows and columns, and numbers for single ones."""
    if isinstance(value, dict):
        return {key: lists(entry) for key, entry in value.items()}
    if not isinstance(value, np.ndarray):
        return value
    if value.size == 1:
        return float(value.item())
    return (value.ravel() if value.ndim == 2 and 1 in value.shape else value).tolist()


def saved(tree: dict[str, Any]) -> bytes:
    """Write a ``.mat`` file of variables; the same variables give the same file."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, tree, oned_as="row")
    # The first 116 bytes are a comment with the current date.
    return (MARK + b", written by neurocal").ljust(116) + buffer.getvalue()[116:]

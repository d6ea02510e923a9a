"""Write text for OpenCV's ``cv2.FileStorage``: YAML, XML or JSON, depending on the file's extension."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.io.yaml_text import number, quoted

_PER_LINE = 4  # numbers; OpenCV's reader refuses lines of more than some thousand characters


def storage_text(entries: Mapping[str, Any], ending: str = ".yaml") -> str:
    """Write names and values as a FileStorage.

    Parameters
    ----------
    entries : dict
        Strings, numbers, lists of strings, and matrices: (rows, cols) or (rows, cols, channels) arrays.
    ending : str
        ``.xml`` or ``.json``; YAML otherwise.
    """
    if ending == ".xml":
        body = "\n".join(_xml(key, value) for key, value in entries.items())
        return f'<?xml version="1.0"?>\n<opencv_storage>\n{body}\n</opencv_storage>\n'
    if ending == ".json":
        body = ",\n".join(f"    {json.dumps(key)}: {_json(value)}" for key, value in entries.items())
        return f"{{\n{body}\n}}\n"
    body = "\n".join(_yaml(key, value) for key, value in entries.items())
    return f"%YAML:1.0\n---\n{body}\n"


def _rows(matrix: Array, indent: str, separator: str) -> str:
    return _lines([number(value) for value in np.ravel(matrix)], indent, separator)


def _lines(words: list[str], indent: str, separator: str) -> str:
    lines = [separator.join(words[k : k + _PER_LINE]) for k in range(0, len(words), _PER_LINE)]
    return f"{separator.rstrip()}\n{indent}".join(lines)


def _type(matrix: Array) -> str:
    """Type of a matrix of doubles; with several channels in quotes, because 2d begins like a number."""
    return "d" if matrix.ndim == 2 else f'"{matrix.shape[2]}d"'


def _yaml(key: str, value: Any) -> str:
    if isinstance(value, np.ndarray):
        rows, cols = value.shape[:2]
        data = _rows(value, "       ", ", ")
        head = f"rows: {rows}\n   cols: {cols}\n   dt: {_type(value)}"
        return f"{key}: !!opencv-matrix\n   {head}\n   data: [ {data} ]"
    if isinstance(value, list):
        return f"{key}: [ {_lines([quoted(entry) for entry in value], '       ', ', ')} ]"
    return f"{key}: {quoted(value) if isinstance(value, str) else value}"


def _json(value: Any) -> str:
    if isinstance(value, np.ndarray):
        rows, cols = value.shape[:2]
        data = _rows(value, "            ", ", ")
        kind = '"d"' if value.ndim == 2 else _type(value)
        head = f'"type_id": "opencv-matrix", "rows": {rows}, "cols": {cols}, "dt": {kind}'
        return f'{{ {head},\n        "data": [ {data} ] }}'
    return json.dumps(value, ensure_ascii=False)


def _xml(key: str, value: Any) -> str:
    if isinstance(value, np.ndarray):
        rows, cols = value.shape[:2]
        data = _rows(value, "    ", " ")
        head = f"<rows>{rows}</rows>\n  <cols>{cols}</cols>\n  <dt>{_type(value)}</dt>"
        return f'<{key} type_id="opencv-matrix">\n  {head}\n  <data>\n    {data}</data></{key}>'
    if isinstance(value, list):
        return "\n".join([f"<{key}>", *(f"  <_>{_xml_text(entry)}</_>" for entry in value), f"</{key}>"])
    return f"<{key}>{_xml_text(value) if isinstance(value, str) else value}</{key}>"


def _xml_text(text: str) -> str:
    """Quote a string, so that it is not read as a number or as several words."""
    return '"' + escape(text, {'"': "&quot;"}) + '"'

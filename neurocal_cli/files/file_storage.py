"""The three formats of OpenCV's FileStorage, YAML, JSON and XML: read trees, and write matrices."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import DEEPEST, TOO_DEEP, number, parse_yaml, plain_value, quoted

# Comments of JSON, outside texts, which are found first; with the commas before a closing bracket.
_COMMENT = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/|,(?=\s*[}\]])', re.DOTALL)
_PER_LINE = 4  # numbers; OpenCV's reader refuses lines of more than some thousand characters


def read_tree(path: str | Path) -> Field:
    """Read a YAML, JSON or XML file; the format is recognised by the content."""
    return parse_tree(*read_text(path, "a camera file"))


def parse_tree(text: str, source: str) -> Field:
    """Read the text of a YAML, JSON or XML file; see `read_tree`."""
    parse = {"<": _parse_xml, "{": _parse_json, "[": _parse_json, "/": _parse_json}
    return Field(parse.get(text.lstrip()[:1], parse_yaml)(text, source), source)


def _parse_json(text: str, source: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_distinct)
    except json.JSONDecodeError:
        if (plain := _COMMENT.sub(lambda found: found[1] or "", text)) != text:
            return _parse_json(plain, source)
        return parse_yaml(text, source)  # a flow mapping may be YAML; its parser names the line
    except (ValueError, RecursionError) as error:
        problem = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise FormatError(f"is not valid JSON ({problem}); correct it", source) from error


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        raise ValueError("a key appears twice")
    return tree


def xml_root(text: str, source: str) -> ElementTree.Element:
    """The root of an XML file without entities, which can expand to gigabytes."""
    if "<!" in text.replace("<!--", ""):
        raise FormatError("has a DOCTYPE, ENTITY or CDATA section, which is not read; remove it", source)
    try:
        return ElementTree.fromstring(text.encode("utf-8"))
    except ElementTree.ParseError as error:
        raise FormatError(f"is not valid XML ({error.msg}); correct it", source, error.position[0]) from error
    except (ValueError, LookupError) as error:  # the stated encoding is unknown or not UTF-8
        raise FormatError("is not XML in UTF-8; save it as UTF-8", source) from error


def _parse_xml(text: str, source: str) -> Any:
    root = xml_root(text, source)
    if root.tag == "calibration" and (
        root.find("projection") is not None or root.find("f") is not None
    ):  # Agisoft's
        return {root.tag: _element_value(root, source, DEEPEST)}
    if root.tag != "opencv_storage":
        raise FormatError(
            f"is <{root.tag[:40]}> and not OpenCV's <opencv_storage>; give another file", source
        )
    return _element_value(root, source, DEEPEST)


def _element_value(element: ElementTree.Element, source: str, depth: int) -> Any:
    if depth == 0:
        raise FormatError(TOO_DEEP, source)
    if len(element) == 0:
        text = (element.text or "").strip()
        if len(text) > 1 and text[0] == text[-1] == '"' and '"' not in text[1:-1]:
            return text[1:-1]  # quoted, so it stays text even if it looks like a number
        words = text.split()
        if element.tag == "data" or len(words) > 1:
            return [plain_value(word) for word in words]
        return plain_value(words[0]) if words else None
    if all(child.tag == "_" for child in element):
        return [_element_value(child, source, depth - 1) for child in element]
    tree: dict[str, Any] = {}
    for child in element:
        if child.tag in tree:
            raise FormatError(f"the element <{child.tag[:40]}> appears twice; remove one", source)
        tree[child.tag] = _element_value(child, source, depth - 1)
    return tree


def storage_text(entries: Mapping[str, Any], ending: str = ".yaml") -> str:
    """Write texts, numbers, lists of texts and (rows, cols[, channels]) arrays as .xml, .json or YAML."""
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
    from xml.sax.saxutils import escape  # imports what reading a calibration does not need

    return '"' + escape(text, {'"': "&quot;"}) + '"'

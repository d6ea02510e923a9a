"""Trees of cameras as OpenCV and ROS have them: FileStorage, its matrices, and camera_info.

OpenCV's FileStorage has three forms, YAML, JSON and XML. ROS's camera_info are the keys that begin a
calibration file; ROS has no names for wide lenses other than the fisheye, nor for thin prism and tilted
sensor, and ours are kept.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import checked_size
from neurocal_cli.camera.opencv_names import to_ros
from neurocal_cli.errors import FormatError, InputError, value_failures
from neurocal_cli.files.key_tables import Keys, inline, not_read
from neurocal_cli.files.reading import read_text
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import (
    DEEPEST,
    TOO_DEEP,
    flow,
    mapping,
    number,
    parse_yaml,
    plain_value,
    quoted,
    text,
)

if TYPE_CHECKING:
    from neurocal_cli.camera.undistortion import Panorama

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


def own_kind(root: Field) -> str:
    """What a file of neurocal holds: a ``camera``, a ``stereo`` rig, a ``rig``, a ``lens``; "" for others."""
    keys = {"neurocal_lens": "lens", "stereo": "stereo", "rig": "rig", "neurocal": "camera"}
    return next((kind for key, kind in keys.items() if key in root), "")


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
    agisoft = root.find("projection") is not None or root.find("f") is not None
    if root.tag == "calibration" and agisoft:
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


_PACKED = "$base64$"
_FORMULAS = {
    "cylinder": "u = f atan2(X, Z) + u0, v = f Y / hypot(X, Z) + v0",
    "equirectangular": "u = f atan2(X, Z) + u0, v = f atan2(Y, hypot(X, Z)) + v0",
}


def matrix_data(field: Field, length: int) -> Array:
    """Read matrices in row order: rows, cols and data, or lists of any depth; any `length` if it is -1."""
    if isinstance(field.value, dict) and "rows" not in field and "data" in field:
        return matrix_data(field["data"], length)
    if isinstance(field.value, dict):
        numbers = field["data"]
        first = numbers.value[0] if isinstance(numbers.value, list) and numbers.value else numbers.value
        if isinstance(first, str) and first.startswith((_PACKED, "MW")):  # MW begins the head "1d"
            numbers = Field(_unpacked(numbers), field.source, numbers.path)
        data = matrix_data(numbers, -1)
        rows, cols = field["rows"].integer(), field["cols"].integer()
        head = str(field["dt"].value)[:-1] if "dt" in field else ""
        channels = int(head) if head.isdigit() else 1  # dt: "2f" has two
        if length < 0 and not data[rows * cols * channels :].any():
            data = data[: rows * cols * channels]  # ROS reads no more
        if rows * cols * channels != len(data) or (length == 9 and rows != 3):
            raise InputError(f"{field.path} has {rows} rows, {cols} cols and {len(data)} numbers; correct it")
    elif isinstance(field.value, list) and field.value and isinstance(field.value[0], dict):
        # A matrix for each view.
        data = np.concatenate([matrix_data(entry, -1) for entry in field.items()])
    elif isinstance(field.value, list) and field.value and isinstance(field.value[0], list):
        deep, first = 0, field.value
        while isinstance(first, list):
            deep, first = deep + 1, first[0] if first else None
        data = field.array(*deep * (-1,))
        if length == 9 and data.shape != (3, 3):
            field.fail("3 x 3 numbers")
        data = data.ravel()
    else:
        data = field.array(-1)
    if length >= 0 and len(data) != length:
        field.fail(f"{length} numbers")
    return data


def _unpacked(field: Field) -> list[float]:
    """Numbers of base64: a head of 24 bytes with their type, such as 1d, and the bytes of all."""
    words = field.value if isinstance(field.value, list) else field.value.split()
    try:
        data = base64.b64decode("".join(map(str, words)).removeprefix(_PACKED), validate=True)
        kind = {"d": "<f8", "f": "<f4"}[data[:24].decode().strip()[-1:]]
        return list(map(float, np.frombuffer(data[24:], kind).tolist()))
    except (ValueError, KeyError):
        field.fail("numbers, or OpenCV's base64 of them")


def _matrix(matrix: Array) -> str:
    rows, cols = matrix.shape
    return mapping(rows=str(rows), cols=str(cols), data=flow(matrix.ravel()))


_INFO = Keys(
    "camera_name!: name, image_width!: integer, image_height!: integer, camera_matrix!: square,"
    "distortion_model: model, distortion_coefficients: matrix, rectification_matrix: shown,"
    "projection_matrix: shown",
    {
        "name": inline(Field.text, text, "camera"),
        "square": inline(lambda field: field["data"].array(9).reshape(3, 3), _matrix),
        "model": inline(not_read, text),
        "matrix": inline(lambda field: field["data"].array(-1), _matrix),
        "shown": inline(not_read, _matrix),
    },
)


def camera_info_lines(camera: Camera, rectified: tuple[Array, Array] | None = None) -> Iterator[str]:
    """Lines of a camera_info; `rectified` are R (3, 3) and P (3, 4) on a rig, as ROS defines them."""
    R, P = rectified or (np.eye(3), np.column_stack([camera.A, np.zeros(3)]))
    width, height = camera.image_size or (0, 0)  # ROS's readers require numbers
    model, coefficients = to_ros(camera.distortion.model, camera.distortion.coefficients)
    values = camera.name, width, height, camera.A, model, coefficients[None], R, P
    return _INFO.lines(dict(zip(_INFO.names, values, strict=True)))


def read_camera_info(root: Field) -> tuple[str, tuple[int, int] | None, Array | None, Array]:
    """Name, image size, matrix and coefficients of a camera_info that neurocal wrote."""
    name, width, height, K, coefficients = _INFO.read(root).values()
    with value_failures(root.source):
        size = checked_size((width, height)) if width and height else None
    return name, size, K, coefficients


def format_camera_info(camera: Camera, rectified: tuple[Array, Array] | None = None) -> str:
    """Text of a camera_info file, which `read_camera` reads; see `camera_info_lines`."""
    return "\n".join([*camera_info_lines(camera, rectified), ""])


def format_panorama(panorama: Panorama) -> str:
    """Text of the file of a panorama on a cylinder or a sphere, which has no camera matrix."""
    width, height = panorama.image_size
    lines = [
        f"# A point (X, Y, Z) is seen at {_FORMULAS[panorama.shape]}.",
        f"camera_name: {text(panorama.name)}",
        f"image_width: {width}",
        f"image_height: {height}",
        f"projection: {panorama.shape}",
        f"f: {number(panorama.f)}  # px per radian",
        f"u0: {number(panorama.u0)}",
        f"v0: {number(panorama.v0)}",
    ]
    return "\n".join([*lines, ""])

"""Read trees from YAML, JSON or XML text, the three formats of OpenCV's FileStorage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

from neurocal_cli.errors import FormatError
from neurocal_cli.io.files import read_text
from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_tree import parse_yaml, plain_value

_DEEPEST = 40


def read_tree(path: str | Path) -> Field:
    """Read a YAML, JSON or XML file; the format is recognised by the content.

    Raises
    ------
    FormatError
        The file cannot be read or has a syntax error.
    """
    return parse_tree(*read_text(path, "a camera file"))


def parse_tree(text: str, source: str) -> Field:
    """Read the text of a YAML, JSON or XML file; see `read_tree`."""
    start = text.lstrip()[:1]
    if start == "<":
        return Field(_parse_xml(text, source), source)
    if start == "{":
        return Field(_parse_json(text, source), source)
    return Field(parse_yaml(text, source), source)


def _parse_json(text: str, source: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_distinct, parse_constant=_refuse)
    except json.JSONDecodeError:
        return parse_yaml(text, source)  # a flow mapping may be YAML; its parser names the line
    except (ValueError, RecursionError) as error:
        problem = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise FormatError(f"is not valid JSON ({problem}); correct it", source) from error


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        raise ValueError("a key appears twice")
    return tree


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a number")


def _parse_xml(text: str, source: str) -> Any:
    if "<!" in text.replace("<!--", ""):  # entities can expand to gigabytes; cameras need none
        raise FormatError("has a DOCTYPE, ENTITY or CDATA section, which is not read; remove it", source)
    try:
        root = ElementTree.fromstring(text.encode("utf-8"))
    except ElementTree.ParseError as error:
        raise FormatError(f"is not valid XML ({error.msg}); correct it", source, error.position[0]) from error
    except (ValueError, LookupError) as error:  # the stated encoding is unknown or not UTF-8
        raise FormatError("is not XML in UTF-8; save it as UTF-8", source) from error
    if root.tag != "opencv_storage":
        raise FormatError(
            f"is <{root.tag[:40]}> and not OpenCV's <opencv_storage>; give another file", source
        )
    return _element_value(root, source, _DEEPEST)


def _element_value(element: ElementTree.Element, source: str, depth: int) -> Any:
    if depth == 0:
        raise FormatError("is nested too deeply to be a camera file; give another", source)
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

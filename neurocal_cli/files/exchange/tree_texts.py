"""Trees as the text of JSON, YAML and TOML, and reading and writing of formats with one camera."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from neurocal_cli.files.exchange.camera_keys import CameraKeys
from neurocal_cli.files.exchange.camera_set import CameraSet
from neurocal_cli.files.exchange.document import Document
from neurocal_cli.files.yaml_text import flow, number, text

K4 = ("k1", "k2", "k3", "k4")
RADTAN = ("k1", "k2", "p1", "p2")
FIVE, EIGHT = (*RADTAN, "k3"), (*RADTAN, "k3", "k4", "k5", "k6")


def under(prefix: str, *names: str) -> tuple[str, ...]:
    """Paths of names that begin alike."""
    return tuple(prefix + name for name in names)


# Writing trees.


def json_text(tree: Any) -> str:
    """A tree as JSON."""
    return json.dumps(tree, indent=1, allow_nan=False) + "\n"


def yaml_text(tree: Mapping[str, Any], head: str = "") -> str:
    """A tree as YAML, below the lines `head`."""
    return head + "".join(f"{line}\n" for line in _yaml_lines(tree))


def _yaml_lines(tree: Mapping[str, Any]) -> list[str]:
    lines = []
    for key, value in tree.items():
        if isinstance(value, dict):
            lines += [f"{key}:", *(f"   {line}" for line in _yaml_lines(value))]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            lines.append(f"{key}:")
            for entry in value:
                first, *rest = _yaml_lines(entry)
                lines += [f" - {first}", *(f"   {line}" for line in rest)]
        else:
            lines.append(f"{key}: {_yaml_value(value)}")
    return lines


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, str)):
        return str(value) if isinstance(value, int) else text(value)
    if isinstance(value, list) and all(isinstance(entry, int) for entry in value):
        return str(value)
    return number(value) if isinstance(value, float) else flow(np.array(value))


def toml_text(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Tables of texts, numbers and lists as TOML."""
    parts = []
    for name, table in tables.items():
        parts += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items()), ""]
    return "\n".join(parts)


def single(
    keys: CameraKeys, write: Callable[[dict[str, Any]], str]
) -> Callable[[CameraSet, str], dict[str, str | bytes]]:
    """The writer of a format with one camera and nothing else."""
    return lambda cameras, _: {"": write(keys.tree(cameras.cameras[0]))}


def one(keys: CameraKeys) -> Callable[[Document], CameraSet]:
    """The reader of a format with one camera and nothing else."""
    return lambda document: CameraSet((keys.camera(document.root),), program=keys.program)

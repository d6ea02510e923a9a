"""What the values in a dictionary of a camera may be: numbers, matrices, and entries of one."""

from __future__ import annotations

from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.files.exchange.camera_names import CENTRE, ENTRIES, FOCAL, PARAMETERS, plain
from neurocal_cli.files.tree_fields import is_number

_MOST = 100.0  # of a coefficient


def is_numbers(value: Any) -> bool:
    """Whether this is a number, a list of numbers at any depth, a matrix, or x and y."""
    if isinstance(value, dict):
        return "data" in value or (value.keys() == {"x", "y"} and all(map(is_numbers, value.values())))
    if isinstance(value, (list, tuple)):
        return bool(value) and all(map(is_numbers, value))
    if isinstance(value, str):
        return is_number(value) is not None
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _count(value: Any) -> int:
    if isinstance(value, dict):
        return _count(value.get("data", []))
    return sum(map(_count, value)) if isinstance(value, (list, tuple)) else 1


def is_matrix(value: Any) -> bool:
    """Whether these are nine numbers in any form."""
    return not isinstance(value, (int, float, str)) and is_numbers(value) and _count(value) == 9


def is_four(value: Any) -> bool:
    """Whether this is a list of fx, fy, cx, cy."""
    return isinstance(value, list) and len(value) == 4 and all(is_number(str(entry)) for entry in value)


def has_entries(value: Any) -> bool:
    """Whether a mapping has fx, fy, cx and cy under one of their names, or the pairs of them."""
    if not isinstance(value, dict):
        return False
    names = {plain(str(key)) for key, entry in value.items() if not isinstance(entry, (dict, list))}
    pairs = {plain(str(key)) for key, entry in value.items() if is_numbers(entry)}
    one = not names.isdisjoint(FOCAL)  # for both axes
    return all(not names.isdisjoint(entry) for entry in ENTRIES[2 if one else 0 :]) or not (
        pairs.isdisjoint(FOCAL) or pairs.isdisjoint(CENTRE)
    )


def plain_lists(tree: Any, depth: int = 5) -> Any:
    """The tree with lists for the mappings 0, 1, ... of JavaScript's arrays, and for numbers in a text."""
    if isinstance(tree, str) and len(words := tree.replace(",", " ").strip(" []").split()) > 3:
        return [float(word) for word in words] if all(map(is_number, words)) else tree
    if not isinstance(tree, dict) or depth == 0:
        return tree
    if tree and all(key == str(k) and is_numbers(value) for k, (key, value) in enumerate(tree.items())):
        return list(tree.values())
    return {key: plain_lists(value, depth - 1) for key, value in tree.items()}


def parameters_apart(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with fx, fy, cx, cy and the coefficients of a list of all as keys of their own."""
    for key, value in tree.items():
        if not (isinstance(value, list) and len(value) in (4, 8, 9, 12) and plain(str(key)) in PARAMETERS):
            continue
        four, k = value[:4], value[4:]
        if all(type(n) in (int, float) for n in value) and min(four) > 1 and all(abs(n) < _MOST for n in k):
            named = dict(zip(("fx", "fy", "cx", "cy"), four, strict=True))
            if not named.keys() & tree.keys():
                own = {**named, **({"distortion_coefficients": k} if k else {})}
                return {**{name: entry for name, entry in tree.items() if name != key}, **own}
    return tree


def matrix_of(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> Array:
    """The camera matrix of its entries."""
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def flat(value: Any) -> list[float]:
    """The numbers in nested lists, or in a matrix."""
    if isinstance(value, dict):
        return flat(value["data"] if "data" in value else [value.get("x", []), value.get("y", [])])
    if isinstance(value, (list, tuple)):
        return [number for entry in value for number in flat(entry)]
    return [float(value)] if is_numbers(value) else [float("nan")]

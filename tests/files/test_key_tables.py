"""Tables of keys: what is written is read, and what is missing is named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from neurocal_cli.errors import FormatError
from neurocal_cli.files.key_tables import Keys, record
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import parse_yaml

PART = record(SimpleNamespace, Keys("a: number, b=two: integer"), inline=True)
TABLE = Keys(
    "word: text, count: integer, yes: boolean, f: number, unknown: measure, sizes: measures, curve: curve,"
    "center=centre: pair, names: names, reasons: sentences, notes: lines, pairs: pairs of texts, K: 2x3,"
    "free: n, part: part, doubled: integer, off?: boolean, choice?: measures, stretch?: number, pixel?: pair",
    {"part": PART},
    doubled=lambda value: 2 * value.count,
)


def some_values(**changed: Any) -> SimpleNamespace:
    values: dict[str, Any] = {
        "word": "null", "count": 3, "yes": True, "f": 0.1, "unknown": np.nan, "sizes": {"x": 1 / 3},
        "curve": (0.1, np.nan), "centre": (1.5, 2.5), "names": ("a", "1e5"), "reasons": ("it is: so", "b"),
        "notes": ("one", "two"), "pairs": [("a", "b"), ("c", "d")], "K": np.arange(6.0).reshape(2, 3) / 7,
        "free": np.array([1e-300, 2.0]), "part": SimpleNamespace(a=0.5, two=2), "off": False, "choice": {},
        "stretch": 0.0, "pixel": None,
    }  # fmt: skip
    return SimpleNamespace(**(values | changed))


def read(lines: list[str]) -> dict[str, Any]:
    return TABLE.read(Field(parse_yaml("\n".join(lines), "file"), "file"))


@pytest.mark.parametrize(
    "changed", [{}, {"off": True, "choice": {"k1": 0.5}, "stretch": 0.25, "pixel": (1.0, 2.0)}]
)
def test_what_is_written_is_read(changed: dict[str, Any]) -> None:
    given = some_values(**changed)
    lines = list(TABLE.lines(given))
    assert sum(line.startswith(("off", "choice", "stretch", "pixel")) for line in lines) == len(changed)
    found = read(lines)
    assert found.pop("doubled") == 6
    for name, value in vars(given).items():
        np.testing.assert_equal(found.pop(name), value)
    assert found == {}


def test_a_key_that_is_missing_or_of_another_kind_is_named() -> None:
    lines = list(TABLE.lines(some_values()))
    for k, line in enumerate(lines):
        key = line.split(":")[0]
        if key in ("notes", "pairs") or line.startswith(" "):
            continue
        with pytest.raises(FormatError, match=rf"the key {key} is missing"):
            read([*lines[:k], *lines[k + 1 :]])
        with pytest.raises(FormatError, match=rf"{key}.* must be|the key {key}\.\w is missing"):
            read([*lines[:k], f"{key}: {{odd: [1]}}", *lines[k + 1 :]])

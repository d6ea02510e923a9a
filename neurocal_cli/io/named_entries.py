"""Values by view name, as YAML.

They are a mapping if all names are valid keys of OpenCV's FileStorage. Otherwise they are a list of pairs,
because FileStorage cannot open a file with a key such as ``"01"``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from neurocal_cli.io.tree_fields import Field
from neurocal_cli.io.yaml_text import quoted, text

_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*").fullmatch


def named_lines(key: str, names: Iterable[str], values: Iterable[str]) -> Iterator[str]:
    """Lines of a key whose value has an entry for each name.

    Parameters
    ----------
    key : str
    names : iterable of str
    values : iterable of str
        As YAML flow text.
    """
    names = list(names)
    pairs = zip(names, values, strict=True)
    if not names:
        yield f"{key}: {{}}"
    elif all(_KEY(name) and text(name) == name for name in names):
        yield f"{key}:"
        yield from (f"  {name}: {value}" for name, value in pairs)
    else:
        yield f"{key}:"
        yield from (f"  - [{quoted(name)}, {value}]" for name, value in pairs)


def read_named(field: Field) -> dict[str, Field]:
    """Read either form back.

    Raises
    ------
    FormatError
        The value has neither form, or a name appears twice.
    """
    if isinstance(field.value, dict):
        return field.entries()
    found: dict[str, Field] = {}
    for entry in field.items():
        parts = list(entry.items())
        if len(parts) != 2:
            entry.fail("a name and its value")
        name = parts[0].text()
        if name in found:
            parts[0].fail("a name that no other entry has")
        found[name] = parts[1]
    return found

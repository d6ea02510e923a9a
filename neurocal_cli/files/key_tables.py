"""Tables of keys: what a block of our own files holds, written and read by the same table.

A table is a text, ``"seed: integer, center=centre?: pair"``: the names of keys, those of the attributes with
their values if they differ, and kinds. A key with ``?`` is left out of the file if its value is the empty one
of its kind, which it has if it is left out. Sizes such as ``3x4`` are arrays; ``n`` is any length.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import (
    block,
    boolean,
    flow,
    list_lines,
    mapping,
    number,
    quoted,
    quoted_words,
    words,
)
from neurocal_cli.files.yaml_text import text as plain_text

_ENTRY = re.compile(r"\s*(\w+)(?:=(\w+))?(\?)?(?::\s*([\w ]+?))?\s*").fullmatch


@frozen_dataclass(eq=False)
class Kind:
    """How values of a kind are read, and written as lines of the key, the value, and whether all is long."""

    read: Callable[[Field], Any]
    lines: Callable[[str, Any, bool], Iterable[str]]
    empty: Any = None


def inline(read: Callable[[Field], Any], write: Callable[[Any], str], empty: Any = None) -> Kind:
    """A kind whose values are texts on the line of their key."""
    return Kind(read, lambda key, value, _: [f"{key}: {write(value)}"], empty)


def array(*shape: int) -> Kind:
    """Finite numbers of a shape, in which -1 is any length."""
    return inline(lambda field: field.array(*shape), lambda value: flow(np.asarray(value)))


def _rows_of_texts(count: int = 0) -> Kind:
    def read(field: Field) -> tuple[tuple[str, ...], ...]:
        found = tuple(tuple(entry.texts()) for entry in field.items())
        for entry, names in zip(field.items() if count else (), found, strict=bool(count)):
            if len(names) != count:
                entry.fail(f"a list of {count} texts")
        return found

    return Kind(read, lambda key, values, _: list_lines(key, map(quoted_words, values)))


_TRIPLES = _rows_of_texts(3)


def _estimate(field: Field) -> tuple[float, float]:
    return field["value"].number(), field["std"].number_or_nan()


_KINDS = {
    "text": inline(Field.text, lambda value: plain_text(str.__str__(value))),
    "integer": inline(Field.integer, lambda value: str(int(value))),
    "boolean": inline(Field.boolean, boolean, False),
    "number": inline(Field.number, number, 0.0),
    "measure": inline(Field.number_or_nan, number),  # NaN is null
    "measures": inline(
        lambda field: {name: entry.number_or_nan() for name, entry in field.entries().items()},
        lambda values: mapping(**{name: number(value) for name, value in values.items()}),
        {},
    ),
    "curve": inline(
        lambda field: tuple(field.array(-1, unknown=True).tolist()),
        lambda curve: flow(np.array(curve, float)),
    ),
    "pair": inline(lambda field: tuple(field.array(2).tolist()), lambda pair: flow(np.array(pair))),
    "names": inline(lambda field: tuple(field.texts()), words),
    "sentences": inline(lambda field: tuple(field.texts()), quoted_words),
    "lines": Kind(
        lambda field: tuple(field.texts()), lambda key, values, _: list_lines(key, map(quoted, values))
    ),
    "rows of texts": _rows_of_texts(),
    "pairs of texts": _rows_of_texts(2),
    "reasons": Kind(  # why pairs of names were left out
        lambda field: {row[:2]: row[2] for row in _TRIPLES.read(field)},
        lambda key, values, long: _TRIPLES.lines(key, [(*pair, why) for pair, why in values.items()], long),
    ),
    "estimate": inline(  # a value and its standard deviation
        _estimate, lambda pair: mapping(value=number(pair[0]), std=number(pair[1]))
    ),
    "square": inline(lambda field: field, flow),  # read as it is, for a size that is known later
}


class Keys:
    """The keys of a block, in their order.

    Parameters
    ----------
    table : str
        See above.
    kinds : mapping, optional
        Kinds of this table alone, by their names.
    computed : callables
        By key, what the value is computed from the object whose block is written. `read` gives it by the key.
    """

    def __init__(
        self, table: str, kinds: Mapping[str, Kind] | None = None, **computed: Callable[[Any], Any]
    ) -> None:
        self.keys = []
        for entry in table.split(","):
            found = _ENTRY(entry)
            assert found is not None, entry
            name, attribute, optional, word = found.groups()
            self.keys.append((name, attribute or name, optional, _kind(word, kinds or {})))
        self.computed = computed

    def lines(self, value: Any, long: bool = False) -> Iterator[str]:
        """Lines of the block."""
        for name, attribute, optional, kind in self.keys:
            if name in self.computed:
                own = self.computed[name](value)
            else:
                own = value[attribute] if isinstance(value, dict) else getattr(value, attribute)
            if not (optional and (own is kind.empty or own == kind.empty)):
                yield from kind.lines(name, own, long)

    def flow(self, value: Any) -> str:
        """The block as a mapping on one line."""
        return f"{{{', '.join(self.lines(value))}}}"

    def read(self, field: Field) -> dict[str, Any]:
        """The values of the block by their attributes."""
        found = {}
        for name, attribute, optional, kind in self.keys:
            value = field.read(name, kind.read) if optional else kind.read(field[name])
            found[attribute] = kind.empty if value is None else value
        return found


def _kind(word: str, kinds: Mapping[str, Kind]) -> Kind:
    if re.fullmatch(r"[n\d](?:x[n\d]+)*", word):
        return array(*(-1 if size == "n" else int(size) for size in word.split("x")))
    return kinds[word] if word in kinds else _KINDS[word]


def named(word: str | Kind, empty: Any = None) -> Kind:
    """Values of a kind by their names."""
    kind = _KINDS[word] if isinstance(word, str) else word
    return Kind(
        lambda field: {name: kind.read(entry) for name, entry in field.entries().items()},
        lambda key, values, long: block(
            key, [line for name in values for line in kind.lines(plain_text(name), values[name], long)]
        ),
        empty,
    )


def record(make: Callable[..., Any], keys: Keys, inline: bool = False) -> Kind:
    """An object of the values of a table, as a block or on the line of its key."""

    def lines(key: str, value: Any, long: bool) -> Iterable[str]:
        return [f"{key}: {keys.flow(value)}"] if inline else block(key, keys.lines(value, long))

    return Kind(lambda field: make(**keys.read(field)), lines)

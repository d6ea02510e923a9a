"""Tables by which blocks of our own files are written and read: keys of one object, and columns of many.

A table of keys is a text, ``"seed: integer, center=centre?: pair"``: the names of keys, those of the
attributes with their values if they differ, and kinds. A key with ``?`` is left out of the file if its value
is the empty one of its kind, which it has if it is left out; one with ``!`` is always written, but may lack.
Sizes such as ``3x4`` are arrays; ``n`` is any length. A table of columns, ``"point?: label, found=X Y Z:
number"``, has the names of the columns of each attribute, and what stands in them.

Long columns are texts of comma-separated numbers, ``X: ['0.0,20.0,40.0']``, or packed. PyYAML's pure-Python
parser takes 50 us per number, but only 0.3 us per character of a text. A number of 17 digits has 20
characters as a decimal, 11 in base64, and 4 packed: each of these is a character of Unicode's private use
area that encodes two bytes of a float64. A text has at most 160 numbers, because OpenCV's FileStorage refuses
texts of more than 4095 bytes.

Values by view name are a mapping if all names are valid keys of FileStorage. Otherwise they are a list of
pairs, because FileStorage cannot open a file with a key such as ``"01"``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import value_failures
from neurocal_cli.files.tree_fields import Field
from neurocal_cli.files.yaml_text import (
    block,
    boolean,
    flow,
    flows,
    indented,
    list_lines,
    mapping,
    number,
    quoted,
    quoted_words,
    text,
    words,
)

LONGEST = 160  # numbers in a text, each with at most 24 characters

_PRIVATE = 0xF0000  # the first of 65536 characters of a private use area

_NUMBERS = re.compile(r"(?:[-+0-9.eE, ]|null)+").fullmatch
_RANGES = re.compile(r"[0-9]{1,12}(?:-[0-9]{1,12})?(?:,[0-9]{1,12}(?:-[0-9]{1,12})?)*").fullmatch
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*").fullmatch


def number_words(values: NDArray[Any]) -> list[str]:
    """Write each number as text; ``null`` if it is not finite."""
    flat = np.ravel(values)
    return list(map(str, flat.tolist())) if flat.dtype.kind in "iu" else flows(flat)


def column_lines(columns: Mapping[str, NDArray[Any] | Sequence[str]]) -> Iterator[str]:
    """Lines of a table, one per column: arrays as texts of numbers, labels as single texts."""
    for name, values in columns.items():
        if isinstance(values, np.ndarray):
            words = number_words(values)
            parts = [f"'{','.join(words[k : k + LONGEST])}'" for k in range(0, len(words), LONGEST)]
        else:
            parts = list(map(quoted, values))
        yield f"{name}: [{', '.join(parts)}]"


class Columns:
    """The columns of a table by the attributes whose values they hold.

    Parameters
    ----------
    table : str
        See above. In columns stand a label, an integer, a number, or a measure, which may be unknown.
    """

    def __init__(self, table: str) -> None:
        self.groups: list[tuple[str, list[str], bool, str]] = []
        for entry in table.split(","):
            names, _, kind = entry.partition(":")
            names, optional = names.strip().removesuffix("?"), names.strip().endswith("?")
            attribute, _, columns = names.partition("=")
            self.groups.append((attribute, (columns or attribute).split(), optional, kind.strip()))
        self.labels = frozenset(
            name for _, names, _, kind in self.groups if kind == "label" for name in names
        )

    def of(self, value: Any) -> dict[str, NDArray[Any] | list[str]]:
        """The columns of an object, or of a dictionary of attributes."""
        columns: dict[str, NDArray[Any] | list[str]] = {}
        for attribute, names, optional, kind in self.groups:
            own = value.get(attribute) if isinstance(value, dict) else getattr(value, attribute)
            if own is None and optional:
                continue
            assert own is not None, attribute
            if kind == "label":
                columns[names[0]] = list(map(str, own))
            else:
                numbers = np.asarray(own, dtype=int if kind == "integer" else float).reshape(
                    len(own), len(names)
                )
                columns |= {name: numbers[:, k] for k, name in enumerate(names)}
        return columns

    def lines(self, value: Any, long: bool, indent: int = 2) -> Iterator[str]:
        """Lines of the table: ``columns`` and ``rows``, or only ``columns`` if it is long."""
        columns = self.of(value)
        if long:
            yield from block("columns", column_lines(columns))
            return
        yield f"columns: [{', '.join(columns)}]"
        cells = [
            number_words(values) if isinstance(values, np.ndarray) else map(quoted, values)
            for values in columns.values()
        ]
        rows = indented((f"- [{', '.join(row)}]" for row in zip(*cells, strict=True)), indent)
        yield "rows:" if rows else "rows: []"
        yield from rows

    def listed(self, columns: Field) -> list[str]:
        """The names of columns, those of the table and with all that it needs."""
        names = columns.texts()
        every = [name for _, group, _, _ in self.groups for name in group]
        needed = [name for _, group, optional, _ in self.groups if not optional for name in group]
        if len(set(names)) < len(names) or not set(needed) <= set(names):
            columns.fail(f"a list of different names with {', '.join(needed)} among them")
        if strange := sorted(set(names) - set(every)):
            columns.fail(f"names among {', '.join(every)}, and not {strange[0][:40]!r}")
        return names

    def read(self, field: Field) -> dict[str, Any] | None:
        """The values of the attributes in either form of a table; None if it has no rows."""
        columns, rows = field["columns"], field.get("rows")
        if isinstance(columns.value, dict):
            table = read_columns(columns, self.labels)
            self.listed(Field(list(table), columns.source, columns.path))
            return self.values(table, field)
        names = self.listed(columns) if columns.value or rows.value else []
        if not isinstance(rows.value, list):
            rows.fail("a list of rows")
        for k, row in enumerate(rows.value):
            if type(row) is not list or len(row) != len(names):
                Field(row, rows.source, f"{rows.path}[{k}]").fail(f"a list of {len(names)} values")
        if not rows.value:
            return None
        return self.values(dict(zip(names, map(list, zip(*rows.value, strict=True)), strict=True)), rows)

    def values(self, table: Mapping[str, list[Any]], field: Field) -> dict[str, Any]:
        """The values of the attributes, from columns by their names; None for those that are not there."""
        found: dict[str, Any] = {}
        for attribute, names, optional, kind in self.groups:
            if optional and not set(names) <= set(table):
                found[attribute] = None
                continue
            columns = [Field(table[name], field.source, f"{field.path}, column {name},") for name in names]
            if kind == "label":
                found[attribute] = columns[0].texts()
            elif kind == "integer":
                found[attribute] = np.array([cell.integer() for cell in columns[0].items()], dtype=np.intp)
            else:
                numbers = np.array([column.array(-1, unknown=kind == "measure") for column in columns])
                found[attribute] = numbers.T if len(names) > 1 else numbers[0]
        return found


def read_columns(field: Field, labels: frozenset[str]) -> dict[str, list[Any]]:
    """Read a table back: numbers (None for null), and text in the columns called `labels`."""
    columns: dict[str, list[Any]] = {
        name: column.texts() if name in labels else read_numbers(list(column.items()))
        for name, column in field.entries().items()
    }
    if len(set(map(len, columns.values()))) > 1:
        field.fail("columns of one length")
    return columns


def read_numbers(texts: Sequence[Field]) -> list[Any]:
    """Read the numbers of texts, None for null; they may be infinite."""
    for entry in texts:
        if not _NUMBERS(entry.text()):
            entry.fail("numbers with commas between them")
    try:
        return list(json.loads(f"[{','.join(entry.value for entry in texts)}]"))
    except ValueError:
        texts[0].fail("numbers with commas between them")


def packed_text(values: NDArray[Any]) -> str:
    """Write numbers as packed float64 in quotes, with four characters per number."""
    words = np.ascontiguousarray(values, dtype="<f8").view("<u2").astype("<u4") + _PRIVATE
    return f"'{words.tobytes().decode('utf-32-le')}'"


def read_packed(entry: Field) -> list[float]:
    """Read the numbers of `packed_text`; they may be infinite."""
    codes = np.frombuffer(entry.text().encode("utf-32-le", "surrogatepass"), dtype="<u4")
    if len(codes) % 4 or np.any(codes >> 16 != _PRIVATE >> 16):
        entry.fail("packed numbers, four characters from U+F0000 on for each")
    return codes.astype("<u2").view("<f8").tolist()


def join_ranges(numbers: NDArray[np.int64]) -> str:
    """Write whole numbers as ranges, ``0-92,95,97-99``."""
    cuts = np.flatnonzero(np.diff(numbers) != 1)
    first = numbers[np.concatenate([[0], cuts + 1])].tolist()
    last = numbers[np.concatenate([cuts, [len(numbers) - 1]])].tolist()
    return ",".join(f"{a}-{b}" if a < b else f"{a}" for a, b in zip(first, last, strict=True))


def read_ranges(field: Field, below: int) -> list[int]:
    """Read ranges of whole numbers below a limit back."""
    text = field.text()
    if not _RANGES(text):
        field.fail("whole numbers and ranges such as 0-92")
    numbers: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        if int(last or first) >= below:
            field.fail(f"numbers below {below}")
        numbers.extend(range(int(first), int(last or first) + 1))
    return numbers


def named_lines(key: str, names: Iterable[str], values: Iterable[str]) -> Iterator[str]:
    """Lines of a key whose value has an entry for each name; `values` are YAML flow texts."""
    names = list(names)
    pairs = zip(names, values, strict=True)
    if not names:
        yield f"{key}: {{}}"
    elif all(_KEY(name) and text(name) == name for name in names):
        yield from block(key, (f"{name}: {value}" for name, value in pairs))
    else:
        yield from block(key, (f"- [{quoted(name)}, {value}]" for name, value in pairs))


def read_named(field: Field) -> dict[str, Field]:
    """Read either form back; no name may appear twice."""
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


_ENTRY = re.compile(r"\s*(\w+)(?:=(\w+))?([?!])?(?::\s*([\w ]+?))?\s*").fullmatch


@frozen_dataclass(eq=False)
class Kind:
    """How values of a kind are read, and written as lines of the key, the value, and whether all is long."""

    read: Callable[[Field], Any]
    lines: Callable[[str, Any, bool], Iterable[str]]
    empty: Any = None


def not_read(field: Field) -> None:
    """The reader of a key that is only shown, as its value follows from others."""


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

Stated = tuple[float, float | None, bool]


def _estimate(field: Field) -> tuple[float, float]:
    return field["value"].number(), field["std"].number_or_nan()


def _stated(field: Field) -> Stated:
    std = field["std"].number_or_nan() if "std" in field.entries() else None
    return field["value"].number(), std, field.get("fixed", False).boolean()


def _stated_text(stated: Stated) -> str:
    value, std, fixed = stated
    entries = {"value": number(value)} | ({} if std is None else {"std": number(std)})
    return mapping(**(entries | {"std": "0", "fixed": "true"} if fixed else entries))


_KINDS = {
    "text": inline(Field.text, lambda value: text(str.__str__(value)), ""),
    "quoted": inline(Field.text, quoted, ""),
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
        lambda field: tuple(field.texts()), lambda key, values, _: list_lines(key, map(quoted, values)), ()
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
    "stated": inline(_stated, _stated_text),  # the same if it is known, and whether the value was given
    "shown": Kind(not_read, lambda key, value, _: [f"{key}: {flow(value)}"]),
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

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all keys."""
        return tuple(name for name, *_ in self.keys)

    def lines(self, value: Any, long: bool = False) -> Iterator[str]:
        """Lines of the block."""
        for name, attribute, optional, kind in self.keys:
            if name in self.computed:
                own = self.computed[name](value)
            else:
                own = value[attribute] if isinstance(value, dict) else getattr(value, attribute)
            same = own is kind.empty or (not isinstance(own, np.ndarray) and own == kind.empty)
            if not (optional == "?" and same):
                yield from kind.lines(name, own, long)

    def flow(self, value: Any) -> str:
        """The block as a mapping on one line."""
        return f"{{{', '.join(self.lines(value))}}}"

    def read(self, field: Field, *only: str) -> dict[str, Any]:
        """The values of the block by their attributes, or `only` those of some keys."""
        found = {}
        for name, attribute, optional, kind in self.keys:
            if kind.read is not not_read and (not only or name in only):
                value = field.read(name, kind.read) if optional else kind.read(field[name])
                found[attribute] = kind.empty if value is None else value
        return found


def check_format(block: Field, *known: int) -> None:
    """Refuse a block of a format that this version does not know."""
    form = block["format"].integer()
    if form not in known:
        advice = (
            "update neurocal" if form > max(known) else "write the file again, as older ones are not read"
        )
        block.refuse(f"{block.path}.format is {form}, not {' or '.join(map(str, known))}", advice)


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
            key, [line for name in values for line in kind.lines(text(name), values[name], long)]
        ),
        empty,
    )


def record(make: Callable[..., Any], keys: Keys, inline: bool = False) -> Kind:
    """An object of the values of a table, as a block or on the line of its key."""

    def lines(key: str, value: Any, long: bool) -> Iterable[str]:
        return [f"{key}: {keys.flow(value)}"] if inline else block(key, keys.lines(value, long))

    def read(field: Field) -> Any:
        with value_failures(field.source, f"{field.path}: ", advice="correct it"):
            return make(**keys.read(field))

    return Kind(read, lines)


_KINDS |= {
    "parameters": named("stated"),
    "covariance": record(dict, Keys("names: names, data: square"), inline=True),
}

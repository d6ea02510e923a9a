"""Read the top of a table: its metadata, its separator and the names of its columns."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import UNDISTORTED
from neurocal_cli.errors import FormatError, InputError, one_line, value_failures
from neurocal_cli.files.tree_fields import is_number, plain
from neurocal_cli.observations.distances import Distance

# 1,5 for 1.5, as spreadsheets write it in many countries.
is_decimal_comma = re.compile(r"[+-]?[0-9]*,[0-9]+(?:[eE][+-]?[0-9]+)?").fullmatch

# A board is the text of its file on one line; other words about it are a comment.
_METADATA = re.compile(
    r"#\s*(image_size|image_center|unit|distances|undistorted|board(?=\s*:\s*\{))\s*:(.*)", re.DOTALL
)
_UNIT = re.compile(r"(\S+?)(?:\s*[\[(](\w+)[\])]|_(mm|cm|m|px))").fullmatch  # X [mm], x_mm
_KEY_LIKE = re.compile(r"#\s*([A-Za-z][\w -]{2,20}?)\s*[:=].*", re.DOTALL)
_ALIKE = 0.85  # difflib's ratio from which a word is a known key misspelt: units is, image_file is not
_CALISCOPE = {"imglocx", "imglocy", "objlocx", "objlocy"}  # its columns, in px and m
_COMMAS = 1.6  # values over those expected; u,v and most of X,Y,Z have decimals, labels have none
_EXCEL = re.compile(r"sep=.?").fullmatch  # the first line of a file for spreadsheets
_QUOTED = re.compile(r'"(?:[^"]|"")*"')


@frozen_dataclass
class Schema:
    """Columns of a kind of table."""

    kind: str  # name of the rows, in the plural
    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    labels: frozenset[str] = frozenset()  # the columns that contain text; all others contain numbers
    headerless: bool = False  # whether a file may have the required columns without a header
    # Plain names of columns, the best first.
    aliases: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    others: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ()  # names that mean these with the others
    instead: str = ""  # advice for files of another kind

    @property
    def known(self) -> tuple[str, ...]:
        """All column names, required ones first."""
        return self.required + self.optional


@dataclass
class Metadata:
    """Metadata from the ``#`` lines of a file, collected line by line."""

    image_size: tuple[int, int] | None = None  # px
    image_center: tuple[float, float] | None = None  # px
    unit: str | None = None
    distances: tuple[Distance, ...] | None = None
    board: str | None = None  # text of its file
    undistorted: str | None = None  # one of `UNDISTORTED`
    misspelt: list[str] = field(default_factory=list)  # numbers of lines that are nearly metadata, and hints

    def take(self, line: str, number: int) -> None:
        """Read a ``# key: value`` line; other comments are ignored."""
        match = _METADATA.fullmatch(line.strip(" \t"))
        if match is None:
            if key := _meant(line):
                hint = f"{line[:40]!r} is not used; for {key}, write {METADATA[key][2]}"
                self.misspelt.append(f"{number}: {hint}")
            return
        key, text = match[1], match[2].strip(" \t,;")  # spreadsheets pad lines with separators
        read, _, hint = METADATA[key]
        value = read(text)
        if value is None:
            raise InputError(f"{key} is {text[:40]!r}; write {hint}")
        if getattr(self, key) not in (None, value):
            raise InputError(f"{key} is given twice and differs; keep one")
        setattr(self, key, value)


def _meant(line: str) -> str | None:
    """The key of the metadata that a comment nearly is."""
    match = _KEY_LIKE.fullmatch(line)
    if match is None:
        return None
    from difflib import get_close_matches

    word = re.sub("[ -]", "_", match[1].lower())
    return next(iter(get_close_matches(word, METADATA.keys() - {"board"}, 1, _ALIKE)), None)


def _size(text: str) -> tuple[int, int] | None:
    found = re.fullmatch(r"([0-9]{1,6})[ \t,]+([0-9]{1,6})", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    return size if all(size) else None


def _centre(text: str) -> tuple[float, float] | None:
    words = re.split(r"[ \t,]+", text)
    if len(words) != 2 or not all(is_number(word) and math.isfinite(float(word)) for word in words):
        return None
    return float(words[0]), float(words[1])


def _numbers(pair: tuple[float, float]) -> str:
    return " ".join(map(str, pair))


def _distances(text: str) -> tuple[Distance, ...] | None:
    try:
        return tuple(Distance(*row) for row in json.loads(text))
    except (ValueError, TypeError, InputError):
        return None


# Keys in the order in which they are written: how a value is read and written, and what to write.
METADATA: dict[str, tuple[Callable[[str], Any], Callable[[Any], str], str]] = {
    "image_size": (_size, _numbers, "two whole numbers as in `# image_size: 640 480`"),
    "image_center": (_centre, _numbers, "two numbers as in `# image_center: 320 240`"),
    "distances": (
        _distances,
        lambda found: json.dumps([[one.start, one.end, one.length, one.std] for one in found]),
        'a list as in `# distances: [["0:0", "8:5", 212.3, 0.05]]`',
    ),
    "board": (str, str, "the text of a board file on one line"),
    "unit": (lambda text: text or None, str, "a name as in `# unit: mm`"),
    "undistorted": ({one: one for one in UNDISTORTED}.get, str, f"one of {', '.join(UNDISTORTED)}"),
}


@frozen_dataclass
class Layout:
    """Position of a table's rows, and how to split them."""

    separator: str | None  # None for blanks
    names: tuple[str, ...]  # of the columns, in the file's order
    offset: int  # of the first byte below the header
    line: int  # number of the last line above that byte
    metadata: Metadata = field(default_factory=Metadata)
    flat: bool = False  # whether Z is 0 and no column

    def unknown(self, schema: Schema) -> tuple[str, ...]:
        """Names of columns that are not in the schema."""
        return tuple(name for name in self.names if name and name not in schema.known)


def find_layout(data: bytes, source: str, schema: Schema) -> Layout:
    """Read the metadata and the header at the top of a file."""
    metadata = Metadata()
    comments: list[str] = []
    for number, start, end, line in _lines(data):
        with value_failures(source, line=number):
            if line.startswith("#"):
                metadata.take(line, number)
                comments.append(line)
            elif line and not (number == 1 and _EXCEL(line)):
                separator = _find_separator(line)
                fields = split_fields(line, separator)
                above = re.split(r"[\s,;]+", comments[-1].strip("# \t")) if comments else []
                if len(above) == len(fields) and set(above) > set(schema.required):  # as savetxt writes it
                    return Layout(separator, tuple(_renamed(above, schema)[0]), start, number - 1, metadata)
                if all(is_number(text) for text in fields):
                    names = _headerless_names(fields, separator, comments, schema)
                    return Layout(separator, names, start, number - 1, metadata)
                for text in filter(is_decimal_comma, fields):
                    point = text[:40].replace(",", ".")
                    raise InputError(f"{text[:40]!r} has a decimal comma; write {point}")
                columns, unit = _renamed(fields, schema)
                metadata.unit = metadata.unit or unit
                # caliscope leaves out Z of a flat board, or leaves it empty.
                below = data[end : data.find(b"\n", end)].decode("utf-8", "replace")
                rows = split_fields(below, separator) if set(map(plain, fields)) >= _CALISCOPE else []
                flat = bool(rows) and (
                    "Z" not in columns or rows[min(columns.index("Z"), len(rows) - 1)] == ""
                )
                if flat and "Z" in columns:
                    columns[columns.index("Z")] = ""
                _check_names([*columns, "Z"] if flat else columns, schema)
                return Layout(separator, tuple(columns), end, number, metadata, flat)
    raise FormatError(
        f"is empty: there are no {schema.kind}; give a header {','.join(schema.required)} and rows", source
    )


def column_names(text: str, schema: Schema) -> tuple[str, ...]:
    """Names of the columns of what may be a table, as the schema has them; none if it has no header.

    A file of as many numbers as there are required columns needs no header.
    """
    for line in text.split("\n"):
        line = line.strip("\ufeff \t\r")
        if line and not line.startswith("#") and not _EXCEL(line):
            try:
                fields = split_fields(line, _find_separator(line))
            except InputError:
                return ()
            if all(map(is_number, fields)):
                return schema.required if schema.headerless and len(fields) == len(schema.required) else ()
            return () if re.search("[:{<=]", line) else tuple(_renamed(fields, schema)[0])
    return ()


def _renamed(names: list[str], schema: Schema) -> tuple[list[str], str | None]:
    """Names of columns as the schema has them, from those in use elsewhere, and the world's unit."""
    units = {name: _UNIT(name) for name in names}
    stated = {match[2] or match[3] for match in units.values() if match and match[1] in (*"XYZ", *"xyz")}
    stated.discard("px")
    new = [match[1] if match and match[1] in schema.known else name for name, match in units.items()]
    if len(new) < len(names):  # a name twice, which is refused later
        return list(names), None
    for column, forms in schema.aliases.items():
        places = [k for form in forms for k, name in enumerate(new) if plain(name) == form]
        if column not in new and places:
            new[places[0]] = column
    for theirs, ours in schema.others:
        if set(theirs) <= set(new) and set(ours).isdisjoint(new):
            trial = [dict(zip(theirs, ours, strict=True)).get(name, name) for name in new]
            new = trial if set(schema.required) <= set(trial) else new
    caliscope = set(map(plain, names)) >= _CALISCOPE
    return new, next(iter(stated)) if len(stated) == 1 else "m" if caliscope else None


def split_fields(line: str, separator: str | None) -> list[str]:
    """Split a line at its separators, outside quotes.

    Blanks around a field are dropped unless they are inside quotes; ``""`` in quotes is a quote. The csv
    module is not used, because it would continue an unclosed quote in the next line, and keep blanks after a
    quote.
    """
    line = line.strip(" \t") if separator != "\t" else line.strip(" ")
    if '"' not in line:
        if separator is None:
            return re.split(r"[ \t]+", line)
        return [text.strip(" \t") for text in line.split(separator)]
    end = r"[ \t]+" if separator is None else re.escape(separator)
    plain = r"[^ \t]*" if separator is None else f"[^{re.escape(separator)}]*"
    token = re.compile(rf'[ \t]*?(?:"((?:[^"]|"")*)"[ \t]*?|({plain}))(?:({end})|$)')
    fields: list[str] = []
    position = 0
    while True:
        match = token.match(line, position)
        if match is None or (match[2] or "").startswith('"'):
            raise InputError('a quote (") is not closed; close it')
        fields.append(match[2].strip(" \t") if match[1] is None else match[1].replace('""', '"'))
        if match[3] is None:
            return fields
        position = match.end()


def quoted_field(text: str) -> str:
    """Write a field for `split_fields`, in quotes if it needs them."""
    return '"' + text.replace('"', '""') + '"' if re.search(r'[",;\t]|^[ #]|[ ]$', text) else text


def _lines(data: bytes) -> Iterator[tuple[int, int, int, str]]:
    """Iterate over the lines: number, first byte, byte after the end, and stripped text."""
    start, number = 0, 1
    while start < len(data):
        end = data.find(b"\n", start) + 1 or len(data)
        yield number, start, end, data[start:end].decode("utf-8").strip(" \t\n")
        start, number = end, number + 1


def _find_separator(line: str) -> str | None:
    """Find the separator of the fields of the first line; None for blanks."""
    line = _QUOTED.sub("q", line)
    # In 1,5;2,5;... the commas are decimal commas, so semicolons take precedence if there are enough.
    semicolons = line.count(";") >= min(line.count(","), 4)
    separators = ";\t," if semicolons else ",\t;"
    for separator in separators:
        if separator in line and not (separator == "\t" and "" in line.split("\t")):
            return separator
    return None


def decimal_commas(found: int, expected: int, separator: str | None) -> str:
    """Advice for a row with too many values because its decimal commas separate them too; "" for others."""
    if separator != "," or found < _COMMAS * expected:
        return ""
    return "write decimal points if these are decimal commas"


def _headerless_names(
    fields: list[str], separator: str | None, comments: list[str], schema: Schema
) -> tuple[str, ...]:
    expected = schema.required
    if not schema.headerless:
        raise InputError(f"the header is missing; begin with {','.join(expected)}")
    if len(fields) != len(expected):
        points = decimal_commas(len(fields), len(expected), separator)
        raise InputError(
            f"there is no header, so {len(expected)} columns {','.join(expected)} are expected, found "
            f"{len(fields)}; {points or 'add a header that names the columns'}"
        )
    for comment in comments:  # numpy.savetxt writes its header as a comment
        words = re.split(r"[\s,;]+", comment.strip("# \t"))
        if sorted(words) == sorted(expected) and words != list(expected):
            raise InputError(f"the header {','.join(words)} is a comment; remove its #")
    return expected


def _check_names(names: list[str], schema: Schema) -> None:
    missing = [name for name in schema.required if name not in names]
    if missing and names[0].startswith(("%YAML", "{", "<?xml", "[{")):
        what = "a file of a camera, a rig or a lens"
        raise InputError(f"is not a table of {schema.kind}, but {what}; give {schema.kind}")
    numbers = [text for text in names if is_number(text)]
    if len(numbers) >= len(schema.required) > 0 and set(names).isdisjoint(schema.required):
        raise InputError(
            f"there is no header, but {one_line(','.join(names))[:60]!r}; add one that names the columns "
            f"{','.join(schema.required)} and all others{schema.instead}"
        )
    for name, count in Counter(names).items():
        if name and count > 1:
            raise InputError(f"the column {one_line(name[:40])} appears twice; rename or remove one")
    if not missing:
        return
    lower = {name.lower(): name for name in names}
    similar = [f"{lower[name.lower()]} as {name}" for name in missing if name.lower() in lower]
    hint = f"write {', '.join(similar)}" if similar else f"name the columns {','.join(schema.required)}"
    others = [name for name in missing if name.lower() not in lower]
    if similar and others:
        hint += f", and name the column{'s' * (len(others) > 1)} {','.join(others)}"
    if len(missing) == len(schema.required) and not similar:
        hint += schema.instead
    if missing == ["X", "Y", "Z"] and ({"row", "col"} <= set(names) or "point" in names):
        hint += ", or give --board chessboard:COLSxROWS:SQUARE"
    elif missing == ["X", "Y", "Z"]:
        hint += "; points of unknown place, such as markers of a wand, do not calibrate a camera"
    raise InputError(
        f"column{'s' * (len(missing) > 1)} {', '.join(missing)} missing from the header "
        f"{','.join(names)[:60]!r}; {hint}"
    )

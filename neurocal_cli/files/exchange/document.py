"""A file of another program as its recognisers see it: its bytes, its text and the tree of its keys.

The tree is that of YAML, JSON (also with comments), OpenCV's and Agisoft's XML, TOML, sections of
``key=value``, or NumPy's files.
"""

from __future__ import annotations

import copy
import io
import json
import os
import re
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from tokenize import TokenError
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError, InputError, NeurocalError, one_line
from neurocal_cli.files.camera_tree import parse_tree
from neurocal_cli.files.exchange.mat_file import MARK, lists, read_variables
from neurocal_cli.files.reading import decode, is_point_table, read_bytes
from neurocal_cli.files.tree_fields import Field, is_number

# What NumPy's and Python's readers raise; the header of an array is an expression.
_DAMAGED = (
    ValueError, LookupError, OverflowError, OSError, EOFError, MemoryError, RecursionError, SyntaxError,
    TokenError, NotImplementedError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
PACKED = b"PK\x03\x04"  # how a ZIP archive begins, as which NumPy writes several arrays
FROM_ZERO = (
    "its first pixel is taken as 0, as OpenCV has it; if MATLAB calibrated the camera, subtract 1 from the "
    "principal point"
)
# A matrix of OpenCV in C++.
_FILLED = re.compile(
    r"^[ \t]*(?:[\w:]{1,60}[ \t]+)?(\w{1,60})\s*=\s*\(\s*(?:cv::)?Mat_<\w+>\([\d, ]+\)\s*<<([^;)]*)\)",
    re.MULTILINE,
)
_LONGEST = 20_000  # characters of a text that may state a camera
_COEFFICIENTS = (4, 5, 8, 12, 14)
_MATLAB = re.compile(r"=\s*\[[^\]\n]*;|^[ \t]*%", re.MULTILINE).search
_MARK = re.compile(r"^---[ \t]*$", re.MULTILINE)
_HEAD = re.compile(r"\A\s*header:.*?^(?=height:)", re.MULTILINE | re.DOTALL)
UNKNOWN = "is not a camera file; give one of the formats that neurocal convert --help lists"
KALIBR_REPORT = (
    r"Calibration results\s*\n=+",
    "is a report of Kalibr, which holds no points, and Kalibr has no file of corners; give its camchain for "
    "the cameras, and the images of its bag to neurocal detect for points",
)
"""How the report of Kalibr begins, which is read neither as points nor as cameras, and what to do."""
_MOST_BYTES = 500_000_000  # unpacked; a camera has a few hundred numbers
_SECTION = re.compile(
    # TOML may have keys above the first section.
    r"\A((?:[^\S\n]*(?:[#;][^\n]*|\w+[ \t]*=[ \t]*[^\s\[][^\n]*)?\n)*)"
    r"[^\S\n]*\[[^\]\n,]+\][^\S\n]*(?:[#;][^\n]*)?(?:\n|\Z)"
).match
# name = numbers or name: numbers, as programs print them and scripts state them.
_STATED = re.compile(
    r"^[ \t]*([A-Za-z][\w. ]*?)[ \t]*(?:[:=]|\n)\s*(?:[\w.]+\()?\s*"
    r"(\[[-+.\deENa,;\s\[\]]*\]|[-+]?\.?\d[-+.\deE]*(?=[ \t;,]*(?:[#%/][^\n]*)?(?:\n|\Z)))",
    re.MULTILINE,
)
# A matrix as NumPy prints it, without commas.
_PRINTED = re.compile(r"\[\[[-+.\deE\s\[\]]+\]\]")


def _with_commas(printed: re.Match[str]) -> str:
    rows = re.findall(r"\[\[?([^\[\]]+)\]", printed[0])
    return f" [{', '.join('[' + ', '.join(row.split()) + ']' for row in rows)}]"


@contextmanager
def damaged(problem: str, source: str, line: int | None = None) -> Iterator[None]:
    """Turn what readers raise about damaged data into a FormatError; one about the data is passed on."""
    try:
        yield
    except NeurocalError:
        raise
    except _DAMAGED as error:
        raise FormatError(problem, source, line) from error


class NoCameraError(InputError):
    """A file in which no camera is found."""


class Document:
    """A file, or standard input, and what the caller says about it.

    Parameters
    ----------
    name : str
        Path, or ``-``.
    notes, warnings : list of str, optional
        Remarks about what was read, and doubts about it, are appended.
    distortion : str, optional
        Our name of the distortion model, if the file does not say it.
    size : (width, height), optional
        Of the images, to choose among the cameras of several resolutions.
    """

    def __init__(
        self,
        name: str,
        notes: list[str] | None = None,
        warnings: list[str] | None = None,
        distortion: str | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.is_folder = name != "-" and os.path.isdir(name)  # of a model of COLMAP
        self.data, self.source = (b"", one_line(name)) if self.is_folder else read_bytes(name)
        if self.data.startswith(b"\x1f\x8b"):  # OpenCV's FileStorage packs .yml.gz
            self.data = unpacked(self.data, self.source)
        self.notes = [] if notes is None else notes
        self.warnings = [] if warnings is None else warnings
        self.distortion, self.size = distortion, size
        self.is_script = False  # of MATLAB or Octave, perhaps

    def note(self, text: str) -> None:
        """Append a remark about what was read."""
        self.notes.append(f"{self.source}: {text}")

    def doubt(self, text: str) -> None:
        """Append a doubt about what was read."""
        self.warnings.append(f"{self.source}: {text}")

    def with_tree(self, tree: dict[str, Any], source: str = "") -> Document:
        """The document with another tree, and without its text."""
        other = copy.copy(self)
        other.source = source or self.source
        other.__dict__ |= {"tree": tree, "root": Field(tree, other.source), "text": "", "array": None}
        return other

    @cached_property
    def is_text(self) -> bool:
        """Whether the bytes may be text."""
        return b"\0" not in self.data and not self.data.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04"))

    @cached_property
    def text(self) -> str:
        """The text, "" of a binary file."""
        return decode(self.data, self.source, "a camera file") if self.is_text else ""

    @cached_property
    def root(self) -> Field:
        """The tree of the file; a FormatError says what is wrong with it."""
        if self.data.startswith(PACKED):
            return Field(arrays_of(self.data, self.source, self.notes), self.source)
        if self.data.startswith(MARK):
            self.is_script = True
            return Field(lists(read_variables(self.data, self.source)), self.source)
        if self.array is not None:
            shape = " x ".join(map(str, self.array.shape))
            if self.array.size != 9 and self.array.shape != (4, 4):
                raise FormatError(
                    f"is an array of {shape} numbers; give the camera matrix of 3 x 3, and its coefficients "
                    "as a second file",
                    self.source,
                )
            return Field({"K": self.array.tolist()}, self.source)
        text = decode(self.data, self.source, "a camera file")
        if is_point_table(text):
            raise FormatError("is a table of points; give a camera file here", self.source)
        if _SECTION(text):
            return Field(sections(text, self.source), self.source)
        parts = [part for part in _MARK.split(text) if part.strip()]
        if len(parts) > 1 and len({_HEAD.sub("", part) for part in parts}) == 1 and _HEAD.search(parts[0]):
            text = parts[0]  # rostopic echo repeats a message
        failed = None
        try:
            root = parse_tree(text, self.source)
        except FormatError as error:
            failed, root = error, Field("", self.source)
        named = root.value is None or isinstance(root.value, str)
        if named and len(text) <= _LONGEST and (tree := stated(text)) is not None:
            self.is_script = bool(_MATLAB(text))
            return Field(tree, self.source)
        if failed is not None:
            # A dictionary that Python prints.
            plain = re.sub(r"\barray\(|(?:, *dtype=[\w.]+)?\)", "", text)
            if (plain := _PRINTED.sub(_with_commas, plain)) != text:
                return parse_tree(plain, self.source)
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            alike = sum(":" in line or line[0] in "-#{}[]<," for line in lines)
            if lines and not lines[0].startswith(("%YAML", "---")) and 2 * alike < len(lines):
                raise FormatError(UNKNOWN, self.source)
            raise failed
        if isinstance(root.value, list) and (K := camera_matrix(root.value)) is not None:
            return Field({"K": K.tolist()}, self.source)
        return root

    @cached_property
    def array(self) -> np.ndarray[Any, Any] | None:
        """The array of an ``.npy`` file, or of a text of a few numbers; None for other files."""
        if self.data.startswith(b"\x93NUMPY"):
            with damaged("is no .npy file of numbers; save it again with numpy.save", self.source):
                found = np.asarray(np.load(io.BytesIO(self.data), allow_pickle=False))
        else:
            rows = few_numbers(self.text)
            if rows is None:
                return None
            found = np.array(rows)
        K = camera_matrix(found)
        return found if K is None else K

    @cached_property
    def tree(self) -> dict[str, Any]:
        """The tree as a mapping; empty if there is none, or if it cannot be read."""
        try:
            value = self.root.value
        except FormatError:
            return {}
        return value if isinstance(value, dict) else {}


def _value(text: str) -> Any:
    """A number, or what TOML writes like JSON, for Python 3.10, which cannot read TOML; or text."""
    if is_number(text):
        return float(text)
    try:
        return json.loads(re.sub(r",(?=\s*\])", "", text))
    except (ValueError, RecursionError):
        return text


def few_numbers(text: str) -> list[list[float]] | None:
    """Rows of a text of at most 16 numbers and nothing else; None for other texts."""
    if len(text) > 1000 or not text.strip():
        return None
    lines = [re.split(r"[\s,;]+", line.strip(" \t[],;")) for line in text.splitlines() if line.strip()]
    numbers = all(is_number(word) for line in lines for word in line)
    if not numbers or len({len(line) for line in lines}) != 1 or sum(map(len, lines)) > 16:
        return None
    return [[float(word) for word in line] for line in lines]


def camera_matrix(rows: Any) -> Array | None:
    """The camera matrix in rows of 3 x 3 numbers, or of 3 x 4 or 4 x 4 as some save it; None for others."""
    try:
        matrix = np.array(rows, dtype=float)
    except (TypeError, ValueError):
        return None
    if matrix.shape == (4, 4) and np.array_equal(matrix[3], [0, 0, 0, 1]):
        matrix = matrix[:3]
    if matrix.shape == (3, 4) and not matrix[:, 3].any():
        matrix = matrix[:, :3]
    if matrix.shape != (3, 3) or not np.array_equal(matrix[2], [0, 0, 1]) or matrix[1, 0]:
        return None
    return matrix if matrix[0, 0] > 1 and matrix[1, 1] > 1 else None


def arrays_of(data: bytes, source: str, notes: list[str]) -> dict[str, Any]:
    """Read the arrays of an ``.npz`` file as nested lists; Python objects are left out, with a note."""
    tree: dict[str, Any] = {}
    with damaged("is not an .npz file; save it again with numpy.savez", source):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if not any(name.endswith(".npy") for name in archive.namelist()):
                raise FormatError("is a ZIP archive without arrays of NumPy; unpack it first", source)
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
                raise FormatError("unpacks to more than 500 MB; give a file of cameras or points", source)
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            for name in arrays.files:
                try:
                    tree[name] = np.asarray(arrays[name]).tolist()
                except ValueError as error:
                    if "Object arrays" not in str(error):
                        raise
                    notes.append(
                        f"{source}: {name[:40]} holds Python objects, which can run code and are not read; "
                        "save it as an array of numbers"
                    )
    return _named(tree)


def _named(tree: dict[str, Any]) -> dict[str, Any]:
    """Arrays saved without names, arr_0 and so on: a matrix and coefficients are told by their shape."""
    if not all(re.fullmatch(r"arr_\d+", name) for name in tree):
        return tree
    matrices = [name for name, rows in tree.items() if camera_matrix(rows) is not None]
    rows = [np.ravel(value).tolist() for value in tree.values() if np.size(value) in _COEFFICIENTS]
    if len(matrices) != 1 or len(rows) > 1:
        return tree
    return {"K": tree[matrices[0]], **({"D": rows[0]} if rows else {})}


def sections(text: str, source: str) -> dict[str, Any]:
    """Read TOML, or the sections of an INI file."""
    if sys.version_info >= (3, 11):
        import tomllib

        try:
            return tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError):
            pass
    import configparser

    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=("#", ";"))
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    try:
        above = match.end(1) if (match := _SECTION(text)) else 0
        parser.read_string("\n" * text[:above].count("\n") + text[above:])
    except configparser.Error as error:
        line = getattr(error, "lineno", None)
        raise FormatError("is neither TOML nor sections of key = value; correct it", source, line) from error
    return {name: {key: _value(value) for key, value in parser[name].items()} for name in parser.sections()}


def unpacked(data: bytes, source: str) -> bytes:
    """The contents of a file that gzip packed."""
    unpacker = zlib.decompressobj(31)
    with damaged("is a damaged .gz file; give it unpacked", source):
        found = unpacker.decompress(data, _MOST_BYTES)
    if unpacker.unconsumed_tail or not unpacker.eof:
        raise FormatError("is cut off, or unpacks to more than 500 MB; give it unpacked", source)
    return found


def stated(text: str) -> dict[str, Any] | None:
    """Numbers and matrices by the names before them, or in the row below those of a table; None without."""
    lines = [re.split(r"[ \t]*[,;\t][ \t]*", line.strip()) for line in text.splitlines() if line.strip()]
    if len(lines) == 2 and len(lines[0]) == len(set(lines[0])) == len(lines[1]) > 3:
        tree: dict[str, Any] = dict(zip(lines[0], map(_value, lines[1]), strict=True))
        return None if any(map(is_number, lines[0])) else tree
    tree = {}
    text = _FILLED.sub(r"\1 = [\2]", re.sub(r"^[ \t]*#define", "", text, flags=re.MULTILINE))
    text = re.sub(r"(?:[%#]|//)[^\n]*", "", text)
    text = re.sub(r";(?![^\[\]]*\])", "\n", text)  # behind a statement, not in a matrix
    rows = [line.replace(",", " ").split() for line in text.splitlines() if line.strip()]
    if all(len(row) > 1 and all(map(is_number, row[1:])) for row in rows):
        counts = [len(row) for row in rows]
        if all(map(is_number, (row[0] for row in rows))):
            if counts[:-1] not in ([3, 3, 3], [9]) or counts[-1] not in _COEFFICIENTS:
                return None
            return {"K": [float(word) for row in rows[:-1] for word in row], "D": list(map(float, rows[-1]))}
        names = [row[0] for row in rows]
        if len(set(names)) < len(names) or any(map(is_number, names)):
            return None
        return {name: float(row[0]) if len(row) == 1 else list(map(float, row)) for name, *row in rows}
    if re.search(r"[\[\]]|\d\.\d", _STATED.sub("", text)):  # numbers without a name
        return None
    for name, value in _STATED.findall(text):
        name = name if value.startswith("[") else name.split()[-1]  # double fx = 800.5;
        if name in tree:
            return None
        if not value.startswith("["):
            tree[name] = float(value) if is_number(value) else value
            continue
        nested = re.findall(r"\[([^\[\]]+)\]", value) if "[[" in re.sub(r"\s", "", value) else None
        parts = [part.replace(",", " ").split() for part in nested or value.strip("[]").split(";")]
        if all(is_number(word) for part in parts for word in part):
            numbers = [[float(word) for word in part] for part in parts if part]
            tree[name] = numbers if nested or len(numbers) > 1 else (numbers or [[]])[0]
    return tree if len(tree) > 1 else None

"""Checked access to the values of a file's tree; each error names the file, the key and the remedy."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any, NoReturn, TypeVar

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import FormatError

T = TypeVar("T")

# Form of a number in our files; Python's float() would also accept 1_0 and digits of other alphabets.
is_number = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?").fullmatch


def plain(name: str) -> str:
    """A name in lower-case letters and digits, spelt rightly."""
    letters = re.sub(r"[^a-z0-9]", "", name.lower())
    return letters.replace("distors", "distort").replace("coefficent", "coefficient")


class Field:
    """A value in a tree of a file, with its path: the keys from the root, separated by dots."""

    __slots__ = ("path", "source", "value")

    def __init__(self, value: Any, source: str, path: str = "") -> None:
        self.value = value
        self.source = source
        self.path = path

    def refuse(self, problem: str, advice: str = "") -> NoReturn:
        """Raise a FormatError about the file."""
        raise FormatError(problem, self.source, advice=advice)

    def fail(self, expected: str) -> NoReturn:
        """Raise a FormatError about an unexpected value."""
        if isinstance(self.value, dict):
            found = "a mapping"
        elif isinstance(self.value, list):
            found = f"a list of {len(self.value)}"
        elif self.value is None:
            found = "nothing"
        else:
            shown = repr(self.value)
            found = shown if len(shown) <= 40 else f"{shown[:37]}..."
        self.refuse(f"{self.path or 'the file'} must be {expected}, found {found}; correct it")

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value, dict) and self.value.get(key) is not None

    def __getitem__(self, key: str) -> Field:
        """Value of a required key."""
        if key not in self._mapping():
            self.refuse(f"the key {self._below(key)} is missing; add it or write the file again")
        return Field(self.value[key], self.source, self._below(key))

    def get(self, key: str, default: Any = None) -> Field:
        """Value of a key, or a default if the key is missing or null."""
        found = self._mapping().get(key)
        return Field(default if found is None else found, self.source, self._below(key))

    def called(self, names: str) -> Field | None:
        """Value of the first of these names, without capitals and marks, that is there and not null."""
        if not isinstance(self.value, dict):
            return None
        keys = {plain(key): key for key, value in self.value.items() if value is not None}
        found = (keys[plain(name)] for name in names.split() if plain(name) in keys)
        return next((self[key] for key in found), None)

    def read(self, key: str, reader: Callable[[Field], T]) -> T | None:
        """Apply a function to the value of a key; None if the key is missing or null."""
        field = self.get(key)
        return None if field.value is None else reader(field)

    def entries(self) -> dict[str, Field]:
        """All values of a mapping, by their keys."""
        return {key: self[key] for key in self._mapping()}

    def items(self) -> Iterator[Field]:
        """Iterate over the entries of a list."""
        if not isinstance(self.value, list):
            self.fail("a list")
        for k, value in enumerate(self.value):
            yield Field(value, self.source, f"{self.path}[{k}]")

    def texts(self) -> list[str]:
        """Value as a list of texts."""
        if isinstance(self.value, list) and set(map(type, self.value)) <= {str}:
            return list(self.value)
        return [entry.text() for entry in self.items()]

    def names(self, count: int) -> list[str]:
        """Value as a list of `count` different texts."""
        texts = self.texts()
        if len(texts) != count or len(set(texts)) < count:
            self.fail(f"{count} different names")
        return texts

    def number(self) -> float:
        """Value as a finite number."""
        number = _as_float(self.value)
        if not math.isfinite(number):
            self.fail("a finite number")
        return number

    def number_or_nan(self) -> float:
        """Value as a finite number; NaN for null, which means unknown."""
        return math.nan if self.value is None else self.number()

    def integer(self, least: int = 0) -> int:
        """Value as a whole number, not below `least`."""
        number = self.value
        if isinstance(number, float) and number.is_integer():
            number = int(number)
        if not isinstance(number, int) or isinstance(number, bool) or not least <= number < 2**63:
            self.fail(f"a whole number, {least} or more")
        return int(number)

    def boolean(self) -> bool:
        """Value as true or false."""
        if not isinstance(self.value, bool):
            self.fail("true or false")
        return self.value

    def text(self) -> str:
        """Value as text; a whole number is converted back to text."""
        if isinstance(self.value, int) and not isinstance(self.value, bool):
            return str(self.value)
        if not isinstance(self.value, str):
            self.fail("text (in quotes, if need be)")
        return self.value

    def array(self, *shape: int, unknown: bool = False) -> Array:
        """Value as an array of finite numbers; -1 in the shape is any length, and null NaN if `unknown`."""
        words = " x ".join("n" if s < 0 else str(s) for s in shape)
        expected = f"{words} finite numbers{' or null' * unknown}"
        try:
            array = np.array(self.value)
        except (ValueError, OverflowError, RecursionError):  # ragged
            self.fail(expected)
        if array.dtype.kind not in "iuf":  # numbers as text, null, or other values
            objects = np.array(self.value, dtype=object)
            flat = objects.ravel().tolist()
            numbers = [_as_float(x) for x in flat]
            finite = (math.isfinite(n) or (unknown and x is None) for n, x in zip(numbers, flat, strict=True))
            if objects.shape != array.shape or not all(finite):
                self.fail(expected)
            array = np.array(numbers).reshape(objects.shape)
        array = array.astype(float)
        if array.size == 0 and any(s < 0 for s in shape):
            array = array.reshape([max(s, 0) for s in shape])
        fits = array.ndim == len(shape) and all(s in (-1, n) for s, n in zip(shape, array.shape, strict=True))
        if not fits or not (unknown or np.isfinite(array).all()):
            self.fail(expected)
        return array

    def _mapping(self) -> dict[str, Any]:
        if not isinstance(self.value, dict):
            self.fail("a mapping (key: value)")
        return self.value

    def _below(self, key: str) -> str:
        shown = key if re.fullmatch(r"[\w.-]{1,60}", key) else repr(key[:60])
        return f"{self.path}.{shown}" if self.path else shown


def _as_float(value: Any) -> float:
    """Convert a scalar to a number; NaN if it is none."""
    if isinstance(value, bool):
        return math.nan
    if isinstance(value, (int, float)):
        try:
            return float(value)
        except OverflowError:
            return math.nan
    # YAML 1.1 reads 1e-05 as text, because it has no decimal point, but other programs write numbers so.
    if isinstance(value, str) and is_number(value):
        return float(value)
    return math.nan

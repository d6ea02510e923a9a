"""The kinds of the arguments of public functions, which their annotations tell.

The front door of the package gives out each public name through `checked`: an argument of another kind is an
InputError, or a UsageError if it is a word that is no choice, instead of an error of Python somewhere inside.
Where an array is expected, a list will do. What annotations do not tell, such as shapes and limits, the
functions check themselves. What the package itself gives is not checked: its types are, and it makes views
by the thousand.
"""

from __future__ import annotations

import sys
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from inspect import isfunction
from numbers import Integral
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, is_typeddict

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import real_array
from neurocal_cli.errors import InputError, UsageError

T = TypeVar("T")


def _plain(kind: Any) -> Any:
    """What a kind is an alias for, as NDArray of newer NumPy is on newer Python."""
    value = getattr(get_origin(kind), "__value__", None)
    return kind if value is None else value[get_args(kind)]


_INSIDE = "neurocal_cli."
_ARRAY = _plain(Array)
_WORDS = {
    _ARRAY: "an array of real numbers",
    NoneType: "None",
    Path: "a path",
    bool: "True, False",
    float: "a number",
    int: "a whole number",
    str: "a text",
}
# What to give, which the name of a class does not tell.
_INSTEAD = {
    "Board": "what read_board made, or one such as Board.single(9, 6, 25.0)",
    "Calibration": "what calibrate made",
    "Correspondences": "what read_points or Correspondences.from_detections made",
    "Distortion": "one such as Distortion('k1', [-0.1])",
    "Intrinsics": "what Intrinsics.from_matrix makes of a 3 x 3 matrix",
    "LensCameras": "what LensCameras.of or read_lens_data made",
    "LensPoints": "what read_lens_points made",
    "Rig": "what calibrate_rig made",
    "StereoRig": "what calibrate_stereo made, or Rig.pair",
    "ZoomLens": "what fit_lens or read_lens made",
}


def checked(public: T, names: Mapping[str, Any]) -> T:
    """A public function that checks the kinds of its arguments, or a class whose methods do.

    `names` has the classes that annotations may name and their modules do not import.
    """
    if isfunction(public):
        made: T = _checked(public, names)
        made.__module__ = "neurocal_cli"  # where pickle finds it
        return made
    for base in getattr(public, "__mro__", ()):
        if not base.__module__.startswith(_INSIDE) or issubclass(base, Exception):
            continue
        for name, member in list(vars(base).items()):
            if name.startswith("_") and name != "__init__":
                continue
            if isfunction(member):
                setattr(base, name, _checked(member, names))
            elif isinstance(member, classmethod):
                setattr(base, name, classmethod(_checked(member.__func__, names)))
    return public


def _checked(function: Any, names: Mapping[str, Any]) -> Any:
    if hasattr(function, "__wrapped__"):  # a method of a class that others are built on
        return function
    positions = function.__code__.co_varnames[: function.__code__.co_argcount]
    kinds: dict[str, Any] = {}

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if sys._getframe(1).f_globals.get("__name__", "").startswith(_INSIDE):
            return function(*args, **kwargs)
        if not kinds:
            kinds.update(_kinds(function, names))
        given = [_taken(name, value, kinds) for name, value in zip(positions, args, strict=False)]
        named = {name: _taken(name, value, kinds) for name, value in kwargs.items()}
        return function(*given, *args[len(given) :], **named)

    return call


def _kinds(annotated: Any, names: Mapping[str, Any]) -> dict[str, Any]:
    """What annotations stand for: kinds by name, those of options that are passed on among them."""
    kinds: dict[str, Any] = {"return": Any}
    known = ChainMap(vars(sys.modules[annotated.__module__]), names)  # type: ignore[arg-type]  # read only
    for name in annotated.__annotations__.keys() - kinds:
        annotation = annotated.__annotations__[name]
        text = getattr(annotation, "__forward_arg__", annotation)
        kind = eval(text.removeprefix("Unpack"), {}, known)
        if isinstance(kind, list):  # what is left of Unpack[...]
            kinds |= _kinds(kind[0], names)
        else:
            kinds[name] = kind
    return kinds


def _taken(name: str, value: Any, kinds: Mapping[str, Any]) -> Any:
    """An argument as its function takes it."""
    kind = kinds.get(name, Any)
    alternatives = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    one_of = [one for one in map(_plain, alternatives) if one is not NoneType]
    if not _fits(value, kind):
        option = any(one in (bool, int) or get_origin(one) is Literal for one in one_of)
        shown = repr(value) if isinstance(value, (str, float)) else _shown(value)
        instead = [_INSTEAD[word] for one in one_of if (word := getattr(one, "__name__", "")) in _INSTEAD]
        words = " or ".join(dict.fromkeys(map(_words, _with_choices_joined(one_of))))
        told = "; give ".join([f"{name} must be {words}, not {shown}", *instead[:1]])
        raise UsageError(told) if option else InputError(told)
    if value is not None and one_of in ([_ARRAY], [int], [float], [bool]):
        return real_array(name, value) if one_of == [_ARRAY] else one_of[0](value)
    return value


def _shown(value: Any) -> str:
    """The class of a value, and that of what it contains."""
    inside = value.values() if isinstance(value, Mapping) else value
    some = list(inside)[:1] if isinstance(value, (Mapping, list, tuple)) else []
    return " of ".join(type(one).__name__ for one in [value, *some])


def _with_choices_joined(kinds: list[Any]) -> list[Any]:
    """Alternatives of which one has all words that may be chosen."""
    words = [word for one in kinds if get_origin(one) is Literal for word in get_args(one)]
    others = [one for one in kinds if get_origin(one) is not Literal]
    return [*others, Literal[tuple(words)]] if words else others


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a kind; what other checks tell better passes."""
    kind = _plain(kind)
    origin, inside = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in inside)
    if origin is Literal:
        return isinstance(value, str) and value in inside
    if kind is bool:
        return isinstance(value, (bool, np.bool_))
    if kind is float:
        return hasattr(type(value), "__float__") and np.ndim(value) == 0 and not isinstance(value, str)
    if kind is int:
        return isinstance(value, Integral) or (_fits(value, float) and float(value).is_integer())
    if kind is Path:
        return isinstance(value, PathLike)
    if origin is np.ndarray:
        return _fits_array(value, kind)
    if origin is Callable:
        return callable(value)
    if origin in (Mapping, dict):
        pairs = value.items() if isinstance(value, Mapping) else ()
        of_values = Any if _of_numbers(inside[1]) else inside[1]
        fit = [_fits(key, inside[0]) and _fits(one, of_values) for key, one in pairs]
        return isinstance(value, Mapping) and all(fit)
    if is_typeddict(kind):
        return isinstance(value, Mapping)
    if origin is tuple and _of_numbers(kind):  # an array in all but name
        return True
    if origin is not None:
        return _fits_several(value, origin, inside)
    if getattr(kind, "_is_protocol", False):
        return all(hasattr(value, name) for name in vars(kind) if not name.startswith("_"))
    return not isinstance(kind, type) or kind is Any or isinstance(value, kind)


def _of_numbers(kind: Any) -> bool:
    return kind in (int, float) or (get_origin(kind) is tuple and _of_numbers(get_args(kind)[0]))


def _fits_array(value: Any, kind: Any) -> bool:
    scalar = get_args(get_args(kind)[1])[0]
    if scalar in (np.float64, np.generic):  # `real_array` and `grey_image` tell what is none
        return True
    if scalar in (np.uint8, np.uint16):  # an image
        return isinstance(value, np.ndarray)
    array = np.asarray(value)
    counted = isinstance(scalar, type) and issubclass(scalar, (np.signedinteger, np.bool_))
    same = not counted or array.dtype.kind == np.dtype(scalar).kind
    return array.ndim > 0 and (same or (isinstance(value, list) and not value))


def _fits_several(value: Any, origin: Any, inside: tuple[Any, ...]) -> bool:
    """Whether a value is a list, or the like, of values of a kind."""
    if origin in (list, frozenset):
        return isinstance(value, origin) and all(_fits(one, inside[0]) for one in value)
    if not hasattr(type(value), "__iter__") or isinstance(value, (str, bytes, Mapping)):
        return False
    if not hasattr(type(value), "__getitem__"):  # read once
        return origin is Iterable
    if origin is tuple and inside[-1] is not ...:
        return len(value) == len(inside) and all(map(_fits, value, inside))
    return inside[0] is Any or all(_fits(one, inside[0]) for one in value)


def _words(kind: Any) -> str:
    kind = _plain(kind)
    origin, inside = get_origin(kind), get_args(kind)
    if kind in _WORDS:
        return _WORDS[kind]
    if origin is Literal:
        return f"one of {', '.join(inside)}"
    if origin in (Union, UnionType):
        return " or ".join(map(_words, inside))
    if origin is np.ndarray:
        return "an array"
    if origin is Callable:
        return "a function"
    if origin in (Mapping, dict):
        return f"a dict with {_words(inside[1])} for each {'name' if inside[0] is str else 'key'}"
    if is_typeddict(kind):
        return "a dict of options"
    if origin is tuple and inside[-1] is not ...:
        return f"{len(inside)} values, each {_words(inside[0])}"
    if origin is not None:
        return "a list" if inside[0] is Any else f"a list, each {_words(inside[0])}"
    noun = getattr(kind, "__name__", "value")
    return f"{'an' if noun[0] in 'AEIOU' else 'a'} {noun}"

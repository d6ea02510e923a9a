"""Frozen dataclasses that are quick to define.

``dataclasses.dataclass(frozen=True)`` compiles up to six functions for each class while the package is
imported. Five of them can be the same for all classes, and are written here once. The sixth, ``__init__``,
is compiled where a class gets many objects: most that a command imports get none or a few.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, field, fields
from functools import cache, partial
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any, TypeVar, overload

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_):
        """Tell type checkers what a decorator makes, and nothing at run time."""
        return lambda decorator: decorator


T = TypeVar("T")
_FEW = 20  # objects, which take as long as compiling


class _NotGiven:
    """Stands for a default that a factory makes; signatures show it so."""

    def __repr__(self) -> str:
        return "<factory>"


_NOT_GIVEN = _NotGiven()


@overload
def frozen_dataclass(cls: type[T], /) -> type[T]: ...


@overload
def frozen_dataclass(*, eq: bool) -> Callable[[type[T]], type[T]]: ...


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen_dataclass(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class what ``dataclasses.dataclass(frozen=True, eq=eq)`` makes it, in a tenth of the time.

    Keyword-only fields, inheritance and ``__post_init__`` are as they are there; slots, ``InitVar`` and order
    are left out.
    """
    return _frozen(cls, eq) if cls is not None else lambda decorated: _frozen(decorated, eq)


def _frozen(cls: type, eq: bool) -> type:
    # Without a docstring, `dataclass` makes one from the signature, which would compile `__init__`.
    cls.__doc__ = cls.__doc__ or cls.__name__
    dataclass(init=False, repr=False, eq=False)(cls)
    methods = {"__init__": _Init(cls), "__repr__": _repr, "__setattr__": _setattr, "__delattr__": _delattr}
    if eq:
        methods |= {"__eq__": _eq, "__hash__": _hash}
    for name, method in methods.items():
        if name not in cls.__dict__ or (name == "__hash__" and cls.__hash__ is None):
            setattr(cls, name, method)
    return cls


class _Init:
    """``__init__`` of the first objects, which needs no compiling; then a compiled one takes its place."""

    def __init__(self, cls: Any) -> None:
        self.cls, self.calls = cls, 0

    def __get__(self, instance: object, owner: type) -> Any:
        if self.calls >= _FEW or not isinstance(instance, self.cls):  # a signature is asked for
            return self._compiled().__get__(instance, owner)
        self.calls += 1
        return partial(self._assign, instance)

    def _compiled(self) -> Any:
        self.cls.__init__ = init = _compiled_init(self.cls)
        return init

    def _assign(self, instance: Any, /, *args: object, **named: object) -> None:
        members = fields(self.cls)
        given = dict(zip((f.name for f in members if f.init and not f.kw_only), args, strict=False)) | named
        wrong = len(given) < len(args) + len(named)
        for f in members:
            if f.init and f.name in given:
                value = given.pop(f.name)
            elif f.default_factory is not MISSING:
                value = f.default_factory()
            elif f.init:
                value = f.default
                wrong |= value is MISSING
            else:
                continue
            object.__setattr__(instance, f.name, value)
        if wrong or given:
            self._compiled()(instance, *args, **named)  # which says what is wrong
        elif hasattr(instance, "__post_init__"):
            instance.__post_init__()


def _compiled_init(cls: Any) -> Any:
    members = fields(cls)
    # A dictionary of its own, but with the module's names, for those who look for what annotations mean.
    known = {
        **getattr(sys.modules.get(cls.__module__), "__dict__", {}),
        "_set": object.__setattr__,
        "_NOT_GIVEN": _NOT_GIVEN,
    }
    known |= {f"_{f.name}_default": f.default for f in members if f.default is not MISSING}
    known |= {f"_{f.name}_factory": f.default_factory for f in members if f.default_factory is not MISSING}
    body = [f" _set(self, {f.name!r}, {value})" for f in members if (value := _value(f))]
    if hasattr(cls, "__post_init__"):
        body.append(" self.__post_init__()")
    exec("\n".join([f"def __init__({', '.join(_parameters(members))}):", *(body or [" pass"])]), known)
    init: Any = known["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    init.__annotations__ = {f.name: f.type for f in members if f.init} | {"return": None}
    return init


def _parameters(members: Sequence[Field[Any]]) -> Iterator[str]:
    yield "self"
    yield from (_parameter(f) for f in members if f.init and not f.kw_only)
    by_name = [_parameter(f) for f in members if f.init and f.kw_only]
    if by_name:
        yield from ("*", *by_name)


def _parameter(f: Field[Any]) -> str:
    if f.default is not MISSING:
        return f"{f.name}=_{f.name}_default"
    return f.name if f.default_factory is MISSING else f"{f.name}=_NOT_GIVEN"


def _value(f: Field[Any]) -> str:
    """What ``__init__`` assigns to a field; nothing where the class has it, or ``__post_init__`` sets it."""
    made = "" if f.default_factory is MISSING else f"_{f.name}_factory()"
    if made and f.init:
        return f"{made} if {f.name} is _NOT_GIVEN else {f.name}"
    return f.name if f.init else made


@recursive_repr()
def _repr(self: Any) -> str:
    shown = ", ".join(f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.repr)
    return f"{type(self).__qualname__}({shown})"


def _eq(self: Any, other: object) -> bool:
    return _compared(self) == _compared(other) if type(other) is type(self) else NotImplemented


def _hash(self: Any) -> int:
    return hash(_compared(self))


def _compared(value: Any) -> tuple[Any, ...]:
    return tuple([getattr(value, name) for name in _compared_fields(value.__class__)])


@cache
def _compared_fields(cls: Any) -> list[str]:
    return [f.name for f in fields(cls) if f.compare]


def _setattr(self: Any, name: str, value: object) -> None:
    if _is_frozen(self, name):
        raise FrozenInstanceError(f"cannot assign to field {name!r}")
    object.__setattr__(self, name, value)


def _delattr(self: Any, name: str) -> None:
    if _is_frozen(self, name):
        raise FrozenInstanceError(f"cannot delete field {name!r}")
    object.__delattr__(self, name)


def _is_frozen(value: Any, name: str) -> bool:
    """Whether this is a field; or anything at all, where the class itself has been made here."""
    return "__dataclass_fields__" in vars(type(value)) or name in value.__dataclass_fields__

"""Frozen dataclasses that are quick to define.

``dataclasses.dataclass(frozen=True)`` compiles six functions for each class while the package is imported,
which took a fifth of a calibration of 13 views. Five of them can be the same for all classes, and are written
here once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, dataclass, field, fields
from functools import cache
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, overload

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform
else:

    def dataclass_transform(**_):
        """Tell type checkers what a decorator makes, and nothing at run time."""
        return lambda decorator: decorator


T = TypeVar("T")


@overload
def frozen_dataclass(cls: type[T], /) -> type[T]: ...


@overload
def frozen_dataclass(*, eq: bool) -> Callable[[type[T]], type[T]]: ...


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen_dataclass(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class what ``dataclasses.dataclass(frozen=True, eq=eq)`` makes it, in a third of the time."""
    return _frozen(cls, eq) if cls is not None else lambda decorated: _frozen(decorated, eq)


def _frozen(cls: type, eq: bool) -> type:
    cls.__doc__ = cls.__doc__ or cls.__name__  # else `dataclass` looks for the signature
    dataclass(repr=False, eq=False)(cls)
    shared: dict[str, Any] = {"__repr__": _repr, "__setattr__": _setattr, "__delattr__": _delattr}
    if eq:
        shared |= {"__eq__": _eq, "__hash__": _hash}
    for name in shared.keys() - vars(cls).keys():
        setattr(cls, name, shared[name])
    return cls


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
    # `__init__` assigns each field once.
    if name in vars(self) or name not in self.__dataclass_fields__:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")
    vars(self)[name] = value


def _delattr(self: Any, name: str) -> NoReturn:
    raise FrozenInstanceError(f"cannot delete field {name!r}")

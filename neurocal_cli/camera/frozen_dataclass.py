"""Frozen dataclasses that are quick to define.

``dataclasses.dataclass(frozen=True)`` compiles six functions for each class while the package is imported,
which takes about 40 ms for the classes that `neurocal calibrate` imports. Five of them can be the same for
all classes, and are written here once. What is compiled of the sixth, ``__init__``, is the names of its
arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, field, fields
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
_LARGE = 20  # elements of an array of which the shape tells more


@overload
def frozen_dataclass(cls: type[T], /) -> type[T]: ...


@overload
def frozen_dataclass(*, eq: bool) -> Callable[[type[T]], type[T]]: ...


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen_dataclass(cls: Any = None, /, *, eq: bool = True) -> Any:
    """Make a class what ``dataclasses.dataclass(frozen=True, eq=eq)`` makes it, in a fifth of the time."""
    return _frozen(cls, eq) if cls is not None else lambda decorated: _frozen(decorated, eq)


def _frozen(cls: type, eq: bool) -> type:
    cls.__doc__ = cls.__doc__ or cls.__name__  # else `dataclass` looks for the signature
    dataclass(init=False, repr=False, eq=False)(cls)
    methods: dict[str, Any] = {"__repr__": _repr, "__setattr__": _setattr, "__delattr__": _delattr}
    if eq:
        methods |= {"__eq__": _eq, "__hash__": _hash}
    if "__init__" not in vars(cls):
        methods["__init__"] = _init(cls)
    for name in methods.keys() - vars(cls).keys():
        setattr(cls, name, methods[name])
    return cls


class _Factory:
    """Stands in a signature for a default that is made anew for each object."""

    def __repr__(self) -> str:
        return "<factory>"


_FACTORY = _Factory()


def _init(cls: Any) -> Callable[..., None]:
    """The ``__init__`` of a class whose fields are known."""
    arguments = [f for f in fields(cls) if f.init]
    by_position = [f for f in arguments if not f.kw_only]
    by_name = [f for f in arguments if f.kw_only]
    factories = {f.name: f.default_factory for f in fields(cls) if f.default_factory is not MISSING}
    defaults = {f.name: f.default for f in arguments if f.default is not MISSING}
    defaults |= {f.name: _FACTORY for f in arguments if f.name in factories}
    has_post_init = hasattr(cls, "__post_init__")

    def assign(self: Any, values: dict[str, Any]) -> None:
        del values["self"]
        vars(self).update(values)
        for name, factory in factories.items():
            if values.get(name, _FACTORY) is _FACTORY:
                vars(self)[name] = factory()
        if has_post_init:
            self.__post_init__()

    def argument(f: Field[Any]) -> str:
        # The default itself is put in its place afterwards; this one lets Python check the order.
        return f"{f.name}=0" if f.name in defaults else f.name

    names = ["self", *map(argument, by_position), *["*"][: len(by_name)], *map(argument, by_name)]
    compiled: dict[str, Any] = {"_assign": assign, "__name__": cls.__module__}
    exec(f"def __init__({', '.join(names)}): _assign(self, locals())", compiled)
    init = compiled["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    init.__annotations__ = {f.name: f.type for f in arguments} | {"return": None}
    init.__defaults__ = tuple([defaults[f.name] for f in by_position if f.name in defaults])
    init.__kwdefaults__ = {f.name: defaults[f.name] for f in by_name if f.name in defaults}
    return init


@recursive_repr()
def _repr(self: Any) -> str:
    shown = ", ".join(f"{f.name}={_shown(getattr(self, f.name))}" for f in fields(self) if f.repr)
    return f"{type(self).__qualname__}({shown})"


def _shown(value: Any) -> str:
    """A value, but of a large array its shape."""
    return f"<array {value.shape}>" if getattr(value, "size", 0) > _LARGE else repr(value)


def _eq(self: Any, other: object) -> bool:
    return _compared(self) == _compared(other) if type(other) is type(self) else NotImplemented


def _hash(self: Any) -> int:
    return hash(_compared(self))


def _compared(value: Any) -> tuple[Any, ...]:
    return tuple([_plain(getattr(value, name)) for name in _compared_fields(value.__class__)])


def _plain(value: Any) -> Any:
    """An array as a tuple, which can be compared and hashed; all else as it is."""
    return (value.shape, *value.ravel().tolist()) if hasattr(value, "ravel") else value


@cache
def _compared_fields(cls: Any) -> list[str]:
    return [f.name for f in fields(cls) if f.compare]


def _setattr(self: Any, name: str, value: object) -> NoReturn:
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _delattr(self: Any, name: str) -> NoReturn:
    raise FrozenInstanceError(f"cannot delete field {name!r}")

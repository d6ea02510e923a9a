"""Optional compilation by numba: the same source runs as plain Python where numba is missing."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any, TypeVar, cast


def _importable() -> ModuleType | None:
    """Import numba if it is installed and not switched off by its own NUMBA_DISABLE_JIT."""
    try:
        numba = import_module("numba")
    except ImportError:
        return None
    return None if numba.config.DISABLE_JIT else numba


_NUMBA = _importable()

# Whether `jit` compiles or returns the Python function.
COMPILING = _NUMBA is not None

_Function = TypeVar("_Function", bound=Callable[..., Any])


def jit(function: _Function) -> _Function:
    """Compile a function of numbers and arrays, and cache the machine code on disk if possible."""
    if _NUMBA is None:
        return function
    try:
        return cast(_Function, _NUMBA.njit(cache=True)(function))
    except RuntimeError:
        # Neither the package's folder nor the user's cache is writable: compile at each start.
        return cast(_Function, _NUMBA.njit(function))

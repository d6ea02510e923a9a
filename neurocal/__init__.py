"""neurocal: the public names of the package `neurocal_cli`, under the name of the program."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import neurocal_cli
from neurocal_cli import __version__

if TYPE_CHECKING:
    from neurocal_cli import *  # noqa: F403 - for type checkers; at run time each name is loaded on first use

__all__ = [*neurocal_cli.__all__, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in neurocal_cli.__all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(neurocal_cli, name)


def __dir__() -> list[str]:
    return sorted(__all__)

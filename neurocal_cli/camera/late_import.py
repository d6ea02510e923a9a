"""Functions that are imported when they are called.

A user looks for what can be done with a result among its methods: `Calibration.summary`. Where the function
behind a method is built on the class itself, or stands in a room above it, the method finds it here by its
name, so that no module has to import what is built on it. A test checks that all names exist.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


def late(module: str, name: str) -> Callable[..., Any]:
    """The function of this name in a module of the package, such as ``files.camera_tree``."""
    found: Callable[..., Any] = getattr(import_module(f"neurocal_cli.{module}"), name)
    return found

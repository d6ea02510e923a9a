"""A list of methods as a value of an option."""

from __future__ import annotations

from typing import Any

import click

__all__ = ["MethodNames"]

# Those of `comparison.by_method`, which a test compares.
NAMES = ("neuro", "backprop", "nonlinear", "linear", "tsai", "opencv")


class MethodNames(click.ParamType):  # type: ignore[type-arg]
    """Names of methods, separated by commas; a tuple without repetitions."""

    name = "methods"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Split, or fail as click does."""
        if isinstance(value, tuple):
            return value
        names = tuple(dict.fromkeys(name.strip() for name in value.split(",") if name.strip()))
        if not names or any(name not in NAMES for name in names):
            self.fail(f"{value!r} is not a list of {', '.join(NAMES)}.", param, ctx)
        return names

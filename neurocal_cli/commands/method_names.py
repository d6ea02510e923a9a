"""A list of methods as a value of an option."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

# Those of `comparison.by_method`, which a test compares.
NAMES = ("neuro", "backprop", "nonlinear", "linear", "tsai", "opencv")


class _MethodNames(click.ParamType):  # type: ignore[type-arg]
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


def methods_option(default: str) -> Callable[[F], F]:
    """Add ``--methods``, the methods to compare."""
    return click.option(
        "--methods",
        metavar="M,...",
        type=_MethodNames(),
        default=default,
        help="Methods to compare, of neuro, backprop, nonlinear, linear, tsai and opencv. backprop is neuro "
        "with the paper's trainer.",
    )

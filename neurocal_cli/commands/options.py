"""Arguments and options that several commands share, so that they cannot diverge."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any, TypeVar

import click
from click.types import FloatParamType

from neurocal_cli.errors import UsageError

_PICTURES = (".png", ".pdf", ".svg")

F = TypeVar("F", bound=Callable[..., Any])

# Existence and readability are the reader's business: a file that cannot be read is exit code 1.
INPUT = click.Path(readable=False, allow_dash=True)


class Argument(click.Argument):
    """An argument that says what it is, in ``--help`` and in the man page."""

    def __init__(self, *args: Any, description: str, **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self.description = description


class Command(click.Command):
    """A command whose help lists its arguments before its options."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse, and say where --quiet and --verbose stand."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.option_name not in ("-q", "--quiet", "-v", "--verbose"):
                raise
            line = " ".join(["neurocal", error.option_name, *ctx.command_path.split()[1:]])
            told = f"{error.option_name} stands before the command: {line}"
            raise click.NoSuchOption(error.option_name, told, ctx=ctx) from None

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the arguments, then the options."""
        rows = [(str(p.metavar), p.description) for p in self.params if isinstance(p, Argument)]
        if rows:
            with formatter.section("Arguments"):
                formatter.write_dl(rows)
        super().format_options(ctx, formatter)


class FiniteNumber(FloatParamType):
    """A number that can be computed with: neither nan nor infinite.

    Parameters
    ----------
    positive : bool
        Whether it must be greater than 0.
    """

    def __init__(self, positive: bool = False) -> None:
        self._positive = positive

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read a number, or fail as click does."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        if self._positive and number <= 0:
            self.fail(f"{value!r} is not greater than 0.", param, ctx)
        return number


def input_argument(name: str, metavar: str, description: str, **more: Any) -> Callable[[F], F]:
    """Add an argument that names what is read."""
    return click.argument(name, metavar=metavar, type=INPUT, cls=Argument, description=description, **more)


def points_argument(f: F) -> F:
    """Add POINTS..., one or more CSV files that are read as one."""
    return input_argument(
        "points",
        "POINTS...",
        "CSV files with the columns X,Y,Z,u,v and optionally view. Several files are read as "
        "one; - is standard input.",
        nargs=-1,
        required=True,
    )(f)


def output_option(metavar: str, what: str) -> Callable[[F], F]:
    """Add ``-o``, where the result goes; stdout unless it is given."""
    return click.option(
        "-o",
        "--output",
        metavar=metavar,
        type=click.Path(writable=False, readable=False, allow_dash=True),
        default="-",
        show_default="standard output",
        help=f"Write {what} to this file.",
    )


camera_name_option = click.option(
    "--camera-name", metavar="NAME", default="camera", help="Name of the camera in the output file."
)


def check_camera_name(name: str) -> None:
    """Refuse a name that no file can hold.

    Raises
    ------
    UsageError
    """
    if not name.strip() or not name.isprintable():
        raise UsageError("--camera-name must hold printable characters only; give another name")


def alpha_option(default: str) -> Callable[[F], F]:
    """Add ``--alpha``, how much of the original images is shown; see `check_alpha`."""
    return click.option(
        "--alpha",
        metavar="ALPHA",
        type=FiniteNumber(),
        show_default=default,
        help="Zoom of the images: 0 shows valid pixels only, 1 shows all pixels of the original images.",
    )


def check_alpha(alpha: float | None) -> None:
    """Refuse an alpha that is no share.

    Raises
    ------
    UsageError
    """
    if alpha is not None and not 0 <= alpha <= 1:
        raise UsageError(f"--alpha is {alpha:g}; give a number from 0 to 1")


interpolation_option = click.option(
    "--interpolation",
    type=click.Choice(["nearest", "linear", "cubic", "lanczos"]),
    default="cubic",
    help="Interpolation between the pixels of an image.",
)


def json_option(f: F) -> F:
    """Add ``--json``, for programs that read the result."""
    return click.option(
        "--json",
        "as_json",
        is_flag=True,
        show_default="print tables",
        help="Print one JSON object instead of tables.",
    )(f)


def lean_option(f: F) -> F:
    """Add ``--lean``, for a file without the points."""
    return click.option(
        "--lean",
        is_flag=True,
        show_default="no",
        help="Leave the points, the poses and the network out of the file, so that it is short.",
    )(f)


def plot_option(what: str) -> Callable[[F], F]:
    """Add ``--plot``, a picture of something; see `check_plot`."""
    return click.option(
        "--plot",
        metavar="FILE.png",
        type=click.Path(writable=False, readable=False),
        show_default="none",
        help=f"Plot {what} to this .png, .pdf or .svg file.",
    )


def check_plot(plot: str | None, output: str | None = None) -> None:
    """Refuse a picture that cannot be drawn, before any work is done.

    Raises
    ------
    UsageError
        A name that is no picture's, or the output's.
    NeurocalError
        matplotlib is not installed.
    """
    if plot is None:
        return
    if not plot.lower().endswith(_PICTURES):
        raise UsageError(
            f"--plot {plot}: not a picture file; give a name that ends in {', '.join(_PICTURES)}"
        )
    if output not in (None, "-") and os.path.realpath(str(output)) == os.path.realpath(plot):
        raise UsageError("-o and --plot name the same file; give two different files")
    from neurocal_cli.plots.figure import check_available

    check_available()

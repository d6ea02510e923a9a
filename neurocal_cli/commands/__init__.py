"""The command line: the group ``neurocal``, whose commands load when they run.

A command parses, reads, calls one function of the library and shows what it returns. Errors of all
commands become one line and an exit status here and nowhere else. Modules of commands import nothing
at their top that needs NumPy, so that ``--help`` is fast.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import click

from neurocal_cli import __version__
from neurocal_cli.commands.streams import (
    NEXT,
    TYPED,
    HelpContext,
    debugging,
    one_line,
    set_verbosity,
    tell,
    tell_ending,
    waiting,
    wrapped,
)
from neurocal_cli.errors import NeurocalError, UsageError

__all__ = ["neurocal"]

# Each command is the function of this name in the module of this name, or in that of `_WITH`.
# The summaries stand here as well as in the commands' help, so that ``neurocal --help`` loads none of them.
_SUMMARIES = {
    "advise": "Advise which views of the target to photograph next.",
    "batch": "Calibrate many data sets, and summarise the fleet.",
    "board": "Draw a target to print: chessboard, ChArUco, tags or circles.",
    "calibrate": "Calibrate a camera from known points and their pixels.",
    "compare": "Compare calibration methods on the same points.",
    "convert": "Convert cameras, rigs and points to the formats of other programs.",
    "detect": "Detect boards in images and measure points on them.",
    "drift": "Tell whether a camera or a rig has changed since an earlier calibration.",
    "evaluate": "Measure the error of a calibrated camera or rig.",
    "lens": "Calibrate a zoom lens, whose zoom and focus change.",
    "rectify": "Rectify pairs of images and points of two cameras.",
    "report": "Show a calibration, a rig or a zoom lens as one HTML page.",
    "resize": "Make the camera or the rig of resized, binned or cropped images.",
    "rig": "Calibrate a rig of any number of cameras, and their poses relative to the first.",
    "sample": "Write the sample data, with which all examples work.",
    "simulate": "Calibrate simulated cameras, and compare the methods' errors.",
    "stereo": "Calibrate two cameras and the pose of the right one relative to the left one.",
    "target": "Write the board with its estimated shape.",
    "triangulate": "Compute points in space from their pixels in two images or more.",
    "undistort": "Remove the lens distortion from images and points.",
}
_WITH = {"stereo": "rig", "target": "board"}


class _LazyGroup(click.Group):
    """A group that imports a command's module only when it is used."""

    context_class = HelpContext

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands."""
        return list(_SUMMARIES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of a name, loaded now."""
        # All are loaded for a wrong name, so that click can suggest the nearest one.
        for name in [cmd_name] if cmd_name in _SUMMARIES else _SUMMARIES:
            if name not in self.commands:
                module = import_module(f"{__name__}.{_WITH.get(name, name)}")
                self.add_command(getattr(module, name), name)
        return self.commands.get(cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; ``help COMMAND`` is ``COMMAND --help``."""
        if args == ["help"]:
            click.echo(ctx.get_help())
            ctx.exit()
        return super().resolve_command(ctx, [*args[1:], "--help"] if args[0] == "help" else args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the table of commands without loading them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(_SUMMARIES.items()))

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Parse, and keep the words of the command line; ``--help`` is shown here."""
        words = tuple(args)  # parsing empties args
        with _one_line_errors():
            ctx = super().make_context(info_name, args, parent, **extra)
        if parent is None:
            ctx.meta[TYPED] = words
        return ctx

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, and say in the end what it wrote and what to do next."""
        with _one_line_errors(), _ended(ctx):
            return super().invoke(ctx)


@contextmanager
def _ended(ctx: click.Context) -> Iterator[None]:
    """Write all outputs or none, and tell the end of a command that has not failed."""
    from neurocal_cli.files.writing import all_or_none

    try:
        with all_or_none(finishing=(click.exceptions.Exit,)) as outputs, waiting("reading"):
            yield
    except click.exceptions.Exit:
        tell_ending(outputs.written, ctx.meta.get(NEXT, ()))
        raise
    tell_ending(outputs.written, ctx.meta.get(NEXT, ()))


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Convert errors to one line on stderr and an exit status; click does so with its own errors."""
    try:
        yield
        return
    except click.UsageError as error:  # click shows it, but breaks lines anywhere
        told = wrapped(f"Error: {error.format_message()}", sys.stderr).removeprefix("Error: ")
        raise click.UsageError(told, error.ctx) from None
    except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
        raise  # click's own, and a reader that has seen enough
    except KeyboardInterrupt:
        message, exit_code = "interrupted", 130
    except NeurocalError as error:
        message, exit_code = str(error), error.exit_code
    except Exception as error:
        if debugging():
            raise
        message, exit_code = _explain(error), 1
    tell(f"Error: {one_line(message)}")
    raise click.exceptions.Exit(exit_code)


def _explain(error: Exception) -> str:
    """Describe an error that is not one of neurocal's own."""
    if isinstance(error, MemoryError):
        return "not enough memory; use fewer points"
    if isinstance(error, RecursionError):
        return "the input is nested too deeply; give a file that neurocal wrote"
    if isinstance(error, UnicodeError):
        return f"a text cannot be read or written as UTF-8 ({error}); save the file as UTF-8"
    if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        return "stdout cannot be written (no space left on device); free some, or give a file on another disk"
    if isinstance(error, OSError) and error.strerror:
        place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        return f"{place}{error.strerror}"
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"internal error: {what}; run with NEUROCAL_DEBUG=1 to see where"


@click.command(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.option(
    "-q",
    "--quiet",
    count=True,
    show_default=False,
    help="Print only warnings and errors; twice: only errors.",
)
@click.option(
    "-v",
    "--verbose",
    is_flag=True,
    show_default=False,
    help="Also print progress with times, and all reasons of a verdict.",
)
@click.version_option(__version__, message="%(prog)s %(version)s", help="Show the version and exit.")
def neurocal(quiet: int, verbose: bool) -> None:
    """Calibrate cameras with a neural network whose weights are the camera.

    The network learns to project known points onto their pixels. Its output weights become the
    intrinsic parameters, and its hidden weights become the pose. It starts from random weights, so
    no initial guess is needed.

    Results go to standard output. Tables, warnings and errors go to standard error. The file name
    `-` stands for standard input or standard output, so commands can be joined in a pipeline. --quiet and
    --verbose stand before the command.

    \b
    Examples:
      neurocal sample sample_data
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          -o points.csv
      neurocal calibrate points.csv -o camera.yaml
      neurocal evaluate camera camera.yaml
      neurocal undistort camera.yaml sample_data/board*.png -o undistorted
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal triangulate rig.yaml sample_data/matches.csv -o xyz.csv
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      cat points.csv | neurocal -q calibrate - | neurocal evaluate camera -
      neurocal -v calibrate points.csv -o camera.yaml
    """  # noqa: D301 - click's mark of a paragraph not to be wrapped
    if quiet and verbose:
        raise UsageError("--quiet and --verbose contradict each other; give one of them")
    set_verbosity(-quiet if quiet else int(verbose))
    # The matrices are small: threads cost three times the time that they save, and their number would change
    # the last digits. NumPy looks once, when it is loaded. The user's own setting takes precedence.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(name, "1")

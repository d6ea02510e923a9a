"""The options ``--plot`` and ``--html``: pictures of a result, and a page about it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands import options
from neurocal_cli.commands.options import F
from neurocal_cli.commands.show.figure import check_available
from neurocal_cli.commands.streams import TYPED, ProgressBar
from neurocal_cli.errors import UsageError
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.writing import write_whole

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.rig.rig import Rig
    from neurocal_cli.calibration.rig.stereo_rig import StereoRig

_PICTURES = (".png", ".pdf", ".svg")

Plots = tuple[tuple[str | None, str], ...]  # panel, or None for all of them, and file


def plot_option(what: str) -> Callable[[F], F]:
    """Add ``--plot``, a picture of the result; see `check_plot`."""
    return options.path("--plot", "FILE.png", f"Plot {what} to this .png, .pdf or .svg file.")


def panel_option(what: str, panels: Sequence[str]) -> Callable[[F], F]:
    """Add ``--plot``, which draws all panels on a page or one of them; the value is of the type `Plots`."""

    def parse(ctx: click.Context, param: click.Parameter, words: Iterable[str]) -> Plots:
        plots: list[tuple[str | None, str]] = []
        for word in words:
            panel, equals, file = word.partition("=")
            if equals and panel.isalpha() and panel not in panels:
                raise click.BadParameter(
                    f"there is no panel {panel!r}; choose from {', '.join(panels)}, or write ./{word} for a "
                    "file of this name"
                )
            plots.append((panel, file) if equals and panel in panels else (None, word))
        return tuple(plots)

    return click.option(
        "--plot",
        "plots",
        metavar="[PANEL=]FILE.png",
        multiple=True,
        callback=parse,
        show_default="none",
        help=f"Plot {what} to this .png, .pdf or .svg file: all panels on one page, or one of them: "
        f"{', '.join(panels)}. It can be repeated.",
    )


def check_plot(plot: str | None) -> None:
    """Refuse a picture that cannot be drawn, before any work is done."""
    if plot is None:
        return
    if not plot.lower().endswith(_PICTURES):
        raise UsageError(
            f"--plot {plot}: not a picture file; give a name that ends in {', '.join(_PICTURES)}"
        )
    check_available()


def files_of(plots: Plots) -> list[str]:
    """The files of pictures."""
    return [file for _, file in plots]


def write_plots(plots: Plots, draw: Callable[..., bytes], *subject: Any) -> None:
    """Draw and write all pictures of a subject; see `write_plot`."""
    for panel, file in plots:
        write_plot(file, partial(draw, panel=panel), *subject)


def write_plot(file: str | None, draw: Callable[..., bytes], *subject: Any) -> None:
    """Draw and write a picture of a subject, of the `kind` that its name ends in, unless there is none."""
    if file is None:
        return
    with ProgressBar(f"drawing {file}"):
        write_whole(file, draw(*subject, kind=os.path.splitext(file)[1][1:].lower()))


html_option = options.path(
    "--html",
    "REPORT.html",
    "Also write the page that `neurocal report` makes, with this command and the SHA-256 of its inputs.",
)


def write_page(html: str | None, result: Calibration | StereoRig | Rig, *inputs: str | None) -> None:
    """Write the page about a result from these input files; does nothing without a name."""
    if html is None:
        return
    import hashlib
    import shlex

    from neurocal_cli.commands.show.html_page import Origin, versions
    from neurocal_cli.commands.show.html_reports import page_of

    files = {}
    for name in inputs:
        if name is not None and name != "-":  # what came through a pipe is gone
            data, source = read_bytes(name)
            files[source] = hashlib.sha256(data).hexdigest()
    typed = click.get_current_context().meta.get(TYPED, ())
    origin = Origin(files, shlex.join(("neurocal", *typed)), versions())
    write_whole(html, page_of(result, origin))

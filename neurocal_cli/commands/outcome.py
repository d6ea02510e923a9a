"""The outcome of a command that makes a result: its file, its pictures and its page, and its summary."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.options import F
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.streams import TYPED, print_summary, tell_summary, warn
from neurocal_cli.files.reading import read_bytes
from neurocal_cli.files.writing import write_whole

_NOT_CONVERGED = 3  # exit status


@frozen_dataclass
class Outputs:
    """Where a result goes, and how its summary is shown."""

    plots: Plots
    html: str | None
    lean: bool
    as_json: bool
    output: str

    def check(self, inputs: Iterable[str | None], *others: str | None) -> None:
        """Refuse what cannot be read, drawn or written, before any work is done."""
        preparation.check(inputs, (self.output, self.html, *others), plots=self.plots, as_json=self.as_json)

    @contextmanager
    def concluding(
        self,
        result: Any,
        in_json: Callable[[Any], dict[str, Any]],
        write: Callable[[Any, str], tuple[str, ...] | None],
        inputs: Iterable[str | None] = (),
    ) -> Iterator[None]:
        """Show the summary of a result from these files, and write it, with its pictures and its page.

        Further outputs are written inside. `write` returns what the file cannot represent. As JSON, the
        summary is printed after all. In the end, exit if the training did not converge.
        """
        tell_summary(lambda: in_json(result), None if self.as_json else result.summary)
        if not self.as_json:
            warn(*result.warnings)
        if not preparation.is_for_the_eye(self.output):
            warn(*(write(result, self.output) or ()))
        yield
        if self.plots:  # the modules of pictures are loaded only for them
            from neurocal_cli.commands.show.results import plot

            write_plots(self.plots, plot, result)
        if self.html is not None:
            write_whole(self.html, _page(result, inputs))
        if self.as_json:
            print_summary(in_json(result))
            warn(*result.warnings)
        if not result.converged:
            click.get_current_context().exit(_NOT_CONVERGED)


def outputs(
    metavar: str, help: str, plotted: str, panels: Sequence[str] = (), page: bool = True
) -> Callable[[F], F]:
    """Add the options of `Outputs`, a command's keyword ``outputs``; ``--html`` and ``--lean`` for a `page`.

    `metavar` and `help` are those of the file, `plotted` and `panels` as for `plot_option`.
    """
    added = [
        plot_option(plotted, panels),
        *([_html, options.lean] if page else []),
        options.summary,
        options.output(metavar, help),
    ]
    return options.collected(Outputs, added, "outputs")


_html = options.path(
    "--html",
    "REPORT.html",
    "Also write the page that `neurocal report` makes, with this command and the SHA-256 of its inputs.",
)


def _page(result: Any, inputs: Iterable[str | None]) -> str:
    """The page about a result from these input files."""
    import hashlib
    import shlex

    from neurocal_cli.commands.show.html_page import Origin, versions
    from neurocal_cli.commands.show.html_reports import page_of

    files = {}
    for name in inputs:
        if name is not None:
            data, source = read_bytes(name)
            files[source] = hashlib.sha256(data).hexdigest()
    typed = click.get_current_context().meta.get(TYPED, ())
    return page_of(result, Origin(files, shlex.join(("neurocal", *typed)), versions()))

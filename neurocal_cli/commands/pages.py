"""The option ``--html``: a page about the command's result."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options
from neurocal_cli.commands.streams import TYPED

if TYPE_CHECKING:
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.stereo.rig import Rig

html_option = options.path(
    "--html",
    "REPORT.html",
    "Also write the page that `neurocal report` makes, with this command and the SHA-256 of its inputs.",
)


def write_page(html: str | None, result: Calibration | Rig, *inputs: str | None) -> None:
    """Write the page about a result from these input files; does nothing without a name."""
    if html is None:
        return
    import hashlib
    import shlex

    from neurocal_cli.html_report.origin import Origin, versions
    from neurocal_cli.html_report.reports import calibration_page, rig_page
    from neurocal_cli.io.files import read_bytes
    from neurocal_cli.io.writing import write_whole
    from neurocal_cli.stereo.rig import Rig

    files = {}
    for name in inputs:
        if name is not None and name != "-":  # what came through a pipe is gone
            data, source = read_bytes(name)
            files[source] = hashlib.sha256(data).hexdigest()
    typed = click.get_current_context().meta.get(TYPED, ())
    origin = Origin(files, shlex.join(("neurocal", *typed)), versions())
    write_whole(
        html, rig_page(result, origin) if isinstance(result, Rig) else calibration_page(result, origin)
    )

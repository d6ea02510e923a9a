"""``neurocal report``: a result as one HTML page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from neurocal_cli.commands.options import INPUT, Argument, Command
from neurocal_cli.commands.places import check_outputs

if TYPE_CHECKING:
    from neurocal_cli.io.tree_fields import Field

__all__ = ["report"]


@click.command(cls=Command)
@click.argument(
    "result",
    metavar="CAMERA.yaml|RIG.yaml|LENS.yaml",
    type=INPUT,
    cls=Argument,
    description="What neurocal calibrate, stereo or lens fit wrote; - is standard input.",
)
@click.option(
    "-o",
    "--output",
    metavar="REPORT.html",
    type=click.Path(writable=False, readable=False, allow_dash=True),
    default="-",
    show_default="standard output",
    help="Write the page to this file.",
)
def report(result: str, output: str) -> None:
    """Show a calibration, a rig or a zoom lens as one HTML page.

    The page begins with the verdict. It has all parameters with their standard deviations, the residuals of
    all points and of each view as drawings, a table of the views that can be sorted, what was left out, the
    warnings, and how to repeat the result. It is one file, loads nothing from elsewhere, and is readable in
    the dark, on a telephone and on paper.

    \b
    Examples:
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal report camera.yaml -o report.html
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          | neurocal report - -o rig.html
    """  # noqa: D301 - as in the group
    check_outputs((output,), (result,))
    import hashlib

    from neurocal_cli.io.file_storage import parse_tree
    from neurocal_cli.io.files import decode, read_bytes
    from neurocal_cli.io.writing import write_whole

    data, source = read_bytes(result)
    root = parse_tree(decode(data, source, "a calibration"), source)
    write_whole(output, _page(root, source, hashlib.sha256(data).hexdigest()))


def _page(root: Field, source: str, digest: str) -> str:
    """The page of what the file holds."""
    from neurocal_cli.html_report.reports import calibration_page, lens_page, rig_page

    if "stereo" in root:
        from neurocal_cli.io.rig_yaml import rig_from_field

        return rig_page(rig_from_field(root), source, digest)
    if "neurocal_lens" in root:
        from neurocal_cli.io.lens_yaml import lens_from_field

        return lens_page(lens_from_field(root), source, digest)
    from neurocal_cli.io.calibration_tree import calibration_from_field

    return calibration_page(calibration_from_field(root), source, digest)

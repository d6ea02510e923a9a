"""``neurocal report``: a result as one HTML page."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import note, suggest
from neurocal_cli.errors import UsageError, plural
from neurocal_cli.files.reading import decode, read_bytes
from neurocal_cli.files.writing import write_whole

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.files.tree_fields import Field

_MOST_BYTES = 1_400_000  # of all photographs; encoded as text they take a third more


@click.command(cls=options.Command)
@options.argument(
    "result",
    "CAMERA.yaml|RIG.yaml|LENS.yaml",
    "What neurocal calibrate, stereo or lens fit wrote; - is standard input.",
)
@options.path(
    "--images",
    "DIR",
    "Show the photographs of the views, with the residuals over them: a folder or a pattern such as "
    "'left*.png', whose files have the names of the views. For a rig give it for each camera in their order, "
    "or once for all.",
    multiple=True,
)
@options.output("REPORT.html", "Write the page to this file.")
def report(result: str, images: tuple[str, ...], output: str) -> None:
    """Show a calibration, a rig or a zoom lens as one HTML page.

    The page begins with the verdict. It has all parameters with their standard deviations, drawings of the
    residuals of all points and of each view, a sortable table of the views, the outliers, the warnings, and
    how to repeat the result. With --images it also shows the photographs. It is a single file, loads nothing
    from the network, and is readable in dark mode, on a phone and on paper.

    `neurocal calibrate --html` and `neurocal stereo --html` make the same page in the same run. Only they
    can name the command and the input files. The result file does not store them, so that it is the same
    wherever it is made.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal report camera.yaml -o report.html
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          | neurocal calibrate - -o board.yaml
      neurocal report board.yaml --images sample_data -o board.html
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          | neurocal report - -o rig.html
    """  # noqa: D301 - as in the group
    preparation.check((result,), (output,))
    import hashlib

    from neurocal_cli.files.camera_tree import parse_tree

    data, source = read_bytes(result)
    root = parse_tree(decode(data, source, "a calibration"), source)
    text = _page(root, {source: hashlib.sha256(data).hexdigest()}, images)
    if preparation.is_for_the_eye(output, "the page"):
        return
    write_whole(output, text)
    suggest(output, "open {} in a browser")


def _page(root: Field, files: dict[str, str], images: tuple[str, ...]) -> str:
    """The page about the result in the file."""
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.rig.rig import Rig, StereoRig
    from neurocal_cli.commands.show.html_page import Origin
    from neurocal_cli.commands.show.html_reports import Result, page_of
    from neurocal_cli.files.calibration_yaml import calibration_from_field
    from neurocal_cli.files.camera_tree import own_kind
    from neurocal_cli.files.lens_files import lens_from_field
    from neurocal_cli.files.rig_yaml import rig_from_field, stereo_from_field

    readers: dict[str, Callable[[Field], Result]]
    readers = {"lens": lens_from_field, "stereo": stereo_from_field, "rig": rig_from_field}
    result = readers.get(own_kind(root), calibration_from_field)(root)
    cameras, block = [result] if isinstance(result, Calibration) else [], root
    if isinstance(result, Rig):
        cameras = list(result.cameras.values())
        block = root["left"] if isinstance(result, StereoRig) else root["cameras"][result.first]
    if images and not cameras:
        raise UsageError("the page of a zoom lens shows no photographs; leave out --images")
    if len(images) not in (0, 1, len(cameras)):
        raise UsageError(f"the file is of {plural(len(cameras), 'camera')}; give --images once, or for each")
    words = images * (len(cameras) if len(images) == 1 else 1)
    shown = [_photographs(*one, len(cameras)) for one in zip(cameras, words, strict=False)]
    known = "neurocal" in block and "version" in block["neurocal"]
    versions = {"neurocal": block["neurocal"]["version"].text()} if known else {}
    return page_of(result, Origin(files, versions=versions), shown)


def _photographs(calibration: Calibration, word: str, cameras: int) -> dict[str, bytes]:
    """Thumbnails of the views' photographs, for the page."""
    from neurocal_cli.files.image_files import photographs_of
    from neurocal_cli.files.images import thumbnails

    views = calibration.points.view_names
    images = photographs_of(views, word)
    missing = [view for view in views if view not in images]
    if missing:
        note(f"no image of {len(missing)} views, such as {missing[0]}, in {word}")
    return thumbnails(images, calibration.image_size, _MOST_BYTES // cameras)

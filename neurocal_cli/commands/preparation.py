"""What commands do around their work: check inputs and outputs, read points and cameras, draw pictures."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from neurocal_cli.commands import boards, options
from neurocal_cli.commands.options import F
from neurocal_cli.commands.show.figure import check_available
from neurocal_cli.commands.streams import ProgressBar, is_terminal, note, say, warn, warned
from neurocal_cli.errors import FormatError, InputError, NeurocalError, UsageError
from neurocal_cli.files.writing import STDOUT_NAMES, check_places, held_back, write_whole

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.rig.rig import Rig
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.observations.points import Correspondences


_PICTURES = (".png", ".pdf", ".svg")

Plots = tuple[tuple[str | None, str], ...]  # panel, or None for all of them, and file


def check(
    inputs: Iterable[str | None],
    outputs: Iterable[str | None] = (),
    *,
    plots: Plots = (),
    as_json: bool = False,
) -> None:
    """Refuse what cannot be read, drawn or written, before any work is done."""
    inputs, outputs, pictures = tuple(inputs), tuple(outputs), [file for _, file in plots]
    check_one_stdin(*inputs)
    check_summary(as_json, *outputs)
    for picture in pictures:
        if not picture.lower().endswith(_PICTURES):
            endings = options.one_of(" ".join(_PICTURES))
            raise UsageError(f"--plot {picture}: not a picture file; give a name that ends in {endings}")
        check_available()
    check_outputs((*outputs, *pictures), inputs)


def check_outputs(outputs: Iterable[str | None], inputs: Iterable[str | None]) -> None:
    """Refuse outputs that cannot be written, or that are one of the inputs; see `check_places`."""
    held = held_back()
    if held is not None:
        held.protect(*inputs)
    check_places(*outputs)
    options.check_ending()


def is_for_the_eye(output: str, what: str = "the file") -> bool:
    """Whether a result that nobody asked for would go to a terminal, over its summary; say how to keep it."""
    if output != "-" or options.typed("output") or not is_terminal(sys.stdout):
        return False
    say(f"{what} is not kept; add `-o {options.usual_output()}` to keep it, or `-o -` to see it")
    return True


def check_folder(option: str, folder: str) -> None:
    """Refuse a folder that is standard output or a file, or cannot be made or written to."""
    if folder == "-":
        raise UsageError(f"{option} writes files, which cannot go to standard output; give a folder")
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise UsageError(f"{option} {folder} is a file; give a folder")
    parent = os.path.realpath(folder)
    while not os.path.exists(parent):
        parent = os.path.dirname(parent)
    if not (os.path.isdir(parent) and os.access(parent, os.W_OK)):
        raise NeurocalError(f"{option} {folder}: the folder cannot be made; give another place")


def check_one_stdin(*names: str | None) -> None:
    """Refuse a request to read standard input twice."""
    if names.count("-") > 1:
        raise UsageError("standard input (-) can be read only once; give the other inputs as files")


def check_summary(as_json: bool, *outputs: str | None) -> None:
    """Refuse a summary and a result on one stream, with a UsageError."""
    if as_json and not STDOUT_NAMES.isdisjoint(outputs):
        raise UsageError("--json prints to standard output, where the result would go too; give -o FILE")


def given_points(*names: str, board: str | None = "") -> Correspondences:
    """Read points, also those of other programs, and report rows that were left out.

    Corners without their places need a board, its file or a short form; "" is that of a command without one.
    """
    from neurocal_cli.files.points_csv import POINTS, TABLES, ids_at_two_places, read_points

    notes: list[str] = []
    points = None
    if board or not names[0].lower().endswith(TABLES):
        from neurocal_cli.files.exchange.corners import BOARD_ADVICE, read_corners

        advice = POINTS.instead.removeprefix("; ") if board == "" else BOARD_ADVICE
        described = boards.named_board(board) if board else None
        points = read_corners(names, described, notes, what="points", advice=advice)
    if points is None:
        points = read_points(names, notes=notes)
    note(*notes, *ids_at_two_places(points))
    return points


def known_camera(path: str, distortion: str | None = None) -> Camera | Calibration:
    """Read a known camera, and tell what its file leaves in doubt; see `read_given_camera`."""
    from neurocal_cli.files.exchange.reading import read_given_camera

    return warned(read_given_camera, path, distortion=distortion)


def given_camera(
    path: str, points: Correspondences, distortion: str | None = None
) -> tuple[Correspondences, Camera | Calibration]:
    """Read a known camera of the points' image size; give the points its image size if they have none.

    Of a neurocal file it is a Calibration without poses and points, but with its covariance. `distortion` is
    the model of the coefficients of a file that does not say it.
    """
    camera = known_camera(path, distortion)
    if camera.image_size is not None:
        if points.image_size is None:
            points = replace(points, image_size=camera.image_size)
        elif points.image_size != tuple(camera.image_size):
            raise InputError(
                f"{path}: the camera is for images of {camera.image_size[0]} x {camera.image_size[1]} px, "
                f"but {points.source} has {points.image_size[0]} x {points.image_size[1]} px; "
                f"{camera_of_size(points.image_size)}"
            )
    return points, camera


def camera_of_size(size: tuple[int, int]) -> str:
    """Advice on images of another size than those of a camera."""
    return (
        "give a camera for this image size or, if the images were resized, make it: neurocal resize "
        f"CAMERA.yaml --to {size[0]} {size[1]} -o RESIZED.yaml"
    )


def calibration_or_camera(
    name: str, points: Correspondences | None, besides: str = ""
) -> tuple[Calibration | Camera, Correspondences | None]:
    """Read a calibration or, for points, any camera; if it is neither, the error says why no calibration."""
    from neurocal_cli.camera.camera import camera_of
    from neurocal_cli.files.calibration_yaml import read_calibration

    try:
        return read_calibration(name), points
    except FormatError as error:
        if points is None:
            raise
        try:
            points, camera = given_camera(name, points)
        except FormatError:
            raise error from None
        note(f"only the intrinsic parameters and the distortion are used{besides}: {error.reason}")
    return camera_of(camera), points


def warn_of_poor(what: str, result: Calibration | Rig, so: str = "") -> None:
    """Warn of a result whose verdict is poor, with the first reason and what follows from it."""
    verdict = result.verdict
    if verdict is not None and verdict.word == "poor":
        warn(f"the {what} is poor: {'; '.join(verdict.reasons[:1])}{so}")


def plot_option(what: str, panels: Sequence[str] = ()) -> Callable[[F], F]:
    """Add ``--plot``, pictures of the result; if it has panels, of all on a page or of one of them.

    A command gets it as its keyword ``plots``, of the type `Plots`.
    """

    def parse(ctx: click.Context, param: click.Parameter, given: tuple[str, ...] | str | None) -> Plots:
        plots: list[tuple[str | None, str]] = []
        for word in (given,) if isinstance(given, str) else given or ():
            panel, equals, file = word.partition("=")
            if panels and equals and panel.isalpha() and panel not in panels:
                raise click.BadParameter(
                    f"there is no panel {panel!r}; choose from {', '.join(panels)}, or write ./{word} for a "
                    "file of this name"
                )
            plots.append((panel, file) if equals and panel in panels else (None, word))
        return tuple(plots)

    each = f": all panels on one page, or one of them: {', '.join(panels)}. It can be repeated"
    return click.option(
        "--plot",
        "plots",
        metavar="[PANEL=]FILE.png" if panels else "FILE.png",
        type=options.PATH,
        multiple=bool(panels),
        callback=parse,
        show_default="none",
        help=f"Plot {what} to this .png, .pdf or .svg file{each if panels else ''}.",
    )


def write_plots(plots: Plots, draw: Callable[..., bytes], *subject: Any) -> None:
    """Draw and write all pictures of a subject, each of the `kind` that its name ends in."""
    for panel, file in plots:
        only = {} if panel is None else {"panel": panel}
        with ProgressBar(f"drawing {file}"):
            write_whole(file, draw(*subject, kind=os.path.splitext(file)[1][1:].lower(), **only))

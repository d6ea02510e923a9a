"""``neurocal detect``: images in, points out."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands.options import INPUT, Argument, Command, FiniteNumber, output_option
from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import check_one_stdin, note, one_line, say, warn
from neurocal_cli.commands.threads import compute_in_one_thread
from neurocal_cli.errors import NeurocalError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from neurocal_cli.board import Board
    from neurocal_cli.detection.batch import Outcome

__all__ = ["detect"]

_VERTICES = click.IntRange(2, 1000)


@click.command(cls=Command)
@click.argument(
    "images",
    nargs=-1,
    required=True,
    metavar="IMAGE...",
    type=INPUT,
    cls=Argument,
    description="Images of one camera (PNG, JPEG, TIFF, BMP, PGM, PPM; of 8 or 16 bits), folders of them, "
    "or patterns; - is standard input.",
)
@click.option(
    "--board", metavar="BOARD.yaml", type=INPUT, show_default="none", help="Board of one plane or several."
)
@click.option("--cols", metavar="C", type=_VERTICES, show_default="none", help="Inner vertices in a row.")
@click.option("--rows", metavar="R", type=_VERTICES, show_default="none", help="Rows of inner vertices.")
@click.option(
    "--square", metavar="S", type=FiniteNumber(positive=True), show_default="none", help="Side of a square."
)
@click.option(
    "--unit",
    metavar="UNIT",
    show_default="mm",
    help="Unit of --square, for the file; a board file has its own.",
)
@click.option(
    "--points",
    type=click.Choice(["midpoints", "vertices"]),
    default="midpoints",
    help="Measure the mid-points of the squares' edges, or the inner vertices.",
)
@click.option(
    "--gamma",
    metavar="G",
    type=FiniteNumber(positive=True),
    show_default="unknown",
    help="Gamma of the images, 2.2 for many cameras; unknown, its effect is corrected a little less well.",
)
@click.option(
    "--overlay",
    metavar="DIR",
    type=click.Path(readable=False),
    show_default="none",
    help="Draw what was found over each image, as DIR/VIEW.png.",
)
@click.option(
    "--jobs",
    metavar="N",
    type=click.IntRange(min=1),
    show_default="the number of cores",
    help="Processes that share the images.",
)
@output_option("POINTS.csv", "the points")
def detect(
    images: tuple[str, ...],
    board: str | None,
    cols: int | None,
    rows: int | None,
    square: float | None,
    unit: str | None,
    points: str,
    gamma: float | None,
    overlay: str | None,
    jobs: int | None,
    output: str,
) -> None:
    """Find chessboards in images and measure the mid-points of their squares' edges.

    The board is named by the number of its inner vertices and the side of a square, or by a file
    that may hold several planes. Each image becomes a view, named after its file. Boards that are
    partly hidden or cut by the image's border are used where their visible ends tell which part
    is seen. Points have the same id in all images: vertex 0:0 is the corner, in dark inner square,
    where OpenCV's findChessboardCorners begins; if the number of columns and rows are both even or
    both odd, a board looks the same after a turn, and a warning says so.

    The points, CSV with the covariance of each and the direction across its edge (nu,nv), in which a
    mid-point is measured by itself, go to standard output or to -o. Images without the board are named
    on standard error with the reason.

    \b
    Examples:
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 -o points.csv
      neurocal detect left*.jpg --board corner.yaml --overlay seen | neurocal calibrate -
    """  # noqa: D301 - as in the group
    check_one_stdin(*images, board)
    compute_in_one_thread()
    target = _board(board, cols, rows, square, unit)
    outcomes = _examined(images, target, points, gamma, overlay, jobs)
    _report(outcomes)
    _write(outcomes, target, overlay, output)


def _board(
    path: str | None, cols: int | None, rows: int | None, square: float | None, unit: str | None
) -> Board:
    from neurocal_cli.board import Board

    numbers = (cols, rows, square)
    if path is not None:
        if numbers != (None, None, None) or unit is not None:
            raise UsageError(
                "--board tells the size and the unit; leave out --cols, --rows, --square and --unit"
            )
        from neurocal_cli.io.board_yaml import read_board

        return read_board(path)
    if cols is None or rows is None or square is None:
        raise UsageError(
            "the board is not described; give --cols, --rows and --square, or --board BOARD.yaml"
        )
    return Board.single(cols, rows, square, "mm" if unit is None else unit)


def _examined(
    words: tuple[str, ...],
    board: Board,
    points: str,
    gamma: float | None,
    overlay: str | None,
    jobs: int | None,
) -> list[tuple[str, Outcome]]:
    """Outcomes of all images, with the names of their views."""
    from neurocal_cli.detection.batch import DetectionOptions, default_jobs, detect_files
    from neurocal_cli.io.image_paths import find_images, view_names

    paths = find_images(words)
    names = view_names(paths)
    if overlay is not None:
        _check_overlay(overlay, paths)
    strict = os.environ.get("NEUROCAL_DEBUG", "0") not in ("", "0")
    wanted = DetectionOptions(
        board, "vertices" if points == "vertices" else "midpoints", gamma, overlay is not None, strict
    )
    outcomes = []
    with ProgressBar() as progress:
        for outcome in detect_files(paths, wanted, jobs or default_jobs(len(paths))):
            outcomes.append(outcome)
            progress(f"{len(outcomes)} of {len(paths)} images", len(outcomes) / len(paths))
    return list(zip(names, outcomes, strict=True))


def _check_overlay(folder: str, paths: Sequence[str]) -> None:
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise UsageError(f"--overlay {folder}: is a file; give a folder")
    if os.path.realpath(folder) in {os.path.dirname(os.path.realpath(path)) for path in paths if path != "-"}:
        raise UsageError(f"--overlay {folder}: holds the images themselves; give a folder of its own")


def _report(outcomes: Sequence[tuple[str, Outcome]]) -> None:
    """Say what is wrong with which image, and once what is to be known of several."""
    for _, outcome in outcomes:
        if outcome.problem:
            say(one_line(outcome.problem))
    remarks: dict[str, list[str]] = {}
    for name, outcome in outcomes:
        for text in outcome.notes:
            remarks.setdefault(text, []).append(name)
    note(f"{_some(names)}: {text}" for text, names in remarks.items())
    found = [outcome.detection for _, outcome in outcomes if outcome.detection is not None]
    warn(dict.fromkeys(text for detection in found for text in detection.warnings))
    if not found:
        what = (
            "the image does not show" if len(outcomes) == 1 else f"none of the {len(outcomes)} images shows"
        )
        raise NeurocalError(f"{what} the board; the reason stands above")
    say(
        f"found the board in {len(found)} of {len(outcomes)} images: "
        f"{sum(len(detection.ids) for detection in found)} points, "
        f"{sum(detection.rejected for detection in found)} rejected"
    )


def _some(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _write(outcomes: Sequence[tuple[str, Outcome]], board: Board, overlay: str | None, output: str) -> None:
    from neurocal_cli.detection.detect import gather
    from neurocal_cli.io.files import write_whole
    from neurocal_cli.io.points_csv import format_points

    found = {name: outcome.detection for name, outcome in outcomes if outcome.detection is not None}
    text = format_points(gather(found, board.unit))
    if overlay is not None:
        os.makedirs(overlay, exist_ok=True)
        for name, outcome in outcomes:
            if outcome.overlay is not None:
                write_whole(os.path.join(overlay, f"{name}.png"), outcome.overlay)
    write_whole(output, text)

"""``neurocal board`` and ``neurocal target``: a board to print, and the board that a calibration found."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import boards, options, preparation
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.streams import suggest, summarise, warn
from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.files.writing import write_whole

if TYPE_CHECKING:
    from neurocal_cli.observations.board import Board
    from neurocal_cli.observations.printed_sheet import Sheet

_ENDINGS = (".svg", ".pdf", ".png")


@click.command(cls=options.Command)
@boards.board("Unit of --square. A board file names its own unit.")
@click.option(
    "--paper",
    metavar="NAME|WxH",
    default="A4",
    help="Paper: A0 to A5, letter, legal, tabloid, or its width and height in mm, such as 420x297.",
)
@options.number(
    "--dpi", "N", "Resolution of a PNG in pixels per inch.", without="300", default=300, positive=True
)
@options.count(
    "--boards",
    "N",
    "Number of boards with markers for one rig, whose markers all differ: BOARD_1.pdf to BOARD_N.pdf.",
    without="1",
    default=1,
)
@options.output(
    "BOARD.pdf",
    "Write the target to this .pdf, .svg or .png file, and the board file beside it.",
    required=True,
)
@options.json
def board(
    board: boards.BoardOptions,
    paper: str,
    dpi: float,
    boards: int,
    output: str,
    as_json: bool,
) -> None:
    """Draw a target to print: chessboard, ChArUco, tags or circles.

    Without --cols and --rows, the board has 9 x 6 inner vertices. One of these numbers is odd and one is
    even, so the board looks different after a turn of 180 degrees. Without --square it has the largest
    squares, in whole mm, that fit on the paper. A board of several planes that meet in a corner, from a board
    file, is unfolded; dashes show where to fold it.

    Squares have their exact size. Print at 100 %, without fitting to the page, and measure the two rulers:
    if 100 mm on them are not 100 mm, correct `square` in the board file.

    The board file is written beside the target, with the ending .yaml, unless the board came from one. Give
    it to neurocal detect --board. Several boards of a rig have a file each.

    \b
    Examples:
      neurocal board -o target.pdf
      neurocal board --cols 7 --rows 4 -o few.pdf
      neurocal board --cols 11 --rows 8 --square 28 --paper A3 -o large.svg
      neurocal board --cols 8 --rows 5 --square 1 --unit inch --paper letter \\
          --dpi 150 -o letter.png
      neurocal board --board target.yaml --json -o again.pdf
      neurocal board --board charuco:8x6:28:21 -o charuco.pdf
      neurocal board --board charuco:6x5:30:22 --boards 3 -o rig.pdf
      neurocal board --board aprilgrid:6x6:20:0.3 -o tags.svg
      neurocal board --board arucogrid:5x7:20:0.25:DICT_6X6_50 -o aruco.svg
      neurocal board --board asymmetric_circles:4x11:20 --paper A3 -o circles.pdf
    """  # noqa: D301 - as in the group
    ending = os.path.splitext(output)[1].lower()
    if ending not in _ENDINGS:
        raise UsageError(f"-o {output}: give a name that ends in {options.one_of(' '.join(_ENDINGS))}")
    if ending != ".png":
        options.note_unused(f"on a {ending} file, which has no pixels", "dpi")
    stem, outputs = os.path.splitext(output)[0], [output]
    if boards > 1:
        outputs = [f"{stem}_{k}{ending}" for k in range(1, boards + 1)]
    beside = [
        None if board.is_file and boards == 1 else f"{os.path.splitext(one)[0]}.yaml" for one in outputs
    ]
    preparation.check((board.file,), (*outputs, *beside))
    from neurocal_cli.files.board_pictures import board_pdf, board_png, board_svg
    from neurocal_cli.files.board_yaml import write_board
    from neurocal_cli.observations.marked_cells import numbered_apart, to_print
    from neurocal_cli.observations.printed_sheet import default_board, on_paper, paper_size

    made: dict[str, Callable[[Sheet], str | bytes]] = {".svg": board_svg, ".pdf": board_pdf}
    draw = made.get(ending, partial(board_png, dpi=dpi))
    size = paper_size(paper)
    sized = (board.file, board.square, board.unit) != (None,) * 3
    target = (board.read() if sized else None) or default_board(size, *board.counts)
    if boards > 1 and any(plane.markers is None for plane in target.planes):
        raise UsageError("--boards is for boards with markers, whose numbers tell them apart")
    several = (target,) if boards == 1 else numbered_apart(target, boards)
    targets = [replace(one, planes=tuple(map(to_print, one.planes))) for one in several]
    sheets = [on_paper(one, size) for one in targets]
    for one, sheet, path, file in zip(targets, sheets, outputs, beside, strict=True):
        write_whole(path, draw(sheet))
        if file is not None:
            write_board(one, file)
        _report(one, sheet, file, as_json)
    if boards == 1:
        suggest(beside[0], "neurocal detect IMAGE... --board {} -o points.csv")


@click.command(cls=options.Command)
@options.argument(
    "camera", "CAMERA.yaml", "A calibration that `neurocal calibrate` wrote; - is standard input."
)
@options.path(
    "--board",
    "BOARD.yaml",
    "The board that was detected, in a file or in short as for detect, if the points do not tell it, as "
    "those of other programs.",
    to="file",
)
@plot_option("the heights of the board's points and their shifts")
@options.summary
@options.output("BOARD.yaml", "Write the board to this file.")
def target(camera: str, file: str | None, plots: Plots, as_json: bool, output: str) -> None:
    """Write the board with its estimated shape.

    No board is exactly as its file says: paper curls, and printers stretch. `neurocal calibrate --target
    auto` estimates the true positions of the board's points together with the camera. This command writes
    them as a board file. With that file, `neurocal detect --board` assigns the measured positions to the
    points of other images of the same board, so that later calibrations and other cameras benefit.

    Images do not determine the overall size of a board. It stays as given.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/bent.csv -o camera.yaml
      neurocal target camera.yaml -o board.yaml --plot board.png --json
      neurocal calibrate sample_data/bent.csv | neurocal target - -o board.yaml
      neurocal target camera.yaml --board chessboard:9x6:25 -o again.yaml
    """  # noqa: D301 - as in the group
    preparation.check((camera, file), (output,), plots=plots, as_json=as_json)
    from neurocal_cli.commands.show.camera_panels import draw_target
    from neurocal_cli.commands.show.camera_report import target_json, target_lines
    from neurocal_cli.files.board_yaml import parse_board, write_board
    from neurocal_cli.files.calibration_yaml import read_calibration
    from neurocal_cli.observations.estimated_board import with_found_points
    from neurocal_cli.observations.target import board_of

    calibration = read_calibration(camera)
    if calibration.target is None:
        raise InputError(
            f"{camera}: the target was taken as it was given, so its own file still holds; if it may have "
            "another shape, calibrate with --target free"
        )
    write_plots(plots, draw_target, calibration.target, calibration.unit)
    known = calibration.target, calibration.unit, calibration.points.distances
    described = None if file is None else boards.named_board(file, calibration.unit)
    if described is None and calibration.points.board:
        described = parse_board(calibration.points.board, f"{camera}: observations.board")
    board = board_of(*known) if described is None else with_found_points(described, *known)
    if not preparation.is_for_the_eye(output):
        write_board(board, output)
    suggest(output, "neurocal detect IMAGE... --board {} -o points.csv")
    found = calibration.target, calibration.unit
    summarise(as_json, target_json(*found) or {}, *target_lines(*found))


def _report(target: Board, sheet: Sheet, beside: str | None, as_json: bool) -> None:
    """Warn of a board that is hard to detect, and describe what was written."""
    from neurocal_cli.files.board_kinds import kind_of
    from neurocal_cli.observations.board_kinds import described

    cols, rows = target.planes[0].cols, target.planes[0].rows
    plain = all(kind_of(plane) == "chessboard" for plane in target.planes)
    if plain and len(target.planes) == 1 and (cols - rows) % 2 == 0:
        warn(
            f"a board of {cols} x {rows} inner vertices looks the same after a turn of 180 degrees; "
            f"{cols} x {rows - 1 if rows > 3 else rows + 1} would not"
        )
    if plain and any(min(plane.cols, plane.rows) < 3 for plane in target.planes):
        warn("neurocal detect needs at least 3 x 3 inner vertices")
    keys, paper = ("name", "cols", "rows", "square"), [sheet.width, sheet.height]
    planes = [
        {"kind": kind_of(plane), **{key: getattr(plane, key) for key in keys}} for plane in target.planes
    ]
    lines = [
        f"{f'{plane.name}: ' if plane.name else ''}{described(plane, target.unit)}" for plane in target.planes
    ]
    lines.append(f"paper {sheet.width:g} x {sheet.height:g} mm; print at 100 % and measure the rulers")
    summary = {"unit": target.unit, "planes": planes, "paper_mm": paper, "board_file": beside}
    summarise(as_json, summary, *lines, *([] if beside is None else [f"board file: {beside}"]))

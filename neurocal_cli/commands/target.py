"""``neurocal target``: write the board with its estimated shape."""

from __future__ import annotations

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.pages import plot_option, write_plot
from neurocal_cli.commands.streams import print_summary, say, suggest
from neurocal_cli.errors import InputError


@click.command(cls=options.Command)
@options.argument(
    "camera", "CAMERA.yaml", "A calibration that `neurocal calibrate` wrote; - is standard input."
)
@options.path(
    "--board",
    "BOARD.yaml",
    "The board that was detected, in a file or in short as for detect, if the points do not tell it, as "
    "those "
    "of other programs.",
    to="file",
)
@plot_option("the heights of the board's points and their shifts")
@options.summary
@options.output("BOARD.yaml", "Write the board to this file.")
def target(camera: str, file: str | None, plot: str | None, as_json: bool, output: str) -> None:
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
    preparation.check((camera, file), (output,), plots=(plot,), as_json=as_json)
    from neurocal_cli.commands.show.camera_panels import draw_target
    from neurocal_cli.commands.show.camera_report import target_json, target_lines
    from neurocal_cli.files.board_yaml import read_board, write_board
    from neurocal_cli.files.calibration_yaml import read_calibration
    from neurocal_cli.observations.target import board_of

    calibration = read_calibration(camera)
    if calibration.target is None:
        raise InputError(
            f"{camera}: the target was taken as it was given, so its own file still holds; if it may have "
            "another shape, calibrate with --target free"
        )
    write_plot(plot, draw_target, calibration.target, calibration.unit)
    known = calibration.target, calibration.unit, calibration.points.distances
    described = None
    if file is not None:
        from neurocal_cli.files.board_kinds import short_board

        described = short_board(file, calibration.unit) or read_board(file)
    elif calibration.points.board:
        from neurocal_cli.files.board_yaml import parse_board

        described = parse_board(calibration.points.board, f"{camera}: observations.board")
    if described is None:
        board = board_of(*known)
    else:
        from neurocal_cli.observations.estimated_board import with_found_points

        board = with_found_points(described, *known)
    if not preparation.is_for_the_eye(output, "board.yaml"):
        write_board(board, output)
    suggest(output, "neurocal detect IMAGE... --board {} -o points.csv")
    if as_json:
        print_summary(target_json(calibration.target, calibration.unit) or {})
    else:
        say("\n".join(target_lines(calibration.target, calibration.unit)))

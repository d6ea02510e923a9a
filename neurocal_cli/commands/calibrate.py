"""``neurocal calibrate``: points in, a camera out."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands.calibration_options import Estimation, estimation_options
from neurocal_cli.commands.options import Command, check_plot, output_option, plot_option, points_argument
from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import check_one_stdin, note, say, warn
from neurocal_cli.errors import UsageError

if TYPE_CHECKING:
    from neurocal_cli.calibration import Calibration

__all__ = ["calibrate"]

_NOT_CONVERGED = 3


@click.command(cls=Command)
@points_argument
@estimation_options
@click.option(
    "--camera-name", metavar="NAME", default="camera", help="Name of the camera, written to the file."
)
@plot_option
@output_option("CAMERA.yaml", "the calibration")
@click.pass_context
def calibrate(
    ctx: click.Context,
    points: tuple[str, ...],
    estimation: Estimation,
    camera_name: str,
    plot: str | None,
    output: str,
) -> None:
    """Calibrate a camera from known points and the pixels where they were seen.

    A pinhole camera has 5 intrinsic parameters (the scale factors alpha_u and alpha_v, the image
    centre u0, v0 and the angle theta between the image axes) and, for each view, 6 extrinsic ones
    (three angles and a translation: where the camera stood). A network that starts from random
    weights learns them; --type says what is known beforehand:

    \b
      1  nothing: learn all the parameters
      2  the image centre, from --image-center: learn all the others
      3  the intrinsic parameters, from --intrinsics: learn where the camera stood
      4  the poses, from --extrinsics: learn the intrinsic parameters

    Points of a single view must not all lie in one plane for types 1 and 2; several views of a flat
    board will do.

    The calibration, a YAML file that ROS reads as camera_info, goes to standard output or to -o.
    A summary with standard deviations and a verdict (good, usable or poor, with the reasons and what
    to do next) goes to standard error.

    \b
    Examples:
      neurocal calibrate sample_data/points.csv -o camera.yaml
      neurocal calibrate sample_data/points.csv --type 2
      neurocal calibrate moved.csv --type 3 --intrinsics camera.yaml -o moved.yaml
      cat points.csv | neurocal calibrate - | neurocal evaluate camera -
    """  # noqa: D301 - as in the group
    estimation.check()
    check_one_stdin(*points, *estimation.stdin_candidates)
    _check_outputs(output, plot, camera_name)
    calibration = _estimate(points, estimation, camera_name)
    _write(calibration, output, plot)
    _report(calibration)
    if not calibration.converged:
        ctx.exit(_NOT_CONVERGED)


def _check_outputs(output: str, plot: str | None, camera_name: str) -> None:
    if not camera_name.strip() or not camera_name.isprintable():
        raise UsageError("--camera-name must be a name of printable characters")
    check_plot(plot, output)


def _estimate(names: tuple[str, ...], estimation: Estimation, camera_name: str) -> Calibration:
    from neurocal_cli.io.points_csv import read_points

    notes: list[str] = []
    points = read_points(names, notes=notes)
    note(notes)
    points, arguments = estimation.prepare(points)

    from neurocal_cli.methods import calibrate as learn

    with ProgressBar() as progress:
        return learn(points, **arguments, camera_name=camera_name, progress=progress)


def _write(calibration: Calibration, output: str, plot: str | None) -> None:
    """Write both files, the picture drawn before either is touched."""
    from neurocal_cli.io.calibration_yaml import write_calibration

    if plot is not None:
        from neurocal_cli.io.files import write_whole
        from neurocal_cli.plots import draw_calibration

        write_whole(plot, draw_calibration(calibration, os.path.splitext(plot)[1][1:].lower()))
    write_calibration(calibration, output)


def _report(calibration: Calibration) -> None:
    from neurocal_cli.report import calibration_report

    say(calibration_report(calibration))
    warn(calibration.warnings)

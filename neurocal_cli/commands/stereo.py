"""``neurocal stereo``: points of two cameras in, a rig out."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands.calibration_options import Estimation, estimation_options_without_files
from neurocal_cli.commands.options import INPUT, Argument, Command, check_plot, output_option, plot_option
from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import check_one_stdin, note, say, warn
from neurocal_cli.errors import UsageError

if TYPE_CHECKING:
    from neurocal_cli.points import Correspondences
    from neurocal_cli.stereo.rig import Rig

__all__ = ["stereo"]

_NOT_CONVERGED = 3


@click.command(cls=Command)
@click.argument(
    "left",
    metavar="LEFT.csv",
    type=INPUT,
    cls=Argument,
    description="Points of the left camera; - is standard input.",
)
@click.argument(
    "right", metavar="RIGHT.csv", type=INPUT, cls=Argument, description="Points of the right camera."
)
@estimation_options_without_files
@click.option(
    "--left-intrinsics",
    type=INPUT,
    metavar="CAMERA.yaml",
    show_default="none",
    help="The left camera, if it is known: a neurocal, ROS or OpenCV file (type 3 for it alone).",
)
@click.option(
    "--right-intrinsics",
    type=INPUT,
    metavar="CAMERA.yaml",
    show_default="none",
    help="The right camera, if it is known.",
)
@click.option(
    "--alpha",
    type=click.FloatRange(0, 1),
    metavar="A",
    show_default="not scaled",
    help="Scale the rectified images so that all their pixels have been seen (0) or all that was seen is in "
    "them (1).",
)
@click.option(
    "--ros",
    nargs=2,
    metavar="LEFT.yaml RIGHT.yaml",
    type=click.Path(writable=False, readable=False),
    show_default="none",
    help="Also write two files that ROS's stereo nodes read, in metres.",
)
@plot_option
@output_option("RIG.yaml", "the rig")
@click.pass_context
def stereo(
    ctx: click.Context,
    left: str,
    right: str,
    estimation: Estimation,
    left_intrinsics: str | None,
    right_intrinsics: str | None,
    alpha: float | None,
    ros: tuple[str, str] | None,
    plot: str | None,
    output: str,
) -> None:
    """Calibrate two cameras and how the right one stands to the left, X_right = R X_left + t.

    Each camera's network learns from random weights as in `neurocal calibrate`, whose options hold for both.
    The views that both cameras saw then agree on one rig, and both cameras, the rig and all poses are refined
    together. Views of one camera alone help that camera.

    Views pair by name: equal names, else names equal without left, l, cam0 and right, r, cam1 (left01 and
    right01). Points pair by their ids, else by X, Y, Z. Pairs of views that contradict the others are named:
    a board turned in one image, images exchanged, or not taken at the same moment.

    The rig, a YAML file with both calibrations, R, t, E, F, the baseline and the rectification as OpenCV
    defines it, goes to standard output or to -o; a summary with standard deviations to standard error.

    \b
    Examples:
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv -o rig.yaml
      neurocal stereo left.csv right.csv --no-skew --left-intrinsics left.yaml
      neurocal stereo left.csv right.csv | neurocal evaluate stereo -
    """  # noqa: D301 - as in the group
    sides = _side(estimation, left_intrinsics), _side(estimation, right_intrinsics)
    # Each camera is checked for its own type; here type 3 is what both files of known cameras make it.
    (replace(estimation, type="1") if estimation.type == "3" else estimation).check()
    check_one_stdin(left, right, left_intrinsics, right_intrinsics)
    check_plot(plot, output)
    _check_outputs(output, ros)
    rig = _estimate((left, right), sides, estimation)
    _write(rig, output, alpha, ros, plot)
    _report(rig)
    if not rig.converged:
        ctx.exit(_NOT_CONVERGED)


def _side(estimation: Estimation, intrinsics: str | None) -> Estimation:
    """What is asked for one camera."""
    if estimation.type == "4":
        raise UsageError(
            "--type 4 knows the poses of all views, so there is no rig to find; calibrate each camera by "
            "itself"
        )
    if intrinsics is None:
        if estimation.type == "3":
            raise UsageError(
                "--type 3 needs both cameras; give --left-intrinsics and --right-intrinsics, or leave out "
                "--type"
            )
        return estimation
    return replace(
        estimation,
        type="3",
        intrinsics=intrinsics,
        image_center=None,
        no_skew=False,
        distortion="none",
    )


def _check_outputs(output: str, ros: tuple[str, str] | None) -> None:
    names = [os.path.realpath(name) for name in (output, *(ros or ())) if name != "-"]
    if len(set(names)) < len(names):
        raise UsageError("-o and --ros name the same file twice; give each its own")


def _estimate(names: tuple[str, str], sides: tuple[Estimation, Estimation], estimation: Estimation) -> Rig:
    from neurocal_cli.io.points_csv import read_points

    points: list[Correspondences] = []
    arguments = []
    for name, side in zip(names, sides, strict=True):
        notes: list[str] = []
        one, given = side.prepare(read_points(name, notes=notes))
        note(notes)
        points.append(one)
        arguments.append(given)

    from neurocal_cli.stereo.calibrate_stereo import calibrate_stereo

    with ProgressBar() as progress:
        return calibrate_stereo(
            points[0],
            points[1],
            arguments[0],
            arguments[1],
            outliers=estimation.outliers,
            progress=progress,
        )


def _write(rig: Rig, output: str, alpha: float | None, ros: tuple[str, str] | None, plot: str | None) -> None:
    """Write all files, the picture drawn before any is touched."""
    from neurocal_cli.io.files import write_whole
    from neurocal_cli.io.rig_yaml import format_ros_pair, write_rig

    if plot is not None:
        from neurocal_cli.plots import draw_rig

        write_whole(plot, draw_rig(rig, os.path.splitext(plot)[1][1:].lower()))
    if ros is not None:
        for name, text in zip(ros, format_ros_pair(rig, alpha), strict=True):
            write_whole(name, text)
    write_rig(rig, output, alpha)


def _report(rig: Rig) -> None:
    from neurocal_cli.stereo.report import rig_report, views_alone

    note(views_alone(rig.alone))
    say(rig_report(rig))
    warn(rig.warnings)

"""``neurocal evaluate stereo``: two cameras judged by triangulation."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands.calibration_options import given_camera
from neurocal_cli.commands.options import INPUT, Argument, Command, json_option
from neurocal_cli.commands.streams import check_one_stdin, note, warn
from neurocal_cli.commands.tables import show
from neurocal_cli.errors import FormatError, UsageError

if TYPE_CHECKING:
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.points import Correspondences
    from neurocal_cli.stereo.evaluation import StereoEvaluation

__all__ = ["stereo"]


@click.command(cls=Command)
@click.argument(
    "cameras",
    metavar="LEFT.yaml RIGHT.yaml",
    nargs=-1,
    required=True,
    type=INPUT,
    cls=Argument,
    description="The calibrations of the left and the right camera, with --points also ROS or OpenCV ones; "
    "or one RIG.yaml with both; - is standard input.",
)
@click.option(
    "--points",
    nargs=2,
    metavar="LEFT.csv RIGHT.csv",
    type=INPUT,
    show_default="those that the cameras were calibrated from",
    help="Points of both cameras to judge them by.",
)
@click.option(
    "--method",
    type=click.Choice(["optimal", "linear", "midpoint"]),
    default="optimal",
    help="How to triangulate: least squares on the pixels, linear equations, or the middle between the rays.",
)
@json_option
def stereo(cameras: tuple[str, ...], points: tuple[str, str] | None, method: str, as_json: bool) -> None:
    """Measure how well two calibrated cameras tell where points are in space.

    Every point that both cameras saw is triangulated and compared with where it truly is: on the target,
    put into the left camera's frame (x right, y down, z depth) by the view's pose. All errors are in that
    frame and in the target's unit; NSCE is the normalised error of Weng, Cohen and Herniou, 1 being the
    rounding of a pixel; the epipolar error is the smallest shift of both pixels that makes their rays meet.

    Points are triangulated twice: with the two poses of each view, and through one rig that is fitted to all
    views, which is how other points will be. Views pair by name: equal names, else names equal without
    left, l, cam0 and right, r, cam1 (left01 and right01). Points pair by their ids, else by X, Y, Z.

    Without --points, the cameras are judged by the points they were calibrated from, which flatters them;
    the poses of views that the calibrations do not know are fitted.

    \b
    Examples:
      neurocal evaluate stereo left.yaml right.yaml
      neurocal evaluate stereo left.yaml right.yaml --points more_left.csv more_right.csv --json
      neurocal evaluate stereo rig.yaml
    """  # noqa: D301 - as in the group
    if len(cameras) > 2:
        raise UsageError(f"evaluate stereo takes two calibrations or one rig, not {len(cameras)} files")
    check_one_stdin(*cameras, *(points or ()))
    evaluation = _evaluate(cameras, _read_points(points), method)
    from neurocal_cli.stereo.report import views_alone

    note(views_alone(evaluation.alone))
    if evaluation.fitted:
        names = ", ".join(evaluation.fitted[:5]) + (", ..." if len(evaluation.fitted) > 5 else "")
        note([f"{names}: not in the calibrations, so the poses are fitted with the cameras fixed"])
    warn(evaluation.warnings)
    _show(evaluation, as_json)


def _read_points(names: tuple[str, str] | None) -> tuple[Correspondences, Correspondences] | None:
    if names is None:
        return None
    from neurocal_cli.io.points_csv import read_points

    notes: list[str] = []
    left, right = (read_points([name], notes=notes) for name in names)
    note(notes)
    return left, right


def _evaluate(
    cameras: tuple[str, ...], points: tuple[Correspondences, Correspondences] | None, method: str
) -> StereoEvaluation:
    from neurocal_cli.stereo.evaluation import evaluate_rig, evaluate_stereo

    if len(cameras) == 1:
        from neurocal_cli.io.rig_yaml import read_rig

        return evaluate_rig(read_rig(cameras[0]), points, method=method)
    from neurocal_cli.io.calibration_yaml import read_calibration

    if points is None:
        left, right = (read_calibration(name) for name in cameras)
    else:
        left, right = (_camera(name, seen) for name, seen in zip(cameras, points, strict=True))
    return evaluate_stereo(left, right, points, method=method)


def _camera(name: str, points: Correspondences) -> Calibration:
    """Read a calibration, or any camera file: then its poses are fitted to the points."""
    from neurocal_cli.io.calibration_yaml import read_calibration
    from neurocal_cli.methods import calibrate

    try:
        return read_calibration(name)
    except FormatError as error:
        if name == "-":
            raise
        try:
            points, camera = given_camera(name, points)
        except FormatError:
            raise error from None  # no camera file of any kind: tell why it is no calibration
        note([f"only the intrinsic parameters and the lens are used, and the poses fitted: {error}"])
    return calibrate(points, type=3, intrinsics=camera, outliers="keep")


def _show(evaluation: StereoEvaluation, as_json: bool) -> None:
    from neurocal_cli.stereo.report import (
        stereo_evaluation_json,
        stereo_evaluation_report,
        stereo_evaluation_tables,
    )

    if as_json:
        click.echo(json.dumps(stereo_evaluation_json(evaluation), indent=2, allow_nan=False))
    else:
        show(stereo_evaluation_report(evaluation), stereo_evaluation_tables(evaluation))

"""``neurocal evaluate stereo``: two cameras judged by triangulation."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options
from neurocal_cli.commands.before import check_one_stdin, check_outputs
from neurocal_cli.commands.given_camera import calibration_or_camera
from neurocal_cli.commands.pages import Plots, check_plots, plot_option, write_plots
from neurocal_cli.commands.streams import note, print_summary, show, warn
from neurocal_cli.errors import UsageError
from neurocal_cli.plots import SPACE_PANELS

if TYPE_CHECKING:
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.points import Correspondences
    from neurocal_cli.stereo.evaluation import StereoEvaluation
    from neurocal_cli.stereo.rig import Rig


@click.command(cls=options.Command)
@options.argument(
    "cameras",
    "LEFT.yaml RIGHT.yaml",
    "The calibrations of the left and the right camera, with --points also ROS or OpenCV files; "
    "or one RIG.yaml with both; - is standard input.",
    nargs=-1,
    required=True,
)
@options.path(
    "--points",
    "LEFT.csv RIGHT.csv",
    "Points of both cameras to evaluate them on.",
    without="the points of the calibrations",
)
@options.choice(
    "--method",
    "optimal linear midpoint",
    "Triangulation: optimal is least squares on the pixels, linear solves linear equations, midpoint "
    "takes the middle between the two rays.",
    default="optimal",
)
@plot_option("the errors in space, by depth and by view, and of a rig the poses", SPACE_PANELS)
@options.json
def stereo(
    cameras: tuple[str, ...],
    points: tuple[str, str] | None,
    method: str,
    plots: Plots,
    as_json: bool,
) -> None:
    """Measure the triangulation error of two calibrated cameras.

    Every point that both cameras saw is triangulated and compared with its true position on the target.
    The errors are in the frame of the left camera (X right, Y down, Z depth) and in the unit of the target.
    NSCE is the normalised stereo calibration error of Weng, Cohen and Herniou; a value of 1 corresponds to
    rounding to whole pixels. The epipolar error is the smallest shift of both pixels that makes their rays
    meet.

    Each point is triangulated twice: with the two poses of its view, and with one rig that is fitted to all
    views. The error of the rig is what to expect for new points.

    Two views are a pair if their names are equal, or equal without left, l, cam0 and right, r, cam1 (such
    as left01 and right01). Points are paired by their ids, else by X, Y, Z.

    Without --points the points of the calibrations themselves are used, and the errors are too optimistic.
    With --points the poses of views that are not in the calibrations are fitted.

    The rig also gets a verdict, as in neurocal stereo. It uses the points of the calibrations.

    \b
    Examples:
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal evaluate stereo rig.yaml --plot space.png --plot depth=depth.svg
      neurocal calibrate sample_data/stereo_left.csv -o left.yaml
      neurocal calibrate sample_data/stereo_right.csv -o right.yaml
      neurocal evaluate stereo left.yaml right.yaml --method linear --json
      neurocal evaluate stereo left.yaml right.yaml \\
          --points sample_data/stereo_left.csv sample_data/stereo_right.csv
    """  # noqa: D301 - as in the group
    if len(cameras) > 2:
        raise UsageError(f"there are {len(cameras)} files; give two calibrations, or one rig")
    check_one_stdin(*cameras, *(points or ()))
    check_plots(plots)
    check_outputs((file for _, file in plots), (*cameras, *(points or ())))
    evaluation, rig = _evaluate(cameras, _read_points(points), method)
    if plots:
        from neurocal_cli.plots.pages import draw_points_in_space

        write_plots(plots, partial(draw_points_in_space, evaluation, rig))
    from neurocal_cli.stereo.report import stereo_evaluation_json, stereo_evaluation_tables, views_alone
    from neurocal_cli.verdict.report import verdict_lines

    note(views_alone(evaluation.alone))
    if evaluation.fitted:
        names = ", ".join(evaluation.fitted[:5]) + (", ..." if len(evaluation.fitted) > 5 else "")
        note([f"{names}: not in the calibrations; the poses are fitted with the cameras fixed"])
    warn(evaluation.warnings)
    if as_json:
        print_summary(stereo_evaluation_json(evaluation))
    else:
        verdict = evaluation.verdict
        show(stereo_evaluation_tables(evaluation), [] if verdict is None else verdict_lines(verdict))


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
) -> tuple[StereoEvaluation, Rig | None]:
    from neurocal_cli.stereo.evaluation import evaluate_rig, evaluate_stereo

    if len(cameras) == 1:
        from neurocal_cli.io.rig_yaml import read_rig

        rig = read_rig(cameras[0])
        return evaluate_rig(rig, points, method=method), rig
    from neurocal_cli.io.calibration_yaml import read_calibration

    if points is None:
        left, right = (read_calibration(name) for name in cameras)
    else:
        left, right = (_camera(name, seen) for name, seen in zip(cameras, points, strict=True))
    return evaluate_stereo(left, right, points, method=method), None


def _camera(name: str, points: Correspondences) -> Calibration:
    """Read a calibration, or any camera file; poses that the file does not hold are fitted to the points."""
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.methods import calibrate

    camera, seen = calibration_or_camera(name, points, "; the poses are fitted")
    if isinstance(camera, Calibration):
        if camera.views:
            return camera
        note([f"{name}: holds no poses; they are fitted"])
    assert seen is not None
    return calibrate(seen, type=3, intrinsics=camera, outliers="keep")

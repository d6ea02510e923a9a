"""``neurocal evaluate``: how good a result is."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options
from neurocal_cli.commands.before import check_one_stdin, check_outputs
from neurocal_cli.commands.evaluate_stereo import stereo
from neurocal_cli.commands.given_camera import calibration_or_camera, given_points
from neurocal_cli.commands.pages import Plots, check_plots, plot_option, write_plots
from neurocal_cli.commands.streams import note, print_summary, show, warn
from neurocal_cli.plots import CAMERA_PANELS

if TYPE_CHECKING:
    from neurocal_cli.calibration import Calibration, Verdict
    from neurocal_cli.camera.camera import Camera
    from neurocal_cli.evaluation import CameraEvaluation
    from neurocal_cli.points import Correspondences


@click.group()
def evaluate() -> None:
    """Measure the error of a calibrated camera or stereo rig.

    \b
    Examples:
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal evaluate camera camera.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal evaluate stereo rig.yaml
    """  # noqa: D301 - as in the group


evaluate.add_command(stereo)


@evaluate.command(cls=options.Command)
@options.argument(
    "calibration",
    "CAMERA.yaml",
    "A calibration that neurocal wrote. With POINTS.csv also a ROS or OpenCV file; - is standard input.",
)
@options.argument(
    "points",
    "[POINTS.csv]",
    "Points to evaluate the camera on; without them, those it was calibrated from.",
    required=False,
)
@plot_option("the errors, and of a calibration the coverage, uncertainty and poses", CAMERA_PANELS)
@options.json
def camera(calibration: str, points: str | None, plots: Plots, as_json: bool) -> None:
    """Measure the reprojection error of a calibrated camera, in pixels.

    The residuals of a point are du and dv, its projected pixel minus its observed pixel. The rms error
    is sqrt(mean(du^2 + dv^2)); the bias is the mean of du and of dv.

    Without POINTS.csv the points of the calibration itself are used, and the error is too optimistic.
    With POINTS.csv a view of the calibration keeps its calibrated pose if that pose fits most of its points.
    The pose of any other view is fitted first, with the intrinsic parameters fixed, and the view is
    marked `fitted`; so is another image that only has the name of a calibrated view. Points behind the
    camera are counted, but all averages leave them out.

    A calibration also gets a verdict. It uses the points of the calibration: the cross-validation error,
    the noise floor, the agreement of two halves of the data, the coverage of the image and the uncertainty
    of predicted pixels. With POINTS.csv it also includes the error on these points.

    \b
    Examples:
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal evaluate camera camera.yaml
      neurocal evaluate camera camera.yaml sample_data/stereo_left.csv --json
      neurocal evaluate camera camera.yaml --plot errors.png \\
          --plot uncertainty=trust.pdf
      cat sample_data/flat.csv | neurocal calibrate - | neurocal evaluate camera -
    """  # noqa: D301 - as in the group
    check_one_stdin(calibration, points)
    check_plots(plots)
    check_outputs((file for _, file in plots), (calibration, points))
    given = None if points is None else given_points([points])
    evaluation, verdict, judged = _evaluate(calibration, given)
    if plots:
        from neurocal_cli.plots.camera_panels import Subject
        from neurocal_cli.plots.pages import draw_camera

        write_plots(plots, partial(draw_camera, Subject.of(judged, given, evaluation)))
    _tell(evaluation)
    from neurocal_cli.report import evaluation_json, evaluation_tables
    from neurocal_cli.verdict.report import verdict_lines

    if as_json:
        print_summary(evaluation_json(evaluation, verdict))
    else:
        show(evaluation_tables(evaluation), [] if verdict is None else verdict_lines(verdict))


def _evaluate(
    name: str, points: Correspondences | None
) -> tuple[CameraEvaluation, Verdict | None, Calibration | Camera]:
    """Evaluate a calibration or, if points are given, any camera file, with all poses fitted."""
    from neurocal_cli.calibration import Calibration
    from neurocal_cli.evaluation import evaluate_camera
    from neurocal_cli.verdict.assessment import assess
    from neurocal_cli.verdict.given_points import judged_by_points

    camera, points = calibration_or_camera(name, points)
    evaluation = evaluate_camera(camera, points)
    if not isinstance(camera, Calibration):
        return evaluation, None, camera
    verdict = assess(camera)
    if verdict is not None and points is not None:
        verdict = judged_by_points(verdict, camera, evaluation.given_points)
    return evaluation, verdict, camera


def _tell(evaluation: CameraEvaluation) -> None:
    renamed = evaluation.renamed
    new = tuple(name for name in evaluation.fitted_views if name not in renamed)
    for names, why in (
        (new, "not in the calibration"),
        (renamed, "other points than the calibration has under this name"),
    ):
        if names:
            some = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
            note([f"{some}: {why}; the pose is fitted with the intrinsic parameters fixed"])
    if evaluation.on_target:
        note(["the points are taken where the calibration found them, not where their file has them"])
    warn(evaluation.warnings)

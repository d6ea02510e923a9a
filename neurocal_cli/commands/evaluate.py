"""``neurocal evaluate``: the error of a camera by reprojection, and of two cameras by triangulation."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.show import CAMERA_PANELS, SPACE_PANELS
from neurocal_cli.commands.streams import first_of, note, noted, suggest, warn
from neurocal_cli.errors import FormatError, InputError, UsageError

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.rig.evaluation import StereoEvaluation
    from neurocal_cli.calibration.rig.rig import Rig, StereoRig
    from neurocal_cli.calibration.rig.triangulation import Method
    from neurocal_cli.camera.measured import PlaneErrors
    from neurocal_cli.observations.points import Correspondences


Distance = tuple[float, str]  # a number and its unit


class _Group(options.Group):
    """A group that also takes a file, and judges it as what it is."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, that of a file by what it holds."""
        if args and args[0] not in self.commands and os.path.exists(args[0]):
            from neurocal_cli.files.camera_tree import own_kind, read_tree

            kind = own_kind(read_tree(args[0])) or "camera"
            if kind == "lens":
                from neurocal_cli.commands.lens import evaluate as lens

                return kind, lens, args
            args = [kind, *args]
        elif args and args[0] not in self.commands and {".", os.sep} & set(args[0]):
            raise FormatError("there is no such file; check the path", args[0])
        return super().resolve_command(ctx, args)


@click.group(cls=_Group)
def evaluate() -> None:
    """Measure the error of a calibrated camera or rig.

    Instead of the kind, a file may be given: `neurocal evaluate FILE` judges whatever the file is, also a
    zoom lens (see `neurocal lens evaluate`).

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal evaluate camera camera.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal evaluate stereo rig.yaml
      neurocal evaluate rig.yaml
    """  # noqa: D301 - as in the group


def _distance(ctx: click.Context, param: click.Parameter, text: str | None) -> Distance | None:
    """The number and the unit, perhaps empty, of a distance such as ``1000mm``."""
    if text is None:
        return None
    found = re.fullmatch(r"\s*([0-9]+\.?[0-9]*(?:e[-+]?[0-9]+)?)\s*([a-z]*)\s*", text.lower())
    if found is None or not 0 < float(found[1]) < math.inf:
        raise click.BadParameter(f"{text!r} is no distance; give one, such as 1000mm or 1m.")
    return float(found[1]), found[2]


def _errors_at(distance: Distance | None, result: Calibration | Rig | None) -> PlaneErrors | None:
    """The errors at a distance in any unit; None if there is no distance."""
    if distance is None or result is None:
        return None
    from neurocal_cli.observations.printed_sheet import millimetres

    value, own = distance
    try:
        factor = 1.0 if own in ("", result.unit) else millimetres(own) / millimetres(result.unit)
    except InputError as error:
        raise UsageError(f"--at {value:g}{own}: {error}") from error
    return result.errors_at(value * factor)


def _at_option(what: str) -> Callable[[options.F], options.F]:
    """Add ``--at``, a distance."""
    return click.option(
        "--at",
        metavar="DISTANCE",
        callback=_distance,
        show_default="none",
        help=f"Also say how well {what} at this distance, such as 1000mm or 1m; without a unit, in that of "
        "the calibration.",
    )


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
@_at_option("lengths and points are measured on a plane")
@options.flag("--positions", "Also say where the camera was in each view, in the coordinates of the target.")
@plot_option("the errors, and of a calibration the coverage, uncertainty and poses", CAMERA_PANELS)
@options.json
def camera(
    calibration: str, points: str | None, at: Distance | None, positions: bool, plots: Plots, as_json: bool
) -> None:
    """Measure the reprojection error of a calibrated camera, in pixels.

    The residuals of a point are du and dv, its projected pixel minus its observed pixel. The rms error
    is sqrt(mean(du^2 + dv^2)); the bias is the mean of du and of dv.

    Without POINTS.csv the points of the calibration itself are used, and the error is too optimistic.
    With POINTS.csv a view of the calibration keeps its calibrated pose if that pose fits most of its points.
    The pose of any other view is fitted first, with the intrinsic parameters fixed, and the view is
    marked `fitted`; so is another image that only has the name of a calibrated view. Points behind the
    camera are counted, but all averages leave them out.

    With --at, a table says what the uncertainty means for measurements on a plane that faces the camera at
    this distance, which is taken as exact: the std of a length half as long as what the image shows, of a
    point in the middle of the image relative to the camera, and of the least certain point; each with the
    shares of the calibration and of the noise of the pixels. With --positions, a table has the camera's
    centre in each view of the calibration, with standard deviations that include those of the camera.

    A calibration also gets a verdict. It uses the points of the calibration: the cross-validation error,
    the noise floor, the agreement of two halves of the data, the coverage of the image and the uncertainty
    of predicted pixels. With POINTS.csv it also includes the error on these points. If they determine a
    camera, it is calibrated again from them and compared with the old one as in `neurocal drift`, which tells
    whether the camera has changed.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal evaluate camera camera.yaml
      neurocal evaluate camera camera.yaml sample_data/stereo_left.csv --json
      neurocal evaluate camera camera.yaml --at 1000mm --positions
      neurocal evaluate camera camera.yaml --plot errors.png \\
          --plot uncertainty=trust.pdf
      cat sample_data/flat.csv | neurocal calibrate - | neurocal evaluate camera -
    """  # noqa: D301 - as in the group
    preparation.check((calibration, points), plots=plots)
    given = None if points is None else preparation.given_points(points)
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.drift import drift_since
    from neurocal_cli.calibration.evaluation import evaluate_camera, judged_by_points
    from neurocal_cli.calibration.verdict.rules import assess
    from neurocal_cli.commands.show import camera_report as show
    from neurocal_cli.commands.show.drift_report import since_report
    from neurocal_cli.commands.show.text import Report

    judged, seen = preparation.calibration_or_camera(calibration, given)
    own = judged if isinstance(judged, Calibration) else None
    if own is None and (at is not None or positions):
        raise UsageError(
            f"{'--positions' if at is None else '--at'} needs a calibration of neurocal, because others do "
            "not say how certain they are"
        )
    on_plane = _errors_at(at, own)
    places = {name: own.position(name) for name in own.views} if own is not None and positions else {}
    evaluation = evaluate_camera(judged, seen)
    verdict = None if own is None else assess(own)
    drift, since = None, Report()
    if own is not None and given is not None and evaluation.fit is not None:
        drift = drift_since(own, evaluation.fit.points)
        since = since_report(drift)
    if own is not None and given is not None and verdict is not None:
        verdict = judged_by_points(verdict, own, evaluation, drift)
    renamed = evaluation.renamed
    for names, why in (
        ([name for name in evaluation.fitted_views if name not in renamed], "not in the calibration"),
        (renamed, "other points than the calibration has under this name"),
    ):
        if names:
            note(f"{first_of(names)}: {why}; the pose is fitted with the intrinsic parameters fixed")
    if evaluation.on_target:
        note("the points are taken where the calibration found them, not where their file has them")
    warn(*evaluation.warnings)
    unit = "" if own is None else own.unit
    told = show.evaluation_report(evaluation, verdict, since) | show.plane_report(on_plane, unit)
    if positions:
        told |= show.position_report(places, unit)
    told.print(as_json)
    if plots:
        from neurocal_cli.commands.show.camera_panels import Subject
        from neurocal_cli.commands.show.plot_pages import draw_camera

        write_plots(plots, draw_camera, Subject.of(judged, given, evaluation))
    if verdict is not None and not as_json:
        better = "report {} -o report.html" if verdict.word == "good" else "advise {}"
        suggest(calibration, f"neurocal {better}")


@evaluate.command(cls=options.Command)
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
@_at_option("points and lengths are triangulated")
@plot_option("the errors in space, by depth and by view, and of a rig the poses", SPACE_PANELS)
@options.json
def stereo(
    cameras: tuple[str, ...],
    points: tuple[str, str] | None,
    method: Method,
    at: Distance | None,
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
    as left01 and right01, but not leftnew01: the word must not touch other letters). Points are paired by
    their ids, else by X, Y, Z.

    Without --points the points of the calibrations themselves are used, and the errors are too optimistic.
    With --points the poses of images that are not in the calibrations are fitted, also of one that only has
    the name of a calibrated view.

    With --at, a table says how well points and lengths are triangulated at this distance from the left
    camera, with the shares of the calibration and of the noise of the pixels.

    The rig also gets a verdict, as in neurocal stereo. It uses the points of the calibrations, and the error
    on the points after --points.

    \b
    Examples:
      neurocal sample sample_data
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml
      neurocal evaluate stereo rig.yaml --plot space.png --plot depth=depth.svg
      neurocal evaluate stereo rig.yaml --at 1m
      neurocal calibrate sample_data/stereo_left.csv -o left.yaml
      neurocal calibrate sample_data/stereo_right.csv -o right.yaml
      neurocal evaluate stereo left.yaml right.yaml --method linear --json
      neurocal evaluate stereo left.yaml right.yaml \\
          --points sample_data/stereo_left.csv sample_data/stereo_right.csv
    """  # noqa: D301 - as in the group
    if len(cameras) > 2:
        raise UsageError(
            f"there are {len(cameras)} files; give two calibrations, or one rig, and points after --points"
        )
    inputs = *cameras, *(points or ())
    preparation.check(inputs, plots=plots)
    given = points and (preparation.given_points(points[0]), preparation.given_points(points[1]))
    evaluation, rig = _evaluate_stereo(cameras, given, method)
    if at is not None and rig is None:
        raise UsageError("--at needs a rig; give one that neurocal stereo wrote")
    space = _errors_at(at, rig)
    from neurocal_cli.commands.show import rig_report as show
    from neurocal_cli.commands.show.camera_report import plane_report

    note(*show.views_alone(evaluation.alone))
    if evaluation.fitted:
        note(
            f"{first_of(evaluation.fitted)}: the calibrations have no such images; the poses are fitted with "
            "the cameras fixed"
        )
    warn(*evaluation.warnings)
    (show.stereo_evaluation_report(evaluation) | plane_report(space, evaluation.unit)).print(as_json)
    if plots:
        from neurocal_cli.commands.show.plot_pages import draw_points_in_space

        write_plots(plots, draw_points_in_space, evaluation, rig)
    if rig is not None and not as_json:
        suggest(cameras[0], "neurocal report {} -o report.html")


@evaluate.command(cls=options.Command)
@options.argument("file", "RIG.yaml", "A rig that neurocal wrote; - is standard input.")
@options.argument(
    "points",
    "[[NAME=]POINTS.csv]",
    "Points of its cameras to evaluate it on, as for neurocal rig; without them, those it was calibrated "
    "from.",
    nargs=-1,
    required=False,
)
@_at_option("points and lengths are triangulated")
@options.json
def rig(file: str, points: tuple[str, ...], at: Distance | None, as_json: bool) -> None:
    """Measure the errors of a rig of any number of cameras.

    Every point that two cameras or more saw is triangulated from all of them and compared with its place on
    the target, in the pose of its frame. The errors are in the frame of the first camera and in the unit of
    the target. For each camera the command also tells how far its pixels are from those that the other
    cameras predict.

    Without POINTS.csv the points of the rig itself are used, and the errors are too optimistic. With
    POINTS.csv the poses of the frames are fitted first, with the cameras fixed, and the verdict tells whether
    the rig still holds. With --at, a table says how well points and lengths are triangulated at this distance
    from the first camera, by all cameras that see them.

    \b
    Examples:
      neurocal sample sample_data
      neurocal rig sample_data/rig_cam0.csv sample_data/rig_cam1.csv \\
          sample_data/rig_cam2.csv -o rig.yaml
      neurocal evaluate rig rig.yaml --at 1m
      neurocal evaluate rig rig.yaml sample_data/rig_cam0.csv \\
          sample_data/rig_cam1.csv --json
    """  # noqa: D301 - as in the group
    from neurocal_cli.commands.rig import named_file

    named = [named_file(word) for word in points]
    preparation.check((file, *(name for _, name in named)))
    from neurocal_cli.calibration.rig.evaluation import evaluate_rig
    from neurocal_cli.commands.show.camera_report import plane_report
    from neurocal_cli.commands.show.rig_report import rig_evaluation_report
    from neurocal_cli.files.rig_points import read_rig_points
    from neurocal_cli.files.rig_yaml import read_rig

    found = read_rig(file)
    given = noted(read_rig_points, named) if named else None
    evaluation, space = evaluate_rig(found, given), _errors_at(at, found)
    warn(*evaluation.warnings)
    (rig_evaluation_report(evaluation) | plane_report(space, evaluation.unit)).print(as_json)
    if not as_json:
        suggest(file, "neurocal report {} -o report.html")


def _evaluate_stereo(
    cameras: tuple[str, ...], points: tuple[Correspondences, Correspondences] | None, method: Method
) -> tuple[StereoEvaluation, StereoRig | None]:
    """Evaluate the rig of a file, or two calibrations, of which no rig is known."""
    from neurocal_cli.calibration.rig.evaluation import evaluate_stereo, evaluate_stereo_rig

    if len(cameras) == 1:
        from neurocal_cli.files.rig_yaml import read_stereo_rig

        rig = read_stereo_rig(cameras[0])
        return evaluate_stereo_rig(rig, points, method=method), rig
    from neurocal_cli.files.calibration_yaml import read_calibration

    if points is None:
        left, right = (read_calibration(name) for name in cameras)
    else:
        left, right = (_with_poses(name, seen) for name, seen in zip(cameras, points, strict=True))
    return evaluate_stereo(left, right, points, method=method), None


def _with_poses(name: str, points: Correspondences) -> Calibration:
    """Read a calibration, or any camera file; poses that the file does not hold are fitted to the points."""
    from neurocal_cli.calibration.calibrate import calibrate
    from neurocal_cli.calibration.calibration import Calibration, undistorted_before

    camera, seen = preparation.calibration_or_camera(name, points, "; the poses are fitted")
    if isinstance(camera, Calibration):
        if camera.views:
            return camera
        note(f"{name}: holds no poses; they are fitted")
    assert seen is not None
    warn(*undistorted_before(seen, camera))
    return calibrate(seen, type=3, intrinsics=camera, outliers="keep")

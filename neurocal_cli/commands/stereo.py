"""``neurocal stereo``: points of two cameras in, a rig out."""

from __future__ import annotations

from dataclasses import replace

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.calibration_options import Estimation, estimation_options
from neurocal_cli.commands.pages import Plots, files_of, html_option, panel_option, write_page, write_plots
from neurocal_cli.commands.show import RIG_PANELS
from neurocal_cli.commands.streams import ProgressBar, concluding, note, suggest, warn
from neurocal_cli.errors import UsageError
from neurocal_cli.files.writing import write_whole


@click.command(cls=options.Command)
@options.argument("left", "LEFT.csv", "Points of the left camera; - is standard input.")
@options.argument("right", "RIGHT.csv", "Points of the right camera.")
@options.board_of_corners
@estimation_options(files=False)
@options.path(
    "--left-intrinsics",
    "CAMERA.yaml",
    "The left camera, if it is known: a neurocal, ROS or OpenCV file. Only its poses are estimated.",
)
@options.path(
    "--right-intrinsics", "CAMERA.yaml", "The right camera, if it is known. Only its poses are estimated."
)
@click.option(
    "--alpha",
    type=click.FloatRange(0, 1),
    metavar="A",
    show_default="not scaled",
    help="Zoom of the rectified images: 0 shows valid pixels only, 1 shows all pixels of the original "
    "images.",
)
@options.path(
    "--ros",
    "LEFT.yaml RIGHT.yaml",
    "Also write two camera_info files for the stereo nodes of ROS, in metres.",
)
@panel_option("the residuals, coverage and uncertainty of both cameras and the poses", RIG_PANELS)
@html_option
@options.lean
@options.summary
@options.output("RIG.yaml", "Write the rig to this file.")
def stereo(
    left: str,
    right: str,
    board: str | None,
    estimation: Estimation,
    left_intrinsics: str | None,
    right_intrinsics: str | None,
    alpha: float | None,
    ros: tuple[str, str] | None,
    plots: Plots,
    html: str | None,
    lean: bool,
    as_json: bool,
    output: str,
) -> None:
    """Calibrate two cameras and the pose of the right one relative to the left one.

    The pose of the right camera is X_right = R X_left + t. Each camera is first calibrated by itself as
    in `neurocal calibrate`; the options of that command apply to both cameras. A bundle adjustment then
    refines both cameras, the rig and all poses together. A view of one camera alone helps that camera.

    Two views are a pair if their names are equal, or equal without left, l, cam0 and right, r, cam1 (such
    as left01 and right01, but not leftnew01: the word must not touch other letters). Points are paired by
    their ids, else by X, Y, Z. Pairs of views that contradict the others are named with the likely reason:
    the board is turned in one image, one image is mirrored, the images are exchanged, an image is missing so
    that all later pairs are shifted, or they were not taken at the same moment.

    The command writes the rig as a YAML file: both calibrations, R, t, E, F, the baseline, and the
    rectification as OpenCV defines it. It prints a summary with standard deviations on standard error.

    The summary ends with a verdict: good, usable or poor, with the reasons. It uses the relative pose of the
    cameras in each pair of views, the verdicts on both cameras, the cross-validation error over pairs and the
    uncertainty of depth. It names the place where the rig moved or a focal length changed, and images that
    were not taken at the same moment. If the rig moved, the larger part of the pairs determines it.

    \b
    Examples:
      neurocal sample sample_data
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          -o rig.yaml --plot errors.png --html rig.html --ros left.yaml right.yaml \\
          --alpha 0
      neurocal calibrate sample_data/stereo_left.csv -o left.yaml
      neurocal calibrate sample_data/stereo_right.csv -o right.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --left-intrinsics left.yaml --right-intrinsics right.yaml \\
          --lean -o rig.json
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --no-skew --distortion k1 --outliers keep --target given --image-size 640 480 \\
          --method neuro --starts 40 --seed 1 | neurocal evaluate stereo -
      neurocal convert sample_data/rig_cam0.csv --to mrcal -o left.vnl
      neurocal convert sample_data/rig_cam1.csv --to mrcal -o right.vnl
      neurocal stereo left.vnl right.vnl --board chessboard:6x5:80 -o mrcal.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --type 2 --image-center 319.5 239.5 --skew auto --json \\
          -o rig.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --distortion k1k2 --fix k2=0 --fix theta=90 -o rig.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --square-pixels -o rig.yaml
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --trainer backprop --epochs 20000 --rate 0.05 --rate-gamma 0.4 \\
          -o rig.yaml
    """  # noqa: D301 - as in the group
    preparation.compute_in_one_thread()
    ros_files = ros or ()
    sides = _side(estimation, left_intrinsics), _side(estimation, right_intrinsics)
    # Each camera is checked for its own type; here type 3 is what both files of known cameras make it.
    (replace(estimation, type="1") if estimation.type == "3" else estimation).check()
    if left_intrinsics is not None and right_intrinsics is not None:
        known = (
            "no_skew",
            "skew",
            "fix",
            "square_pixels",
            "distortion",
            "image_center",
            *(["type"] if estimation.type == "2" else []),
        )
        options.note_unused("on cameras that are known", *known)
    inputs = left, right, left_intrinsics, right_intrinsics
    preparation.check((*inputs, board), (output, html, *ros_files), plots=files_of(plots), as_json=as_json)
    from neurocal_cli.calibration.rig.calibrate_stereo import calibrate_stereo
    from neurocal_cli.commands.show.stereo_report import stereo_json, stereo_report, views_alone
    from neurocal_cli.files.result_files import write_result

    prepared = [
        side.prepare(preparation.given_points(name, board=board))
        for name, side in zip((left, right), sides, strict=True)
    ]
    points, arguments = zip(*prepared, strict=True)
    with ProgressBar() as progress:
        rig = calibrate_stereo(*points, *arguments, outliers=estimation.outliers, progress=progress)
    note(*views_alone(rig.alone))
    with concluding(rig, as_json, stereo_json, stereo_report):
        if not preparation.is_for_the_eye(output, "rig.yaml"):
            warn(*write_result(rig, output, lean=lean, alpha=alpha))
        if ros is not None:
            from neurocal_cli.files.rig_yaml import format_ros_pair

            for name, text in zip(ros, format_ros_pair(rig, alpha), strict=True):
                write_whole(name, text)
        if plots:
            from neurocal_cli.commands.show.plot_pages import draw_stereo

            write_plots(plots, draw_stereo, rig)
        write_page(html, rig, *inputs)
        suggest(output, "neurocal evaluate {}", "neurocal rectify {} LEFT... RIGHT... -o DIR")


def _side(estimation: Estimation, intrinsics: str | None) -> Estimation:
    """The options for one camera."""
    if estimation.type == "4":
        raise UsageError(
            "with --type 4 the poses of all views are known, so there is no rig to estimate; use neurocal "
            "calibrate for each camera"
        )
    if intrinsics is None:
        if estimation.type == "3":
            raise UsageError(
                "--type 3 needs both known cameras; give --left-intrinsics and --right-intrinsics, or leave "
                "out --type"
            )
        return estimation
    return estimation.of_known(intrinsics)

"""``neurocal rig`` and ``neurocal stereo``: points of two cameras or more in, their rig out."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import boards, options, preparation
from neurocal_cli.commands.calibration_options import Estimation, estimation_options
from neurocal_cli.commands.outcome import Outputs, outputs
from neurocal_cli.commands.show import CAMERA_PANELS
from neurocal_cli.commands.streams import ProgressBar, note, noted, suggest
from neurocal_cli.errors import UsageError
from neurocal_cli.files.writing import write_whole

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibrate import CameraOptions


class _Command(options.Command):
    """A command in which ``--distortion NAME=MODEL`` sets the model of one camera."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse, after ``--distortion NAME=MODEL`` has become ``--distortion-of``."""
        words: list[str] = []
        for word in args:
            if word.startswith("--distortion=") and "=" in word[13:]:
                words += ["--distortion-of", word[13:]]
            elif words[-1:] == ["--distortion"] and "=" in word:
                words[-1:] = ["--distortion-of", word]
            else:
                words.append(word)
        return super().parse_args(ctx, words)


@click.command(cls=_Command)
@options.argument(
    "files",
    "[NAME=]POINTS.csv",
    "Points of each camera, two or more files; NAME names the camera, else the file does. One file with a "
    "column camera holds several. - is standard input.",
    nargs=-1,
    required=True,
)
@options.pairs(
    "--intrinsics",
    "NAME=CAMERA.yaml",
    "A camera that is known: a neurocal, ROS or OpenCV file. Only its poses are estimated. It can be "
    "repeated.",
    to="known",
)
@options.pairs(
    "--distortion-of",
    "NAME=MODEL",
    "The distortion model of one camera, also written --distortion NAME=MODEL. It can be repeated.",
    without="as --distortion",
    to="models",
)
@boards.board_of_corners
@estimation_options(files=False)
@outputs(
    "RIG.yaml",
    "Write the rig to this file.",
    "the cameras and the boards in space, and what pairs of cameras see together,",
)
def rig(
    files: tuple[str, ...],
    known: options.Named,
    models: options.Named,
    board: str | None,
    estimation: Estimation,
    outputs: Outputs,
) -> None:
    """Calibrate a rig of any number of cameras, and their poses relative to the first.

    The pose of each camera is X_name = R X_first + t. Each camera is first calibrated by itself as in
    `neurocal calibrate`; the options of that command apply to all cameras. A bundle adjustment then refines
    all cameras, their poses and those of the board together.

    Views of one name are one frame: what the cameras saw at one moment. If no two cameras have a name in
    common, names are compared without the name of the camera (cam0_017 and cam1_017 are one frame). No camera
    has to see all frames, and two cameras need none in common if others connect them. A view of one camera
    alone helps that camera.

    Views that contradict the others are left out with the likely reason. A camera that moved, another focal
    length from some frame on, another size of the board in one camera and images that were taken later are
    told apart. Where the board moves and one camera's images are late, the motion of the board between frames
    makes up for it, if the frames are numbered; a column `time` (seconds) in the points is used, too, if it
    explains more.

    The command writes the rig as a YAML file: all calibrations, the poses with their standard deviations, and
    which cameras see common frames. It prints a summary and a verdict, good, usable or poor, with the
    reasons.

    \b
    Examples:
      neurocal sample sample_data
      neurocal rig sample_data/rig_cam0.csv sample_data/rig_cam1.csv \\
          sample_data/rig_cam2.csv -o rig.yaml --plot rig.png --html rig.html
      neurocal rig left=sample_data/stereo_left.csv right=sample_data/stereo_right.csv \\
          --distortion-of left=k1k2 --no-skew --json -o rig.json
      neurocal calibrate sample_data/rig_cam0.csv -o known.yaml
      neurocal rig a=sample_data/rig_cam0.csv b=sample_data/rig_cam1.csv \\
          c=sample_data/rig_cam2.csv --intrinsics a=known.yaml --lean -o rig.yaml
      cat sample_data/rig_cam0.csv | neurocal rig cam0=- sample_data/rig_cam1.csv \\
          sample_data/rig_cam2.csv --target given --outliers keep \\
          --image-size 1280 960 --distortion k1k2 --method neuro --starts 40 \\
          --seed 1 > rig.yaml
      neurocal rig sample_data/rig_cam*.csv --type 2 --image-center 639.5 479.5 \\
          --skew auto -o rig.yaml
      neurocal rig sample_data/rig_cam*.csv --fix theta=90 --fix v0=479.5 -o rig.yaml
      neurocal convert sample_data/rig_cam0.csv --to mrcal -o left.vnl
      neurocal convert sample_data/rig_cam1.csv --to mrcal -o right.vnl
      neurocal rig left.vnl right.vnl --board chessboard:6x5:80 -o mrcal.yaml
      neurocal rig sample_data/rig_cam*.csv --square-pixels -o rig.yaml
      neurocal rig sample_data/rig_cam*.csv --trainer backprop --epochs 20000 --rate 0.05 \\
          --rate-gamma 0.4 -o rig.yaml
    """  # noqa: D301 - as in the group
    if estimation.type in ("3", "4"):
        raise UsageError(
            f"--type {estimation.type} is for one camera; give known cameras by --intrinsics NAME=CAMERA.yaml"
        )
    estimation.check()
    named = [named_file(file) for file in files]
    inputs = [file for _, file in named]
    read = *inputs, board, *(file for _, file in known)
    outputs.check(read)
    from neurocal_cli.calibration.rig.calibrate_rig import calibrate_rig
    from neurocal_cli.commands.show.rig_report import rig_json
    from neurocal_cli.files.result_files import write_result
    from neurocal_cli.files.rig_points import read_rig_points

    points = noted(read_rig_points, named, board=boards.named_board(board) if board else None)
    for what, given in (("--intrinsics", known), ("--distortion", models)):
        for name, _ in given:
            if name not in points:
                raise UsageError(
                    f"{what} {name}=...: there is no camera {name!r}; the cameras are {', '.join(points)}"
                )
    given_cameras, own_model = dict(known), dict(models)
    camera_options: dict[str, CameraOptions] = {}
    for name, one in points.items():
        own = replace(estimation, distortion=own_model.get(name, estimation.distortion))
        if name in given_cameras:
            own = own.of_known(given_cameras[name])
        points[name], camera_options[name] = own.prepare(one)
    with ProgressBar() as progress:
        found = calibrate_rig(points, camera_options, outliers=estimation.outliers, progress=progress)
    write = partial(write_result, lean=outputs.lean)
    with outputs.concluding(found, rig_json, write, inputs):
        suggest(outputs.output, "neurocal evaluate {}", "neurocal triangulate {} POINTS.csv -o XYZ.csv")


@click.command(cls=options.Command)
@options.argument("left", "LEFT.csv", "Points of the left camera; - is standard input.")
@options.argument("right", "RIGHT.csv", "Points of the right camera.")
@boards.board_of_corners
@estimation_options(files=False)
@options.path(
    "--left-intrinsics",
    "CAMERA.yaml",
    "The left camera, if it is known: a neurocal, ROS or OpenCV file. Only its poses are estimated.",
)
@options.path(
    "--right-intrinsics", "CAMERA.yaml", "The right camera, if it is known. Only its poses are estimated."
)
@options.alpha("not scaled")
@options.path(
    "--ros",
    "LEFT.yaml RIGHT.yaml",
    "Also write two camera_info files for the stereo nodes of ROS, in metres.",
)
@outputs(
    "RIG.yaml",
    "Write the rig to this file.",
    "the residuals, coverage and uncertainty of both cameras and the poses",
    CAMERA_PANELS,
)
def stereo(
    left: str,
    right: str,
    board: str | None,
    estimation: Estimation,
    left_intrinsics: str | None,
    right_intrinsics: str | None,
    alpha: float | None,
    ros: tuple[str, str] | None,
    outputs: Outputs,
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
    ros_files = ros or ()
    sides = _side(estimation, left_intrinsics), _side(estimation, right_intrinsics)
    # Each camera is checked for its own type; here type 3 is what both files of known cameras make it.
    (replace(estimation, type="1") if estimation.type == "3" else estimation).check()
    if left_intrinsics is not None and right_intrinsics is not None:
        known = ["no_skew", "skew", "fix", "square_pixels", "distortion", "image_center"]
        known += ["type"] if estimation.type == "2" else []
        options.note_unused("on cameras that are known", *known)
    inputs = left, right, left_intrinsics, right_intrinsics
    outputs.check((*inputs, board), *ros_files)
    from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
    from neurocal_cli.commands.show.rig_report import stereo_json, views_alone
    from neurocal_cli.files.result_files import write_result

    prepared = [
        side.prepare(preparation.given_points(name, board=board))
        for name, side in zip((left, right), sides, strict=True)
    ]
    points, arguments = zip(*prepared, strict=True)
    with ProgressBar() as progress:
        rig = calibrate_stereo(*points, *arguments, outliers=estimation.outliers, progress=progress)
    note(*views_alone(rig.alone))
    write = partial(write_result, lean=outputs.lean, alpha=alpha)
    with outputs.concluding(rig, stereo_json, write, inputs):
        if ros is not None:
            from neurocal_cli.files.rig_yaml import format_ros_pair

            for name, text in zip(ros, format_ros_pair(rig, alpha), strict=True):
                write_whole(name, text)
        suggest(outputs.output, "neurocal evaluate {}", "neurocal rectify {} LEFT... RIGHT... -o DIR")


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


def named_file(word: str) -> tuple[str, str]:
    """The name of a camera, "" if none is given, and its file, of ``NAME=FILE`` or ``FILE``."""
    name, equals, file = word.partition("=")
    if equals and name and file and os.sep not in name and not os.path.exists(word):
        return name, file
    return "", word

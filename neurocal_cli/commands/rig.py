"""``neurocal rig``: points of any number of cameras in, their rig out."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.calibration_options import Estimation, estimation_options
from neurocal_cli.commands.pages import html_option, plot_option, write_page, write_plot
from neurocal_cli.commands.streams import ProgressBar, concluding, noted, suggest, warn
from neurocal_cli.errors import UsageError

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibrate import CameraOptions


class _Command(options.Command):
    """A command in which ``--distortion NAME=MODEL`` sets the model of one camera."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
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
@click.option(
    "--intrinsics",
    "known",
    metavar="NAME=CAMERA.yaml",
    multiple=True,
    callback=options.pairs,
    show_default="none",
    help="A camera that is known: a neurocal, ROS or OpenCV file. Only its poses are estimated. It can be "
    "repeated.",
)
@click.option(
    "--distortion-of",
    "models",
    metavar="NAME=MODEL",
    multiple=True,
    callback=options.pairs,
    show_default="as --distortion",
    help="The distortion model of one camera, also written --distortion NAME=MODEL. It can be repeated.",
)
@options.board_of_corners
@estimation_options(files=False)
@plot_option("the cameras and the boards in space, and what pairs of cameras see together,")
@html_option
@options.lean
@options.summary
@options.output("RIG.yaml", "Write the rig to this file.")
def rig(
    files: tuple[str, ...],
    known: options.Named,
    models: options.Named,
    board: str | None,
    estimation: Estimation,
    plot: str | None,
    html: str | None,
    lean: bool,
    as_json: bool,
    output: str,
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
    preparation.compute_in_one_thread()
    if estimation.type in ("3", "4"):
        raise UsageError(
            f"--type {estimation.type} is for one camera; give known cameras by --intrinsics NAME=CAMERA.yaml"
        )
    estimation.check()
    named = [named_file(file) for file in files]
    inputs = [file for _, file in named]
    read = *inputs, board, *(file for _, file in known)
    preparation.check(read, (output, html), plots=(plot,), as_json=as_json)
    from neurocal_cli.calibration.rig.calibrate_rig import calibrate_rig
    from neurocal_cli.commands.show.plot_pages import draw_rig
    from neurocal_cli.commands.show.rig_report import rig_json, rig_report
    from neurocal_cli.files.result_files import write_result
    from neurocal_cli.files.rig_points import read_rig_points

    points = noted(read_rig_points, named, board=options.named_board(board))
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
    with concluding(found, as_json, rig_json, rig_report):
        if not preparation.is_for_the_eye(output, "rig.yaml"):
            warn(*write_result(found, output, lean=lean))
        write_plot(plot, draw_rig, found)
        write_page(html, found, *inputs)
        suggest(output, "neurocal evaluate {}", "neurocal triangulate {} POINTS.csv -o XYZ.csv")


def named_file(word: str) -> tuple[str, str]:
    """The name of a camera, "" if none is given, and its file, of ``NAME=FILE`` or ``FILE``."""
    name, equals, file = word.partition("=")
    if equals and name and file and os.sep not in name and not os.path.exists(word):
        return name, file
    return "", word

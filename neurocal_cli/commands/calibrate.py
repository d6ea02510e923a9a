"""``neurocal calibrate``: points in, a camera out."""

from __future__ import annotations

from functools import partial

import click

from neurocal_cli.commands import boards, options, preparation
from neurocal_cli.commands.calibration_options import Estimation, estimation_options
from neurocal_cli.commands.outcome import Outputs, outputs
from neurocal_cli.commands.show import CAMERA_PANELS
from neurocal_cli.commands.streams import ProgressBar, suggest

_STRAIGHTEN = "undistort {} IMAGE... -o DIR"


@click.command(cls=options.Command)
@options.points
@estimation_options()
@boards.board_of_corners
@options.camera_name
@outputs(
    "CAMERA.yaml",
    "Write the calibration to this file.",
    "the residuals, the coverage, the uncertainty, the poses and the learning curve",
    CAMERA_PANELS,
)
def calibrate(
    points: tuple[str, ...],
    estimation: Estimation,
    board: str | None,
    camera_name: str,
    outputs: Outputs,
) -> None:
    """Calibrate a camera from known points and their pixels.

    The camera has 5 intrinsic parameters: the scale factors alpha_u and alpha_v, the image centre
    (u0, v0) and the angle theta between the image axes. Each view adds a pose of 6 parameters: three
    angles and a translation. The command estimates all of them with their standard deviations, and
    the coefficients of the lens distortion. Use --type to give what is known already:

    \b
      type  known           estimated
      1     nothing         all parameters
      2     --image-center  all others
      3     --intrinsics    the poses
      4     --extrinsics    the intrinsic parameters

    Types 1 and 2 need several views of a flat board, or one view of a target that is not flat.

    The command writes the calibration as a YAML file, which ROS reads as camera_info. It prints a
    summary and a verdict on standard error. The verdict is good, usable or poor; it comes with the
    reasons and with advice.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml --camera-name left
      neurocal calibrate sample_data/flat.csv --distortion k1 --no-skew \\
          --plot errors.png --plot poses=poses.svg --html report.html \\
          -o camera.yaml
      neurocal calibrate sample_data/flat.csv --outliers keep --image-size 640 480 \\
          --lean -o camera.json
      neurocal calibrate sample_data/flat.csv --target free --skew auto -o camera.yaml
      neurocal calibrate sample_data/flat.csv --fix u0=321.8 --fix theta=90
      neurocal calibrate sample_data/flat.csv --distortion plumb_bob --fix k3=0
      neurocal calibrate sample_data/flat.csv --square-pixels -o camera.yaml
      neurocal calibrate sample_data/points.csv --type 2 --image-center 172 121
      neurocal calibrate sample_data/stereo_left.csv --type 3 \\
          --intrinsics camera.yaml -o poses.yaml
      neurocal calibrate sample_data/flat.csv --type 4 --extrinsics camera.yaml
      neurocal calibrate sample_data/flat.csv --method neuro --starts 40 --seed 1
      neurocal calibrate sample_data/points.csv --method linear --json \\
          -o linear.yaml
      neurocal calibrate sample_data/points.csv --trainer backprop \\
          --epochs 20000 --rate 0.05 --rate-gamma 0.4
      neurocal detect sample_data/board*.png --cols 9 --rows 6 --square 25 \\
          --points vertices | neurocal convert - --to mrcal -o corners.vnl
      neurocal calibrate corners.vnl --board chessboard:9x6:25 -o vnl.yaml
      cat sample_data/flat.csv | neurocal calibrate - | neurocal evaluate camera -
    """  # noqa: D301 - as in the group
    estimation.check()
    inputs = *points, estimation.intrinsics, estimation.extrinsics
    outputs.check((*inputs, board))
    given, arguments = estimation.prepare(preparation.given_points(*points, board=board))

    from neurocal_cli.calibration.calibrate import calibrate as learn
    from neurocal_cli.commands.show.camera_report import calibration_json
    from neurocal_cli.files.result_files import write_result

    with ProgressBar() as progress:
        calibration = learn(given, **arguments, camera_name=camera_name, progress=progress)
    write = partial(write_result, lean=outputs.lean)
    with outputs.concluding(calibration, calibration_json, write, inputs):
        verdict, distorted = calibration.verdict, not calibration.camera.distortion.is_identity
        if outputs.html is None:
            suggest(outputs.output, "neurocal report {} -o report.html")
        if verdict is not None and verdict.word != "good" and not outputs.lean:
            suggest(outputs.output, "neurocal advise {}")
        else:
            suggest(outputs.output, "neurocal " + (_STRAIGHTEN if distorted else "evaluate {} --at DISTANCE"))

"""``neurocal compare``: every method on the same points, side by side."""

from __future__ import annotations

import shlex
from dataclasses import replace

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.streams import ProgressBar, note, suggest


@click.command(cls=options.Command)
@options.argument("points", "POINTS.csv", "Points of a camera, as for calibrate; - is standard input.")
@options.argument(
    "right",
    "[RIGHT.csv]",
    "Points of a second camera, as for stereo: then points in space are compared too.",
    required=False,
)
@options.methods("neuro,nonlinear,linear,tsai,opencv")
@options.choice(
    "--distortion",
    options.COMMON_MODELS,
    "Distortion model of all methods that can have it; auto is the one that neuro chooses. linear has "
    "none, tsai k1 alone.",
    default="auto",
)
@options.flag(
    "--no-skew",
    "Fix the angle between the image axes at 90 degrees, as tsai and opencv do anyway.",
    without="estimate the angle",
)
@options.choice(
    "--outliers",
    "reject keep",
    "Treatment of outliers: with reject, those that neuro finds are left out for all methods.",
    default="reject",
)
@options.count(
    "--image-size", "W H", "Width and height of the images in pixels.", without="image_size in POINTS.csv"
)
@options.count(
    "--seed", "S", "Seed of the random weights, and of the choice of points to leave out.", default=0, least=0
)
@options.json
def compare(
    points: str,
    right: str | None,
    methods: tuple[str, ...],
    distortion: str,
    no_skew: bool,
    outliers: str,
    image_size: tuple[int, int] | None,
    seed: int,
    as_json: bool,
) -> None:
    """Compare calibration methods on the same points.

    All methods calibrate the camera from the same points: the network, the methods that its paper
    compares it with, and OpenCV's calibrateCamera. The table shows the rms reprojection error, the
    cross-validation error (a fifth of the points of each view is left out at a time), the time, and the
    parameters with their standard deviations.

    All methods use the target as given. Only neuro and backprop use the measured directions of mid-points.

    With the points of a second camera, each camera is calibrated alone, and the common points are
    triangulated, as in the paper's Table 2. The table shows the rms error in space and NSCE, which is 1 if
    the error is that of rounding to whole pixels. The same errors are shown for one rig for all pairs of
    views.

    All numbers except the times are the same in every run. Lines below the tables name the methods with the
    lowest errors. On clean points of a target that is not flat, several methods reach the same minimum.

    \b
    Examples:
      neurocal sample sample_data
      neurocal compare sample_data/points.csv
      neurocal compare sample_data/stereo_left.csv sample_data/stereo_right.csv \\
          --no-skew --distortion k1
      neurocal compare sample_data/flat.csv --methods neuro,linear --outliers keep \\
          --image-size 640 480 --seed 1 --json
    """  # noqa: D301 - as in the group
    preparation.check((points, right))
    given = [preparation.given_points(name) for name in (points, right) if name is not None]
    if image_size is not None:
        given = [replace(one, image_size=image_size) for one in given]

    from neurocal_cli.commands.show.methods_report import comparison_report
    from neurocal_cli.simulation.comparison import compare as compare_methods

    with ProgressBar() as progress:
        found = compare_methods(given, methods, distortion, not no_skew, outliers, seed, progress)
    note(*found.notes)
    comparison_report(found).print(as_json)
    step = "calibrate {} -o camera.yaml" if right is None else f"stereo {{}} {shlex.quote(right)} -o rig.yaml"
    suggest(points, f"neurocal {step}")

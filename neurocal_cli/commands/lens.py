"""``neurocal lens``: cameras whose zoom and focus move."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from neurocal_cli.commands.options import (
    INPUT,
    Argument,
    Command,
    FiniteNumber,
    json_option,
    output_option,
)
from neurocal_cli.commands.progress import ProgressBar
from neurocal_cli.commands.streams import check_one_stdin, note, say, warn
from neurocal_cli.commands.threads import compute_in_one_thread
from neurocal_cli.errors import UsageError

if TYPE_CHECKING:
    from neurocal_cli.zoom_lens.zoom_lens import ZoomLens

__all__ = ["lens"]

F = TypeVar("F", bound=Callable[..., Any])

_NOT_CONVERGED = 3
_PICTURES = (".png", ".pdf", ".svg")
_MOST_UNITS = 20

_LENS = click.argument(
    "lens_file",
    metavar="LENS.yaml",
    type=INPUT,
    cls=Argument,
    description="A lens written by `neurocal lens fit`; - is standard input.",
)


def _plot_option(what: str) -> Callable[[F], F]:
    return click.option(
        "--plot",
        metavar="FILE.png",
        type=click.Path(writable=False, readable=False),
        show_default="none",
        help=f"Draw {what} to this .png, .pdf or .svg file.",
    )


@click.group()
def lens() -> None:
    """Calibrate a camera whose zoom and focus move.

    \b
    Examples:
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      neurocal lens camera lens.yaml --zoom 1250 --focus 400 -o camera.yaml
      neurocal lens evaluate lens.yaml sample_data/zoom_between.csv
    """  # noqa: D301 - as in the group


@lens.command(cls=Command)
@click.argument(
    "points",
    nargs=-1,
    required=True,
    metavar="POINTS...",
    type=INPUT,
    cls=Argument,
    description="CSV files with columns zoom and/or focus and X,Y,Z,u,v (and optionally view), read "
    "as one; or "
    "known cameras: zoom and/or focus, alpha_u,alpha_v,u0,v0 (and t_z), or zoom and/or focus and "
    "camera, the name of a calibration file; - is standard input.",
)
@click.option(
    "--distortion",
    type=click.Choice(["auto", "none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "rational", "fisheye"]),
    default="auto",
    help="Lens model, a network for each coefficient; auto takes the simplest that settings held out "
    "do not deny.",
)
@click.option(
    "--training",
    type=click.Choice(["joint", "alternating"]),
    default="joint",
    help="The last step: all weights at once, or networks and calibrating net in turns as in the paper.",
)
@click.option(
    "--camera",
    type=click.Choice(["auto", "still", "moving"]),
    default="auto",
    help="still: camera and target stand still; moving: a pose for each view; auto: still if each "
    "setting has one view.",
)
@click.option(
    "--hidden",
    type=click.IntRange(0, _MOST_UNITS),
    nargs=2,
    metavar="N1 N2",
    show_default="chosen by the data",
    help="Tanh units of each network: of the first layer for each control, and of the second.",
)
@click.option(
    "--outliers",
    type=click.Choice(["reject", "keep"]),
    default="reject",
    help="Leave out settings whose data contradict those of all others, or keep them.",
)
@click.option("--no-skew", is_flag=True, help="Hold the angle between the image axes at 90 degrees.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    metavar="S",
    default=0,
    help="Seed of the random weights; the same seed gives the same file.",
)
@_plot_option("each parameter over the settings with its band, and the errors,")
@output_option("LENS.yaml", "the lens")
@click.pass_context
def fit(
    ctx: click.Context,
    points: tuple[str, ...],
    distortion: str,
    training: str,
    camera: str,
    hidden: tuple[int, int] | None,
    outliers: str,
    no_skew: bool,
    seed: int,
    plot: str | None,
    output: str,
) -> None:
    """Learn how a camera follows zoom and focus, from points at many settings.

    Each setting is calibrated by itself; then a neural network for each of alpha_u, alpha_v, u0, v0
    and t_z (and for each distortion coefficient) learns how it follows the settings; then all the
    networks learn together with the calibrating net on the pixel error of all settings. The other
    parameters are constants. The camera and the target stand still; or each setting has several views
    of a flat board, and then t_z is no parameter. How many settings are needed is a question of how
    much the lens bends between them: 5 of each control are a good start.

    Settings are in your own units (encoder counts, millimetres). Instead of points, a table of known
    cameras will do; networks are fitted to it.

    The lens, a YAML file, goes to standard output or to -o; a summary to standard error.

    \b
    Examples:
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      neurocal lens fit sample_data/zoom.csv --distortion k1 --plot lens.png -o lens.yaml
      neurocal lens fit cameras.csv | neurocal lens camera - --zoom 35
    """  # noqa: D301 - as in the group
    compute_in_one_thread()
    check_one_stdin(*points)
    _check_plot(plot, output)
    learnt = _learn(points, distortion, training, camera, hidden, outliers, no_skew, seed)
    _write(learnt, output, plot)
    from neurocal_cli.zoom_lens.report import lens_report

    say(lens_report(learnt))
    warn(learnt.warnings)
    if not learnt.converged:
        ctx.exit(_NOT_CONVERGED)


def _learn(
    points: tuple[str, ...],
    distortion: str,
    training: str,
    camera: str,
    hidden: tuple[int, int] | None,
    outliers: str,
    no_skew: bool,
    seed: int,
) -> ZoomLens:
    from neurocal_cli.io.lens_points import read_lens_data
    from neurocal_cli.zoom_lens.fit_cameras import LensCameras, fit_lens_cameras
    from neurocal_cli.zoom_lens.fit_points import fit_lens

    notes: list[str] = []
    data = read_lens_data(points, notes=notes)
    note(notes)
    topologies = None if hidden is None else (hidden,)
    with ProgressBar() as progress:
        if isinstance(data, LensCameras):
            return fit_lens_cameras(data, seed, topologies=topologies, progress=progress)
        return fit_lens(
            data,
            distortion=distortion,
            training=training,
            outliers=outliers,
            camera=camera,
            skew=not no_skew,
            seed=seed,
            topologies=topologies,
            progress=progress,
        )


def _check_plot(plot: str | None, output: str | None) -> None:
    if plot is None:
        return
    if not plot.lower().endswith(_PICTURES):
        raise UsageError(f"--plot {plot}: the name must end in {', '.join(_PICTURES)}")
    if output not in (None, "-") and os.path.realpath(str(output)) == os.path.realpath(plot):
        raise UsageError("-o and --plot name the same file; give each its own")
    from neurocal_cli.plots import check_available

    check_available()


def _write(learnt: ZoomLens, output: str, plot: str | None) -> None:
    """Write both files, the picture drawn before either is touched."""
    from neurocal_cli.io.lens_yaml import write_lens

    if plot is not None:
        from neurocal_cli.io.files import write_whole
        from neurocal_cli.zoom_lens.plots import draw_lens

        write_whole(plot, draw_lens(learnt, os.path.splitext(plot)[1][1:].lower()))
    write_lens(learnt, output)


@lens.command(cls=Command)
@_LENS
@click.option("--zoom", type=FiniteNumber(), metavar="Z", show_default="none", help="Zoom setting.")
@click.option("--focus", type=FiniteNumber(), metavar="F", show_default="none", help="Focus setting.")
@click.option("--extrapolate", is_flag=True, help="Allow a setting outside the calibrated range.")
@click.option(
    "--camera-name", metavar="NAME", default="camera", help="Name of the camera, written to the file."
)
@output_option("CAMERA.yaml", "the calibration")
def camera(
    lens_file: str,
    zoom: float | None,
    focus: float | None,
    extrapolate: bool,
    camera_name: str,
    output: str,
) -> None:
    """Give the camera that a lens is at one setting.

    An ordinary calibration file, with standard deviations, goes to standard output or to -o. It holds
    no points, and for a camera that stood still it holds the pose, as of the view `view`.

    \b
    Examples:
      neurocal lens camera lens.yaml --zoom 1250 --focus 400 -o camera.yaml
      neurocal lens camera lens.yaml --zoom 1250 --focus 400 | neurocal evaluate camera - points.csv
    """  # noqa: D301 - as in the group
    compute_in_one_thread()
    if not camera_name.strip() or not camera_name.isprintable():
        raise UsageError("--camera-name must be a name of printable characters")
    from neurocal_cli.io.calibration_yaml import write_calibration
    from neurocal_cli.io.lens_yaml import read_lens
    from neurocal_cli.zoom_lens.camera_at import camera_at

    learnt = read_lens(lens_file)
    setting, warnings = learnt.setting_of({"zoom": zoom, "focus": focus}, extrapolate)
    calibration = camera_at(learnt, setting, camera_name, tuple(warnings))
    write_calibration(calibration, output)
    if output != "-":
        from neurocal_cli.zoom_lens.report import camera_report

        say(camera_report(calibration))
    warn(warnings)


@lens.command(cls=Command)
@_LENS
@click.argument(
    "points",
    metavar="POINTS.csv",
    type=INPUT,
    cls=Argument,
    description="Points with columns zoom and/or focus, at any settings; - is standard input.",
)
@_plot_option("the error over the settings, and beside it the rivals',")
@json_option
def evaluate(lens_file: str, points: str, plot: str | None, as_json: bool) -> None:
    """Measure the error of a lens at other settings, beside that of the usual models.

    The rivals are made from the same calibration data: a lookup table with linear and with spline
    interpolation, thin-plate splines, polynomials of degree 1 to 6; each parameter by itself, and
    (joint) all together with the constants. A camera that stood still is judged with its own pose,
    otherwise the pose of each view is fitted with the intrinsic parameters held.

    \b
    Examples:
      neurocal lens evaluate lens.yaml sample_data/zoom_between.csv
      neurocal lens evaluate lens.yaml sample_data/zoom_between.csv --json
    """  # noqa: D301 - as in the group
    compute_in_one_thread()
    check_one_stdin(lens_file, points)
    _check_plot(plot, None)
    from neurocal_cli.io.lens_points import read_lens_points
    from neurocal_cli.io.lens_yaml import read_lens
    from neurocal_cli.zoom_lens.evaluation import evaluate_lens
    from neurocal_cli.zoom_lens.report import evaluation_json, evaluation_report

    learnt = read_lens(lens_file)
    notes: list[str] = []
    data = read_lens_points(points, notes=notes)
    note(notes)
    evaluation = evaluate_lens(learnt, data)
    if plot is not None:
        from neurocal_cli.io.files import write_whole
        from neurocal_cli.zoom_lens.plots import draw_evaluation

        write_whole(plot, draw_evaluation(evaluation, learnt.controls, os.path.splitext(plot)[1][1:].lower()))
    if as_json:
        click.echo(json.dumps(evaluation_json(evaluation), indent=2, allow_nan=False))
    else:
        click.echo(evaluation_report(evaluation, learnt.controls))
    warn(evaluation.warnings)

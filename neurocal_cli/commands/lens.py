"""``neurocal lens``: cameras whose zoom and focus move."""

from __future__ import annotations

from typing import Any

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.outcome import Outputs, outputs
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.streams import ProgressBar, noted, print_summary, print_text, say, suggest, warn
from neurocal_cli.errors import UsageError

_MOST_UNITS = 20  # of a layer
# Options that change nothing on known cameras.
_OF_POINTS = ("distortion", "training", "camera", "outliers", "no_skew", "target")

_LENS = options.argument(
    "lens_file", "LENS.yaml", "A lens that `neurocal lens fit` wrote; - is standard input."
)


@click.group(cls=options.Group)
def lens() -> None:
    """Calibrate a zoom lens, whose zoom and focus change.

    Neural networks learn how the parameters of the camera depend on the settings of zoom and focus.
    They then give the camera at any setting. The paper calls such a lens an active lens.

    \b
    Examples:
      neurocal sample sample_data
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      neurocal lens camera lens.yaml --zoom 1250 --focus 400 -o camera.yaml
      neurocal lens evaluate lens.yaml sample_data/zoom_between.csv
    """  # noqa: D301 - as in the group


@lens.command(cls=options.Command)
@options.argument(
    "points",
    "POINTS...",
    "CSV files of points with the columns zoom and/or focus, X,Y,Z,u,v and optionally view; or "
    "of known cameras with zoom and/or focus and alpha_u,alpha_v,u0,v0 (and t_z), or with zoom and/or focus "
    "and camera, the name of a calibration file. Several files are read as one; - is standard input.",
    nargs=-1,
    required=True,
)
@options.choice(
    "--distortion",
    options.COMMON_MODELS,
    "Distortion model, with a network for each coefficient; none is a pinhole camera. auto chooses a "
    "richer model only if it lowers the cross-validation error over the settings.",
    default="auto",
)
@options.choice(
    "--training",
    "joint alternating",
    "Last step of the training: joint changes all weights at once, alternating trains the networks of "
    "the parameters and the calibrating network in turn, as in the paper.",
    default="joint",
)
@options.choice(
    "--camera",
    "auto still moving",
    "Motion of the camera relative to the target: still is none, moving estimates a pose for each view, "
    "auto is still if each setting has one view.",
    default="auto",
)
@options.count(
    "--hidden",
    "N1 N2",
    "Size of each network: number of tanh units in the first layer, for each of zoom and focus, and in "
    "the second layer.",
    without="chosen from the data",
    least=0,
    most=_MOST_UNITS,
)
@options.choice(
    "--outliers",
    "reject keep",
    "Treatment of settings that contradict the others: reject leaves them out, keep uses them all.",
    default="reject",
)
@options.no_skew
@options.choice(
    "--target",
    "auto given flat free",
    "Treatment of the shape of a board in several views, the same at all settings: given uses X, Y, Z as "
    "they are; free estimates how the board is bent and printed; flat does so within its plane; auto does "
    "so if the points support it.",
    default="auto",
)
@options.seed
@outputs(
    "LENS.yaml",
    "Write the lens to this file.",
    "each parameter over the settings, with its uncertainty, and the errors",
    page=False,
)
def fit(
    points: tuple[str, ...],
    hidden: tuple[int, int] | None,
    no_skew: bool,
    outputs: Outputs,
    **same: Any,  # arguments of `fit_lens` with the same names and values
) -> None:
    """Learn how the camera depends on zoom and focus.

    The input is points at many settings of zoom and focus. First, each setting is calibrated by itself.
    Then a neural network for each of alpha_u, alpha_v, u0, v0 and t_z, and for each distortion
    coefficient, learns how the parameter depends on the setting. Finally, all networks are trained
    together to reduce the reprojection error at all settings. The other parameters are the same at all
    settings.

    Keep the camera and the target still while the lens changes. Or take several views of a flat board
    at each setting; then t_z is not a parameter of the lens. Five values each of zoom and focus are a
    good start; a lens whose parameters change quickly needs more.

    Settings are in your own units, such as encoder counts or millimetres. A table of known cameras
    may be given instead of points.

    The command writes the lens as a YAML file. It prints a summary on standard error.

    \b
    Examples:
      neurocal sample sample_data
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      neurocal lens fit sample_data/zoom.csv --distortion k1 --no-skew \\
          --camera still --training alternating --plot lens.png -o lens.yaml
      neurocal lens fit sample_data/zoom.csv --hidden 2 2 --outliers keep --seed 1 \\
          --target given --json -o lens.yaml
    """  # noqa: D301 - as in the group
    outputs.check(points)
    from neurocal_cli.calibration.zoom.fit import LensCameras, fit_lens, fit_lens_cameras
    from neurocal_cli.commands.show.zoom_report import lens_json
    from neurocal_cli.files.lens_files import read_lens_data, write_lens

    data = noted(read_lens_data, points)
    topologies = None if hidden is None else (hidden,)
    with ProgressBar() as progress:
        if isinstance(data, LensCameras):
            options.note_unused("on known cameras", *_OF_POINTS)
            learnt = fit_lens_cameras(data, same["seed"], topologies=topologies, progress=progress)
        else:
            learnt = fit_lens(data, skew=not no_skew, topologies=topologies, progress=progress, **same)
    with outputs.concluding(learnt, lens_json, write_lens):
        settings = " ".join(f"--{name} {name[0].upper()}" for name in learnt.controls)
        suggest(outputs.output, f"neurocal lens camera {{}} {settings} -o camera.yaml")


@lens.command(cls=options.Command)
@_LENS
@options.number("--zoom", "Z", "Zoom setting of the camera.", without="none")
@options.number("--focus", "F", "Focus setting of the camera.", without="none")
@options.flag(
    "--extrapolate", "Allow a setting outside the calibrated range.", without="refuse such a setting"
)
@options.camera_name
@options.summary
@options.output("CAMERA.yaml", "Write the calibration to this file.")
def camera(
    lens_file: str,
    zoom: float | None,
    focus: float | None,
    extrapolate: bool,
    camera_name: str,
    as_json: bool,
    output: str,
) -> None:
    """Write the camera at one setting of a zoom lens.

    The output is an ordinary calibration file with standard deviations. It contains no points. If the
    camera stood still during the calibration, it contains the pose as that of the view `view`.

    \b
    Examples:
      neurocal sample sample_data
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      neurocal lens camera lens.yaml --zoom 1250 --focus 400 -o camera.yaml
      neurocal lens camera lens.yaml --zoom 3100 --focus 400 --extrapolate \\
          --camera-name tele --json -o tele.yaml
    """  # noqa: D301 - as in the group
    preparation.check((lens_file,), (output,), as_json=as_json)
    from neurocal_cli.calibration.zoom.zoom_lens import camera_at
    from neurocal_cli.files.lens_files import read_lens
    from neurocal_cli.files.result_files import write_calibration

    learnt = read_lens(lens_file)
    setting, _ = learnt.setting_of({"zoom": zoom, "focus": focus}, extrapolate)
    calibration = camera_at(learnt, setting, camera_name, extrapolate=extrapolate)
    write_calibration(calibration, output)
    if as_json:
        from neurocal_cli.commands.show.camera_report import calibration_json

        chosen = dict(zip(learnt.controls, setting.tolist(), strict=True))
        print_summary({"setting": chosen, **calibration_json(calibration)})
    elif output != "-":
        from neurocal_cli.commands.show.zoom_report import camera_report

        say(camera_report(calibration))
    warn(*calibration.warnings)
    suggest(output, "neurocal undistort {} IMAGE... -o DIR")


@lens.command(cls=options.Command)
@_LENS
@options.argument(
    "points",
    "[POINTS.csv]",
    "A CSV file of points at any settings, with the columns zoom and/or focus; - is standard input. Without "
    "it, the lens is judged by its own calibration.",
    required=False,
)
@plot_option("the error over the settings, and the errors of the baseline models")
@options.json
def evaluate(lens_file: str, points: str | None, plots: Plots, as_json: bool) -> None:
    """Measure the reprojection error of a zoom lens.

    The error is compared with that of baseline models. These are fitted to the data that the lens was
    calibrated from: a lookup table with linear and with spline interpolation, thin-plate splines, and
    polynomials of degree 1 to 6. Each is fitted to one parameter at a time, and (joint) to all parameters
    at once. If the camera stood still during the calibration, its pose is used; otherwise the pose of
    each view is fitted with the intrinsic parameters fixed.

    The lens also gets a verdict: good, usable or poor, with the reasons. It uses the rejected settings, the
    error at these points and the cross-validation error over the settings (both compared with the noise
    floor), and the uncertainty of the focal length between the settings. `neurocal lens fit` prints it too.

    \b
    Examples:
      neurocal sample sample_data
      neurocal lens fit sample_data/zoom.csv -o lens.yaml
      neurocal lens evaluate lens.yaml sample_data/zoom_between.csv --plot errors.png
      neurocal lens evaluate lens.yaml sample_data/zoom_between.csv --json
    """  # noqa: D301 - as in the group
    preparation.check((lens_file, points), plots=plots)
    if points is None and plots:
        raise UsageError("--plot shows the errors at points; give POINTS.csv")
    from neurocal_cli.calibration.zoom.evaluation import evaluate_lens
    from neurocal_cli.calibration.zoom.judgement import judge_lens
    from neurocal_cli.commands.show import zoom_report as show
    from neurocal_cli.files.lens_files import read_lens, read_lens_points

    learnt = read_lens(lens_file)
    if points is None:  # as `fit` shows it
        if as_json:
            print_summary(show.lens_json(learnt))
        else:
            print_text(learnt.summary)
        warn(*learnt.warnings)
        suggest(lens_file, "neurocal lens evaluate {} POINTS.csv", "neurocal report {} -o report.html")
        return
    data = noted(read_lens_points, points)
    evaluation = evaluate_lens(learnt, data)
    verdict = judge_lens(learnt, evaluation.rmse_px, evaluation.noise_px)
    show.evaluation_report(evaluation, learnt.controls, verdict).print(as_json)
    warn(*evaluation.warnings)
    write_plots(plots, show.draw_evaluation, evaluation, learnt.controls)
    suggest(lens_file, "neurocal report {} -o report.html")

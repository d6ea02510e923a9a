"""``neurocal advise``: which views to photograph next."""

from __future__ import annotations

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.pages import plot_option, write_plot
from neurocal_cli.commands.streams import ProgressBar, answer, suggest


@click.command(cls=options.Command)
@options.argument("calibration", "CAMERA.yaml", "A calibration that neurocal wrote; - is standard input.")
@options.count("--next", "N", "Number of views to advise.", default=3, most=20, to="count")
@plot_option("the outlines of these views")
@options.json
def advise(calibration: str, count: int, plot: str | None, as_json: bool) -> None:
    """Advise which views of the target to photograph next.

    The command compares about 900 views that show the whole target: 25 positions in the image, 3 distances,
    17 tilts and 2 rotations. It chooses the view that lowers the uncertainty of the camera most, then the
    best next one, and so on. The number after each view is the remaining uncertainty.

    The uncertainty is the largest standard deviation of predicted pixels in the image, for points at half to
    ten times the distance of the views; that of the verdict is for points at that distance. A change of the
    camera that a motion of its frame compensates does not count. Systematic errors, such as a wrong
    distortion model, are not included; see the verdict of neurocal evaluate camera.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal advise camera.yaml --next 2
      neurocal advise camera.yaml --plot next.png --json
    """  # noqa: D301 - as in the group
    preparation.check((calibration,), plots=(plot,))
    from neurocal_cli.calibration.advice import advise as weigh
    from neurocal_cli.commands.show.advice import advice_json, advice_lines
    from neurocal_cli.files.calibration_tree import read_calibration

    known = read_calibration(calibration)
    with ProgressBar("comparing views"):
        advice = weigh(known, count)
    answer(as_json, lambda: advice_json(advice), lambda: "\n".join(advice_lines(advice, known.verdict)))
    if plot is not None:
        from neurocal_cli.commands.show.advised_views import draw_advice

        write_plot(plot, draw_advice, advice, known)
    elif not as_json:
        suggest(calibration, "neurocal advise {} --plot next.png")

"""``neurocal advise``: which views to photograph next, of one camera or of a rig."""

from __future__ import annotations

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.streams import ProgressBar, suggest


@click.command(cls=options.Command)
@options.argument("calibration", "FILE.yaml", "A camera or a rig that neurocal wrote; - is standard input.")
@options.count("--next", "N", "Number of views to advise.", default=3, most=20, to="count")
@plot_option("the outlines of these views")
@options.json
def advise(calibration: str, count: int, plots: Plots, as_json: bool) -> None:
    """Advise which views of the target to photograph next.

    The command compares about 900 views that show the whole target: 25 positions in the image, 3 distances,
    17 tilts and 2 rotations. It chooses the view that lowers the uncertainty of the camera most, then the
    best next one, and so on. The number after each view is the remaining uncertainty.

    The uncertainty is the largest standard deviation of predicted pixels in the image, for points at half to
    ten times the distance of the views; that of the verdict is for points at that distance. A change of the
    camera that a motion of its frame compensates does not count. Systematic errors, such as a wrong
    distortion model, are not included; see the verdict of neurocal evaluate camera.

    Of a rig, each view ties the pair of cameras that is weakest then: the one that knows least where the
    second camera sees what the first one sees. It is described as the first camera sees it; the second one
    sees most of the target at the same moment. The numbers after each view are the standard deviation of the
    place without it and with it. --plot shows the views of the first pair, in the image of its first camera.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o camera.yaml
      neurocal advise camera.yaml --next 2
      neurocal advise camera.yaml --plot next.png --json
      neurocal rig sample_data/rig_cam*.csv -o rig.yaml
      neurocal advise rig.yaml --next 1
    """  # noqa: D301 - as in the group
    preparation.check((calibration,), plots=plots)
    from neurocal_cli.calibration.advice import advise as weigh
    from neurocal_cli.calibration.rig.advice import advise_rig
    from neurocal_cli.commands.show import advice as show
    from neurocal_cli.files.calibration_yaml import calibration_from_field
    from neurocal_cli.files.camera_tree import own_kind, read_tree
    from neurocal_cli.files.rig_yaml import rig_from_field

    root = read_tree(calibration)
    if own_kind(root) in ("stereo", "rig"):
        rig = rig_from_field(root)
        with ProgressBar("comparing views"):
            ties = advise_rig(rig, count)
        show.rig_advice_report(ties).print(as_json)
        write_plots(plots, show.draw_rig_advice, ties, rig)
        return
    known = calibration_from_field(root)
    with ProgressBar("comparing views"):
        advice = weigh(known, count)
    show.advice_report(advice, known.verdict).print(as_json)
    write_plots(plots, show.draw_advice, advice, known)
    if plots:
        suggest(calibration, "photograph these views, and calibrate from all images")
    elif not as_json:
        suggest(calibration, "neurocal advise {} --plot next.png")

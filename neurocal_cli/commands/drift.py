"""``neurocal drift``: whether a camera or a rig has changed since an earlier calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from neurocal_cli.commands import options, preparation
from neurocal_cli.commands.preparation import Plots, plot_option, write_plots
from neurocal_cli.commands.streams import note
from neurocal_cli.errors import FormatError, InputError

if TYPE_CHECKING:
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.rig.rig import Rig
    from neurocal_cli.camera.camera import Camera

_DIFFERENT = 4  # exit status


@click.command(cls=options.Command)
@options.argument(
    "old",
    "OLD.yaml",
    "The earlier calibration of the camera or rig. A ROS or OpenCV file is taken as exact; - is standard "
    "input.",
)
@options.argument("new", "NEW.yaml", "The later calibration of the same camera or rig.")
@plot_option("the differences over the image, in pixels and in standard deviations,")
@options.json
def drift(old: str, new: str, plots: Plots, as_json: bool) -> None:
    """Tell whether a camera or a rig has changed since an earlier calibration.

    The new camera projects the rays of the old camera's pixels. A rotation between the two is fitted first,
    because it belongs to the poses. What is left is the difference in pixels, and its standard deviation
    follows from the covariances of both calibrations. The distortion models of the two may differ.

    Of two rigs, each camera is compared in this way, and its pose relative to the first camera with the
    standard deviations of both.

    Calibrations of an unchanged camera or rig are called different in at most one of 1000 cases. The answer
    is also the exit status: 0 if it is the same within the standard deviations, 4 if it is different.

    To compare a calibration with new points instead, see `neurocal evaluate camera`.

    \b
    Examples:
      neurocal sample sample_data
      neurocal calibrate sample_data/flat.csv -o old.yaml
      neurocal calibrate sample_data/stereo_left.csv -o new.yaml
      neurocal drift old.yaml new.yaml --plot drift.png
      neurocal drift old.yaml new.yaml --json
      neurocal stereo sample_data/stereo_left.csv sample_data/stereo_right.csv -o rig.yaml
      neurocal drift rig.yaml rig.yaml
    """  # noqa: D301 - as in the group
    preparation.check((old, new), plots=plots)
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.calibration.drift import SHARE, find_drift
    from neurocal_cli.calibration.rig.rig import Rig
    from neurocal_cli.calibration.rig.rig_drift import find_rig_drift
    from neurocal_cli.camera.camera import camera_of
    from neurocal_cli.commands.show import drift_report as show

    before, after = _read(old), _read(new)
    if isinstance(before, Rig) and isinstance(after, Rig):
        rigs = find_rig_drift(before, after)
        found, limit, different = rigs.cameras, rigs.limit, rigs.different
        sizes = {name: before.cameras[name].image_size or after.cameras[name].image_size for name in found}
        if rigs.twice:
            note(
                f"errors of given cameras, which both rigs share, count twice ({', '.join(rigs.twice)}), so "
                "a small change may be missed; write both rigs without --lean"
            )
        show.rig_drift_report(rigs).print(as_json)
    elif isinstance(before, Rig) or isinstance(after, Rig):
        raise InputError("one file is a rig and the other one camera; give two of a kind")
    else:
        one, limit = find_drift(before, after), SHARE
        found, different, sizes = {"": one}, one.different, {"": before.image_size or after.image_size}
        models = [camera_of(camera).model for camera in (before, after)]
        if different and models[0] != models[1]:
            note(
                f"the distortion models differ ({models[0]} and {models[1]}), which may be all that changed; "
                "calibrate both with the same --distortion"
            )
        show.drift_report(before, after, one).print(as_json)
    write_plots(plots, show.draw_drift, {name: (found[name], sizes[name]) for name in found}, limit)
    if different:
        for name, result in ((old, before), (new, after)):
            if isinstance(result, (Calibration, Rig)):
                preparation.warn_of_poor(
                    f"calibration {name}", result, "; its errors may be all that differs"
                )
        click.get_current_context().exit(_DIFFERENT)


def _read(name: str) -> Calibration | Camera | Rig:
    """A calibration with its points, a rig, or any camera file; one without covariance is taken as exact."""
    from neurocal_cli.calibration.calibration import Calibration
    from neurocal_cli.files.calibration_yaml import calibration_from_field
    from neurocal_cli.files.camera_tree import own_kind, read_tree
    from neurocal_cli.files.exchange.reading import read_given_camera
    from neurocal_cli.files.rig_yaml import rig_from_field

    try:
        root = read_tree(name)
        if own_kind(root) in ("stereo", "rig"):
            return rig_from_field(root)
        camera: Calibration | Camera = calibration_from_field(root)
    except FormatError:
        camera = read_given_camera(name)
    if not (isinstance(camera, Calibration) and camera.known_covariance[0]):
        note(f"{name} does not say how accurate its camera is, so it is taken as exact")
    return camera

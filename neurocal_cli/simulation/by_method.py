"""One function for all methods, each with the distortion model that is nearest to the requested one."""

from __future__ import annotations

from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.other_methods.calibrate_by import calibrate_by
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.observations.points import Correspondences

METHODS = ("neuro", "backprop", "nonlinear", "linear", "tsai", "opencv")


def calibrate_with(
    method: str, points: Correspondences, model: str, skew: bool = True, seed: int = 0
) -> Calibration:
    """Calibrate a camera by one of `METHODS`, with nothing known (type 1), from all points of a given target.

    The method backprop is the network with the paper's trainer, and opencv is `calibrateCamera`. Of the
    requested distortion model, linear uses none, and tsai at most k1. Raises NeurocalError if the method has
    no solution.
    """
    if method == "opencv":
        return calibrate_by("opencv", problem_for(points, 1, skew=skew, distortion=Distortion(model)))
    trainer = "backprop" if method == "backprop" else "lm"
    if method == "linear":
        model = "none"
    elif method == "tsai" and model != "none":
        model = "k1"
    return calibrate(
        points,
        method="neuro" if method == "backprop" else method,
        trainer=trainer,
        distortion=model,
        skew=skew,
        outliers="keep",
        seed=seed,
        target="given",  # the other methods cannot estimate the target
    )

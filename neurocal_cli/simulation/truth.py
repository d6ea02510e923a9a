"""The true camera and its poses, in the form of a calibration."""

from __future__ import annotations

from neurocal_cli.calibration import Calibration, ViewResult
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES
from neurocal_cli.simulation.scenes import SimulatedScene


def true_calibration(scene: SimulatedScene) -> Calibration:
    """A calibration without any error, whose parameters are all given."""
    camera, points = scene.camera, scene.points()
    names = (*INTRINSIC_NAMES, *coefficient_names(camera.model))
    views = {
        name: ViewResult(pose, dict.fromkeys(POSE_NAMES, 0.0), int((scene.view == name).sum()), 0.0, True)
        for name, pose in scene.poses.items()
    }
    return Calibration(
        intrinsics=camera.intrinsics,
        std=dict.fromkeys(names, 0.0),
        fixed=frozenset(names),
        views=views,
        points=points,
        type=1,
        method="simulation",
        trainer="none",
        seed=0,
        converged=True,
        stop_reason="the truth of a simulation",
        rmse_px=0.0,
        max_px=0.0,
        distortion_model=camera.model,
        distortion=camera.distortion.coefficients
        if camera.model != "none"
        else camera.distortion.coefficients[:0],
        camera_name=camera.name,
    )

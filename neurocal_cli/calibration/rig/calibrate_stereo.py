"""`calibrate_stereo`: calibration of a rig from the points of two cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import Any

from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.common_target import can_tell, common_target
from neurocal_cli.calibration.rig.fit_rig import fit_rig
from neurocal_cli.calibration.rig.pairing import pair_points, pair_views
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.errors import UsageError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

_SIDES = ("left", "right")
_ROUNDS = 2  # rounds of selecting lenses and target alternately
_OF_LEAST_SQUARES = ("neuro", "nonlinear")  # cameras of other methods are not refined


def calibrate_stereo(
    left: Correspondences,
    right: Correspondences,
    left_options: Mapping[str, Any] | None = None,
    right_options: Mapping[str, Any] | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Rig:
    """Calibrate two cameras and their rig from random weights.

    Each camera is calibrated alone, as by `calibrate`. The rig is then found from the views of both cameras,
    which are paired by name. A common bundle adjustment refines both cameras, the rig and all poses. Views of
    one camera alone contribute to that camera. If the distortion models are selected automatically, both
    cameras get the same one unless the points contradict that.

    Parameters
    ----------
    left, right : Correspondences
        In one world unit. Views are paired by name, points by id, else by X, Y, Z (see `pairing`).
    left_options, right_options : dict, optional
        Arguments of `calibrate` for one camera, such as ``type=3, intrinsics=camera`` for a known one.
    progress : callable, optional
        Called with the name of a stage and the share of it that is done.
    **options
        Arguments of `calibrate` for both cameras. `outliers` also applies to pairs of views that contradict
        the others.

    Returns
    -------
    Rig
        ``X_right = R X_left + t``.

    Raises
    ------
    UsageError
        As `calibrate`; an option that it does not have; type 4, where all poses are known.
    InputError, DegenerateGeometryError
        The points do not determine the rig; the message says why.
    """
    sides = [dict(options) | dict(extra or {}) for extra in (left_options, right_options)]
    unknown = set().union(*sides) - set(signature(calibrate).parameters)
    if unknown:
        raise UsageError(f"calibrate has no option {min(unknown)!r}; correct its name or leave it out")
    if any(side.get("type", 1) == 4 for side in sides):
        raise UsageError(
            "with type 4 the poses of all views are known, so there is no rig to estimate; calibrate each "
            "camera"
        )
    # Errors of pairing are reported before the training.
    pair_points(left, right, pair_views(left.view_names, right.view_names))
    cameras, kept = _on_one_target(left, right, sides, progress)
    best = all(camera.method in _OF_LEAST_SQUARES for camera in cameras)
    outliers = options.get("outliers", "reject")
    rig = fit_rig(cameras[0], cameras[1], refine_cameras=best, outliers=outliers, target_kept=kept)
    warnings = [
        f"{name}: {text}"
        for name, camera in zip(_SIDES, (rig.left, rig.right), strict=True)
        for text in camera.warnings
    ]
    return replace(rig, warnings=(*rig.warnings, *warnings))


def _on_one_target(
    left: Correspondences,
    right: Correspondences,
    sides: Sequence[Mapping[str, Any]],
    progress: Progress | None,
) -> tuple[list[Calibration], bool]:
    """Calibrate both cameras on one target, which is estimated from both if the points support that.

    Also returns whether the given target was kept although it could have been estimated.
    """
    choice = sides[0].get("target", "auto")

    def camera(side: int, target: str | Target, preferred: str = "") -> Calibration:
        name, points = _SIDES[side], (left, right)[side]
        options = {"camera_name": name, **sides[side], "target": target, "preferred": preferred}
        return calibrate(points, **options, progress=_named(progress, name))

    def calibrated(target: str | Target) -> list[Calibration]:
        cameras = [camera(side, target) for side in (0, 1)]
        for side in _others_model(cameras):
            model = cameras[1 - side].distortion_model
            alike = camera(side, target, model)
            if alike.distortion_model == model:
                cameras[side] = alike
                break
        return cameras

    surveyed = left.world_std is not None or right.world_std is not None
    cameras = calibrated(choice if surveyed else "given")
    for _ in range(_ROUNDS):
        target = common_target(cameras, choice)
        if target is None:
            break
        before = [camera.distortion_model for camera in cameras]
        cameras = calibrated(target)
        if [camera.distortion_model for camera in cameras] == before:
            break
    kept = choice == "auto" and not surveyed and cameras[0].target is None and can_tell(cameras, choice)
    return cameras, kept


def _others_model(cameras: Sequence[Calibration]) -> list[int]:
    """Sides that could take the other camera's distortion model, first the one that loses less by it.

    Both cameras of a rig are mostly of the same type, so their models differ only if the points require it.
    """
    models = [camera.distortion_model for camera in cameras]
    choices = [camera.lens_choice for camera in cameras]
    if models[0] == models[1] or not all(choices):
        return []
    cost = [
        choices[side].get(models[1 - side], math.inf) / max(choices[side][models[side]], 1e-300)
        for side in (0, 1)
    ]
    sides = [
        side for side in (0, 1) if math.isfinite(cost[side]) and models[1 - side] in cameras[side].would_take
    ]
    return sorted(sides, key=lambda side: cost[side])


def _named(progress: Progress | None, name: str) -> Progress | None:
    if progress is None:
        return None
    return lambda stage, share: progress(f"{name} camera: {stage}", share)

"""Cameras that see one target, each calibrated alone, but on one shape of it, estimated from all views."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np

from neurocal_cli.adjustment.observability import views_without_pose
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.common_target import can_tell, common_target
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import UsageError, plural
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

_ROUNDS = 2  # rounds of selecting lenses and target alternately
_OF_LEAST_SQUARES = ("neuro", "nonlinear")  # cameras of other methods are not refined


@frozen_dataclass(eq=False)
class SeveralCameras:
    """Calibrated cameras by name."""

    cameras: Mapping[str, Calibration]
    target_kept: bool  # whether the given target was kept although it could have been estimated

    @property
    def refinable(self) -> bool:
        """Whether a common bundle adjustment may refine the cameras."""
        return all(camera.method in _OF_LEAST_SQUARES for camera in self.cameras.values())


def check_options(options: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse options that `calibrate` does not have, and cameras whose poses are all known."""
    unknown = set().union(*options.values()) - set(signature(calibrate).parameters)
    if unknown:
        raise UsageError(f"calibrate has no option {min(unknown)!r}; correct its name or leave it out")
    if any(own.get("type", 1) == 4 for own in options.values()):
        raise UsageError(
            "with type 4 the poses of all views are known, so there is no rig to estimate; calibrate each "
            "camera"
        )


def with_poses(points: Mapping[str, Correspondences]) -> tuple[dict[str, Correspondences], list[str]]:
    """The points without views that determine no pose, such as a row of points, and what was left out.

    A camera without any other view keeps all, so that its calibration says what is wrong.
    """
    kept, told = {}, []
    for name, one in points.items():
        without = views_without_pose(arrange(one))
        kept[name] = one
        if without and len(without) < one.n_views:
            bad = np.array([view in without for view in one.view_names])
            kept[name] = one.select(~bad[one.view_index])
            first = next(iter(without))
            told.append(
                f"{name}: {plural(len(without), 'view')} left out, such as {first!r}: {without[first]}"
            )
    return kept, told


def cameras_on_one_target(
    points: Mapping[str, Correspondences],
    options: Mapping[str, Mapping[str, Any]],
    progress: Progress | None,
) -> SeveralCameras:
    """Calibrate cameras on one target, which is estimated from all of them if the points support that.

    `points` and `options`, the arguments of `calibrate`, are by the name of the camera.
    """
    names = list(points)
    choice = options[names[0]].get("target", "auto")

    def camera(name: str, target: str | Target, preferred: str = "") -> Calibration:
        own = {"camera_name": name, **options[name], "target": target, "preferred": preferred}
        return calibrate(points[name], **own, progress=_named(progress, name))

    def calibrated(target: str | Target) -> list[Calibration]:
        cameras = [camera(name, target) for name in names]
        for k, model in _likely_models(cameras):
            alike = camera(names[k], target, model)
            if alike.distortion_model == model:
                cameras[k] = alike
                if len(cameras) == 2:
                    break
        return cameras

    surveyed = any(one.world_std is not None for one in points.values())
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
    return SeveralCameras(dict(zip(names, _with_one_target(cameras), strict=True)), kept)


def _with_one_target(cameras: Sequence[Calibration]) -> list[Calibration]:
    """The cameras, holding one target where theirs are equal."""
    first = cameras[0].target
    return [
        replace(camera, target=first) if first is not None and _is_equal(first, camera.target) else camera
        for camera in cameras
    ]


def _is_equal(one: Target, other: Target | None) -> bool:
    return (
        other is not None
        and np.array_equal(one.given, other.given)
        and np.array_equal(one.found, other.found)
    )


def _likely_models(cameras: Sequence[Calibration]) -> list[tuple[int, str]]:
    """Cameras that could take another distortion model, that of most cameras; first those that lose least.

    Cameras of a rig are mostly of the same type, so their models differ only if the points require it. Of two
    cameras, each could take the other's. A fisheye among many ordinary lenses stays one: few views of it by
    itself may fit an ordinary lens, and those of the rig do not.
    """
    models = [camera.distortion_model for camera in cameras]
    if len(set(models)) == 1 or (len(cameras) == 2 and not all(camera.lens_choice for camera in cameras)):
        return []
    most = max(models, key=models.count)
    wanted = models[::-1] if len(cameras) == 2 else [most] * len(cameras)

    def loss(k: int) -> float:
        choice = cameras[k].lens_choice
        return choice.get(wanted[k], math.inf) / max(choice[models[k]], 1e-300) if choice else math.inf

    could = [
        k
        for k, camera in enumerate(cameras)
        if wanted[k] != models[k]
        and math.isfinite(loss(k))
        and wanted[k] in camera.would_take
        and (len(cameras) == 2 or (wanted[k] in WIDE) == camera.camera.distortion.wide)
    ]
    return [(k, wanted[k]) for k in sorted(could, key=loss)]


def _named(progress: Progress | None, name: str) -> Progress | None:
    if progress is None:
        return None
    return lambda stage, share: progress(f"{name} camera: {stage}", share)

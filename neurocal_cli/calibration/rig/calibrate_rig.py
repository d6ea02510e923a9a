"""Calibration of a rig of any number of cameras, from their points: each camera alone, then all together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from neurocal_cli.calibration.arranged_boards import arranged
from neurocal_cli.calibration.calibrate import CameraOptions
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.frames import connected_frames
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.several_cameras import (
    SeveralCameras,
    cameras_on_one_target,
    check_options,
    with_poses,
)
from neurocal_cli.errors import InputError, UsageError, check_kind
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, TargetChoice

if TYPE_CHECKING:
    from typing_extensions import Unpack


def calibrate_rig(
    points: Mapping[str, Correspondences],
    camera_options: Mapping[str, CameraOptions] | None = None,
    *,
    progress: Progress | None = None,
    **options: Unpack[CameraOptions],
) -> Rig:
    """Calibrate cameras that are fixed to each other, and their relative poses, from random weights.

    Each camera is calibrated alone, as by `calibrate`. A common bundle adjustment then refines the cameras,
    their relative poses and those of the frames. If the distortion models are selected automatically, the
    cameras get the same one unless the points contradict that.

    Parameters
    ----------
    points : dict of Correspondences by the name of the camera
        In one world unit. Views with the same name are one frame (see `frames`). Views of one camera alone
        contribute to that camera.
    camera_options : dict of dict by the name of the camera, optional
        Arguments of `calibrate` for one camera, such as ``distortion="fisheye"``, or ``type=3,
        intrinsics=camera`` for a known one.
    progress : callable, optional
        Called with the name of a stage and the share of it that is done.
    **options
        Arguments of `calibrate` for all cameras. `outliers` also applies to views that contradict the rig.

    Returns
    -------
    Rig
        ``X_name = R X_first + t``.

    Raises
    ------
    UsageError
        Fewer than two cameras, options for a camera that is not there, type 4, or as `calibrate`.
    InputError, DegenerateGeometryError
        No view connects some cameras with the others, or the points do not determine the rig.
    """
    if len(points) < 2:
        raise UsageError(f"a rig has two cameras or more, not {len(points)}; give the points of each camera")
    for name, one in points.items():
        check_kind(f"points of {name}", one, Correspondences, "what read_points made")
    extra = camera_options or {}
    if stray := sorted(set(extra) - set(points)):
        raise UsageError(f"there are options for a camera {stray[0]!r}, but no points; give its points")
    of_each: dict[str, dict[str, Any]] = {name: {**options, **extra.get(name, {})} for name in points}
    check_options(of_each)
    points, told = with_poses(points)
    several = [name for name, one in points.items() if one.image is not None]
    if several and len(several) < len(points):
        without = next(name for name in points if name not in several)
        raise InputError(
            f"camera {without} has no column board, but {several[0]} has; give it to all cameras"
        )
    if several:

        def fitted(some: Mapping[str, Correspondences], target: TargetChoice | Target) -> SeveralCameras:
            with_target = {name: {**own, "target": target} for name, own in of_each.items()}
            return cameras_on_one_target(some, with_target, progress)

        choice = next(iter(of_each.values())).get("target", "auto")
        found, about_boards = arranged(points, choice, fitted, lambda fit: fit.cameras)
        told += about_boards
    else:
        connected_frames(points)  # errors are reported before the training
        found = cameras_on_one_target(points, of_each, progress)
    rig = fit_rig(
        found.cameras,
        refine_cameras=found.refinable,
        outliers=options.get("outliers", "reject"),
        target_kept=found.target_kept,
    )
    own = [f"{name}: {text}" for name, camera in rig.cameras.items() for text in camera.warnings]
    return replace(rig, warnings=(*told, *rig.warnings, *own))

"""Calibration of a rig from points: each camera alone, on one target, then all together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np

from neurocal_cli.adjustment.observability import views_without_pose
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.arranged_boards import arranged
from neurocal_cli.calibration.calibrate import CameraOptions, calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import adjust_rig, rig_problem
from neurocal_cli.calibration.rig.assessment import told_once
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.calibration.rig.frames import FrameNames, connected_frames
from neurocal_cli.calibration.rig.rig import Rig, StereoRig
from neurocal_cli.calibration.target_choice import can_tell, common_target, on_one_target
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError, InputError, UsageError, plural
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, TargetChoice

SIDES = ("left", "right")


_ROUNDS = 2  # rounds of selecting lenses and target alternately
# A target that would move by less with the lenses selected on it (in std, rms over all points) has errors
# that are at most 2 % larger, and the common adjustment still moves it.
_SETTLED = 0.2
# Nothing was left out of a camera: outliers are looked for again where an error of its target may have hidden
# them, so where the rms error falls below this share with another target.
_HIDDEN = 0.9
_OF_LEAST_SQUARES = ("neuro", "nonlinear")  # cameras of other methods are not refined


def _options_of_each(
    points: Mapping[str, Correspondences],
    extra: Mapping[str, CameraOptions],
    options: CameraOptions,
) -> dict[str, dict[str, Any]]:
    """The options of each camera, by its name, after all arguments of `calibrate_rig` are checked."""
    if len(points) < 2:
        raise UsageError(f"a rig has two cameras or more, not {len(points)}; give the points of each camera")
    if stray := sorted(set(extra) - set(points)):
        raise UsageError(f"there are options for a camera {stray[0]!r}, but no points; give its points")
    of_each: dict[str, dict[str, Any]] = {name: {**options, **extra.get(name, {})} for name in points}
    if unknown := set().union(*of_each.values()) - set(signature(calibrate).parameters):
        raise UsageError(f"calibrate has no option {min(unknown)!r}; correct its name or leave it out")
    if any(own.get("type", 1) == 4 for own in of_each.values()):
        raise UsageError(
            "with type 4 the poses of all views are known, so there is no rig to estimate; calibrate each "
            "camera"
        )
    return of_each


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
) -> tuple[dict[str, Calibration], bool]:
    """Calibrate cameras on one target, which is estimated from all of them if the points support that.

    The second result is whether the given target was kept although it could have been estimated.
    `points` and `options`, the arguments of `calibrate`, are by the name of the camera.
    """
    names = list(points)
    choice = options[names[0]].get("target", "auto")

    def camera(name: str, target: str | Target, start: Calibration | None, model: str = "") -> Calibration:
        own = {"camera_name": name, **options[name], "target": target, "preferred": model}
        own["progress"] = _named(progress, name)
        if start is None or len(start.rejected):
            return calibrate(points[name], **own, start=start)
        found = calibrate(points[name], **{**own, "outliers": "keep"}, start=start)
        hardly = found.rmse_px > _HIDDEN * start.rmse_px
        return found if hardly else calibrate(points[name], **own, start=found)

    def calibrated(target: str | Target, starts: Sequence[Calibration | None]) -> list[Calibration]:
        cameras = [camera(name, target, start) for name, start in zip(names, starts, strict=True)]
        for k, model in _likely_models(cameras):
            try:
                alike = camera(names[k], target, cameras[k], model)
            except DegenerateGeometryError:  # its own points do not determine it
                continue
            if alike.distortion_model == model:
                cameras[k] = alike
                if len(cameras) == 2:
                    break
        return cameras

    surveyed = any(one.world_std is not None for one in points.values())
    cameras = calibrated(choice if surveyed else "given", [None] * len(names))
    target: Target | None = None
    for _ in range(_ROUNDS):
        before, target = target, common_target(cameras, choice)
        if target is None or (before is not None and target.moved_from(before) < _SETTLED):
            break
        models = [camera.distortion_model for camera in cameras]
        cameras = calibrated(target, cameras)
        if [camera.distortion_model for camera in cameras] == models:
            break
    kept = choice == "auto" and not surveyed and cameras[0].target is None and can_tell(cameras, choice)
    return dict(zip(names, cameras, strict=True)), kept


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
        and (len(cameras) == 2 or (wanted[k] in WIDE) == camera.camera.distortion.wide)
    ]
    return [(k, wanted[k]) for k in sorted(could, key=loss)]


def _named(progress: Progress | None, name: str) -> Progress | None:
    if progress is None:
        return None
    return lambda stage, share: progress(f"{name} camera: {stage}", share)


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
    of_each = _options_of_each(points, camera_options or {}, options)
    points, told = with_poses(points)
    cameras, kept, about_boards = _cameras(points, of_each, progress)
    rig = fit_rig(
        cameras,
        refine_cameras=all(camera.method in _OF_LEAST_SQUARES for camera in cameras.values()),
        outliers=options.get("outliers", "reject"),
        target_kept=kept,
    )
    own = told_once({name: camera.warnings for name, camera in rig.cameras.items()})
    return replace(rig, warnings=(*told, *about_boards, *rig.warnings, *dict.fromkeys(own.values())))


def _cameras(
    points: Mapping[str, Correspondences], of_each: Mapping[str, Mapping[str, Any]], progress: Progress | None
) -> tuple[dict[str, Calibration], bool, tuple[str, ...]]:
    """As `cameras_on_one_target`, also of several boards; the third result tells how these are arranged."""
    several = [name for name, one in points.items() if one.image is not None]
    if not several:
        connected_frames(points)  # errors are reported before the training
        return *cameras_on_one_target(points, of_each, progress), ()
    if without := [name for name in points if name not in several]:
        raise InputError(
            f"camera {without[0]} has no column board, but {several[0]} has; give it to all cameras"
        )

    def fitted(
        some: Mapping[str, Correspondences], target: TargetChoice | Target
    ) -> tuple[dict[str, Calibration], bool]:
        with_target = {name: {**own, "target": target} for name, own in of_each.items()}
        return cameras_on_one_target(some, with_target, progress)

    choice = next(iter(of_each.values())).get("target", "auto")
    found, about_boards = arranged(points, choice, fitted, lambda fit: fit[0])
    return *found, about_boards


def calibrate_stereo(
    left: Correspondences,
    right: Correspondences,
    left_options: CameraOptions | None = None,
    right_options: CameraOptions | None = None,
    *,
    progress: Progress | None = None,
    **options: Unpack[CameraOptions],
) -> StereoRig:
    """Calibrate two cameras and their rig from random weights.

    It is `calibrate_rig` of two cameras, whose views are paired by name; see there.

    Parameters
    ----------
    left, right : Correspondences
        In one world unit. Views are paired by name, points by id, else by X, Y, Z (see `frames`).
    left_options, right_options : dict, optional
        Arguments of `calibrate` for one camera, such as ``type=3, intrinsics=camera`` for a known one.
    progress : callable, optional
        Called with the name of a stage and the share of it that is done.
    **options
        Arguments of `calibrate` for both cameras. `outliers` also applies to pairs of views that contradict
        the others.

    Returns
    -------
    StereoRig
        ``X_right = R X_left + t``.

    Raises
    ------
    UsageError
        As `calibrate`; an option that it does not have; type 4, where all poses are known.
    InputError, DegenerateGeometryError
        The points do not determine the rig; the message says why.
    """
    extra = dict(zip(SIDES, (left_options or {}, right_options or {}), strict=True))
    points = dict(zip(SIDES, (left, right), strict=True))
    return _stereo(calibrate_rig(points, extra, progress=progress, **options))


def fit_stereo(left: Calibration, right: Calibration) -> StereoRig:
    """Find the pose of the right camera relative to the left one from the views of both.

    The cameras stay as they are. Pairs of views that contradict most others are left out, with a warning.

    Raises
    ------
    InputError
        No pairs of views, or views without common points; see `frames`.
    DegenerateGeometryError
        Views that contradict each other.
    CoincidentCamerasError
        Cameras at one place.
    """
    return _stereo(fit_rig(dict(zip(SIDES, on_one_target(left, right), strict=True))))


def _stereo(rig: Rig) -> StereoRig:
    pair = rig.pair(*SIDES)
    return replace(pair, warnings=(*pair.warnings, *_swapped(pair)))


def _swapped(rig: StereoRig) -> tuple[str, ...]:
    """A warning where the right camera is on the left."""
    centre = -rig.R.T @ rig.t  # of the right camera in the left camera's frame
    if centre[0] >= 0 or abs(centre[0]) <= np.abs(centre[1:]).max():
        return ()
    return (
        f"the right camera is {-centre[0]:.4g} {rig.unit} to the left of the left one; if they "
        "are swapped, give the left camera first",
    )


def poses_on_rig(
    rig: Mapping[str, Pose], cameras: Mapping[str, Calibration], frames: FrameNames
) -> dict[str, Pose]:
    """Poses of the frames of several cameras that fit all of them best, by the names of the frames.

    `rig` are the poses of the cameras in a frame of reference, in which those of the frames are. The
    calibrations have the poses of the views in each camera alone.
    """
    base, *others = (rig[name] for name in cameras)
    problem = rig_problem(list(cameras.values()), frames.of_views)
    start = problem.start([pose.relative_to(base) for pose in others])
    state = adjust_rig(problem, start, np.zeros(start.columns.n_shared, dtype=bool)).state
    found = {}
    for k in np.flatnonzero(problem.together):
        R = state.view_R[k]
        t = state.view_t[k] * problem.scale[k] - R @ problem.centre[k]
        found[frames.names[k]] = Pose.exact(base.R.T @ R, base.R.T @ (t - base.t))
    return found

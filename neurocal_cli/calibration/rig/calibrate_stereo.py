"""Calibration of a rig: from the points of two cameras, or from two cameras calibrated already.

`calibrate_stereo` calibrates each camera alone first. `fit_rig` leaves out the pairs of views that contradict
most others, adjusts the rig together with the poses and, if wanted, the cameras, and finds its covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np

from neurocal_cli.calibration.calibrate import calibrate
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.common_target import can_tell, common_target, on_one_target
from neurocal_cli.calibration.rig.adjust import (
    RigFit,
    RigProblem,
    adjust_rig,
    free_parameters,
    stereo_problem,
)
from neurocal_cli.calibration.rig.agreeing_poses import with_agreeing_poses
from neurocal_cli.calibration.rig.assessment import assess_rig
from neurocal_cli.calibration.rig.contradiction import contradiction
from neurocal_cli.calibration.rig.covariance import (
    covariance_of_stretch,
    not_smaller,
    rig_covariance,
    with_target_uncertainty,
)
from neurocal_cli.calibration.rig.pairing import ViewPairs, pair_points, pair_views
from neurocal_cli.calibration.rig.relative_poses import relative_poses
from neurocal_cli.calibration.rig.result import assemble_stereo, non_monotonic_sides
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.sound_pairs import sound_pairs
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, UsageError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

# Largest rms residual of the common fit, in units of that of both cameras alone, with which the cameras are
# refined; otherwise errors of the pairs spoil them: test_pairs_that_scatter_do_not_spoil_the_cameras.
_SPOILS = 1.6
_BASELINE_SIGMAS = 3.0  # a baseline below this number of standard deviations counts as 0
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
    cameras, kept = _cameras_on_one_target(left, right, sides, progress)
    best = all(camera.method in _OF_LEAST_SQUARES for camera in cameras)
    outliers = options.get("outliers", "reject")
    rig = fit_rig(cameras[0], cameras[1], refine_cameras=best, outliers=outliers, target_kept=kept)
    warnings = [
        f"{name}: {text}"
        for name, camera in zip(_SIDES, (rig.left, rig.right), strict=True)
        for text in camera.warnings
    ]
    return replace(rig, warnings=(*rig.warnings, *warnings))


def _cameras_on_one_target(
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


def fit_rig(
    left: Calibration,
    right: Calibration,
    *,
    refine_cameras: bool = False,
    outliers: str = "reject",
    target_kept: bool = False,
) -> Rig:
    """Find the pose of the right camera relative to the left one from the views of both.

    Parameters
    ----------
    left, right : Calibration
    refine_cameras : bool
        Whether the bundle adjustment also refines the intrinsic parameters and distortions that were
        estimated. Otherwise it refines the rig and the poses alone.
    outliers : {"reject", "keep"}
        Whether pairs of views that contradict most others are left out of the rig with a warning, or raise.
    target_kept : bool
        Whether the given target was kept although it could have been estimated from both cameras.

    Returns
    -------
    Rig

    Raises
    ------
    InputError
        No pairs of views, or views without common points; see `pairing`.
    DegenerateGeometryError
        Views that contradict each other.
    CoincidentCamerasError
        Cameras at one place.
    UsageError
        An unknown option.
    """
    if outliers not in ("reject", "keep"):
        raise UsageError(f"outliers must be reject or keep, not {outliers!r}")
    left, right = on_one_target(left, right)
    views = pair_views(left.points.view_names, right.points.view_names)
    pair_points(left.points, right.points, views)
    left, right = with_agreeing_poses(left, right, views)
    sound = sound_pairs(left, right, views)
    if sound.left_out and outliers == "keep":
        raise DegenerateGeometryError(sound.contradiction(outliers))
    problem = sound.problem
    if sound.left_out:
        kept = tuple(pair for pair in views.both if pair not in sound.left_out)
        problem = stereo_problem(left, right, kept)
    fit, warnings = _adjusted(problem, [sound.rig], refine_cameras)
    least = _covariance(fit, sound.by_chance and not sound.left_out)
    if left.target is not None and left.target is right.target:
        uncertain = with_target_uncertainty(left.target, fit)
        least = uncertain if least is None or uncertain is None else not_smaller(least, uncertain)
    stretched = None
    if target_kept or left.target_stretched or right.target_stretched:
        stretched = covariance_of_stretch(fit)
    if target_kept and stretched is not None:
        left, right = (replace(camera, target_stretched=stretched[0]) for camera in (left, right))
        fit = replace(fit, problem=replace(problem, calibrations=(left, right)))
    rig = assemble_stereo(fit, sound.left_out, least, None if stretched is None else stretched[1])
    _refuse_one_place(rig)
    if sound.left_out:
        warnings.insert(0, sound.contradiction())
    return replace(rig, warnings=(*warnings, *_swapped(rig)), judgement=assess_rig)


def _adjusted(problem: RigProblem, starts: Sequence[Pose], refine_cameras: bool) -> tuple[RigFit, list[str]]:
    """The common bundle adjustment, and its warnings."""
    moving = [refine_cameras] * len(problem.cameras)
    warnings = []
    while True:
        free = np.concatenate(
            [free_parameters(c) & moves for c, moves in zip(problem.calibrations, moving, strict=True)]
            + [np.ones(problem.n_rig, dtype=bool)]
        )
        fit = adjust_rig(problem, problem.start(starts), free)
        if any(moving) and np.sqrt(fit.variance) > _SPOILS:
            moving = [False] * len(moving)
            warnings = [
                "the pairs of views contradict each other, so both cameras keep the result of their own views"
            ]
            continue
        if not (not_monotonic := non_monotonic_sides(fit)):
            return fit, warnings
        for side in not_monotonic:
            moving[side] = False
            warnings.append(
                f"after the common bundle adjustment the distortion model of the {_SIDES[side]} camera "
                "is not monotonic (maps two directions to one pixel) inside the image, where there "
                "are no points; the result of its own views is kept; add views that show the board in the "
                "image's corners"
            )


def _covariance(fit: RigFit, by_chance: bool) -> Array | None:
    """Covariance of the shared parameters if that of independent points is too small; else None."""
    estimated = fit.problem.estimated_shared
    held = bool((fit.free != estimated).any())
    if by_chance and not held:
        return None
    poses = relative_poses(fit.problem, Pose(fit.state.R[1], fit.state.t[1] * fit.problem.unit))
    if poses is None:
        return None
    used = np.ones(len(poses), dtype=bool)
    found = contradiction(poses, used, seek_odd=False)
    if not held and not found.is_significant:
        return None
    moved = fit.free[estimated]
    return rig_covariance(poses, used, found)[np.ix_(moved, moved)]


def _refuse_one_place(rig: Rig) -> None:
    if rig.baseline > _BASELINE_SIGMAS * rig.std["baseline"]:
        return
    raise CoincidentCamerasError(
        f"both cameras are at the same place: the baseline is {rig.baseline:.3g} +- "
        f"{rig.std['baseline']:.2g} {rig.unit}; give the points (or calibrations) of two different cameras"
    )


def _swapped(rig: Rig) -> tuple[str, ...]:
    """A warning where the right camera is on the left."""
    centre = -rig.R.T @ rig.t  # of the right camera in the left camera's frame
    if centre[0] >= 0 or abs(centre[0]) <= abs(centre[1]):
        return ()
    return (
        f"the right camera is {-centre[0]:.4g} {rig.unit} to the left of the left one; if they "
        "are swapped, give the left camera first",
    )


def poses_on_rig(rig: Pose, cameras: tuple[Calibration, Calibration], views: ViewPairs) -> dict[str, Pose]:
    """Poses of views in the left camera's frame that fit both cameras of a known rig best, by its names.

    The cameras have the poses of the views in each camera alone.
    """
    problem = stereo_problem(*cameras, views.both)
    start = problem.start([rig])
    state = adjust_rig(problem, start, np.zeros(start.columns.n_shared, dtype=bool)).state
    R, t = problem.world_poses(state, side=0)
    return {name: Pose(R[k], t[k]) for k, name in enumerate(problem.names[0])}

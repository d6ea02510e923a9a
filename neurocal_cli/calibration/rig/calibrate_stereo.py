"""Calibration of a rig: from the points of two cameras, or from two cameras calibrated already.

`calibrate_stereo` calibrates each camera alone first. `fit_rig` leaves out the pairs of views that contradict
most others, adjusts the rig together with the poses and, if wanted, the cameras, and finds its covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.common_target import on_one_target
from neurocal_cli.calibration.rig.adjust import (
    RigFit,
    adjust_rig,
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
from neurocal_cli.calibration.rig.refinement import adjusted
from neurocal_cli.calibration.rig.relative_poses import relative_poses
from neurocal_cli.calibration.rig.result import assemble_stereo
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.several_cameras import cameras_on_one_target, check_options
from neurocal_cli.calibration.rig.sound_pairs import sound_pairs
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import CoincidentCamerasError, DegenerateGeometryError, UsageError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

_BASELINE_SIGMAS = 3.0  # a baseline below this number of standard deviations counts as 0
_SIDES = ("left", "right")


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
    check_options(dict(zip(_SIDES, sides, strict=True)))
    # Errors of pairing are reported before the training.
    pair_points(left, right, pair_views(left.view_names, right.view_names))
    points = dict(zip(_SIDES, (left, right), strict=True))
    found = cameras_on_one_target(points, dict(zip(_SIDES, sides, strict=True)), progress)
    cameras = tuple(found.cameras.values())
    outliers = options.get("outliers", "reject")
    rig = fit_rig(
        cameras[0],
        cameras[1],
        refine_cameras=found.refinable,
        outliers=outliers,
        target_kept=found.target_kept,
    )
    warnings = [
        f"{name}: {text}"
        for name, camera in zip(_SIDES, (rig.left, rig.right), strict=True)
        for text in camera.warnings
    ]
    return replace(rig, warnings=(*rig.warnings, *warnings))


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
    fit, warnings = adjusted(
        problem, problem.start([sound.rig]), refine_cameras, [f"{side} camera" for side in _SIDES]
    )
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

"""Calibration of a rig of any number of cameras, from their points.

`calibrate_rig` calibrates each camera alone, finds the poses of the cameras through the edges of the rig
(pairs of cameras with common frames, see `edges`), leaves out views that contradict the others, and adjusts
all cameras, poses and frames together. Where images of one frame were taken at different times, the target's
motion and the delays of the cameras belong to the adjustment (`motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import RigFit, RigProblem, rig_problem
from neurocal_cli.calibration.rig.agreeing_poses import with_agreeing_poses
from neurocal_cli.calibration.rig.calibrate_stereo import calibrate_stereo
from neurocal_cli.calibration.rig.camera_rig import CameraRig
from neurocal_cli.calibration.rig.contradiction import is_significant
from neurocal_cli.calibration.rig.covariance import (
    covariance_of_stretch,
    covariance_over_frames,
    not_smaller,
    with_target_uncertainty,
)
from neurocal_cli.calibration.rig.edges import connected, examined, fitting, is_suspect, views_left_out
from neurocal_cli.calibration.rig.frames import FrameNames, check_one_target, match_views, refuse_apart
from neurocal_cli.calibration.rig.motion import timed
from neurocal_cli.calibration.rig.pairing import ViewPairs
from neurocal_cli.calibration.rig.refinement import adjusted
from neurocal_cli.calibration.rig.result import RigAssembly
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.rig_assessment import assess_camera_rig
from neurocal_cli.calibration.rig.rivals import (
    LATE_CAMERA,
    MOVED_CAMERA,
    log_evidence,
    named_cause,
    scatter,
    without_a_part,
)
from neurocal_cli.calibration.rig.several_cameras import cameras_on_one_target, check_options, with_poses
from neurocal_cli.calibration.rig.sound_pairs import MOVED
from neurocal_cli.calibration.verdict.findings import name_some
from neurocal_cli.calibration.verdict.rival import LEVEL
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import POSE_NAMES, Pose
from neurocal_cli.errors import DegenerateGeometryError, UsageError
from neurocal_cli.network.options import Progress
from neurocal_cli.observations.points import Correspondences

_HERE = Pose(np.eye(3), np.zeros(3))


def calibrate_rig(
    points: Mapping[str, Correspondences],
    camera_options: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> CameraRig:
    """Calibrate cameras that are fixed to each other, and their relative poses, from random weights.

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
        Arguments of `calibrate` for all cameras.

    Returns
    -------
    CameraRig
        ``X_name = R X_first + t``. Of two cameras it holds the same as `calibrate_stereo` finds.

    Raises
    ------
    UsageError
        Fewer than two cameras, options for a camera that is not there, or as `calibrate`.
    InputError, DegenerateGeometryError
        No view connects some cameras with the others, or the points do not determine the rig.
    """
    if len(points) < 2:
        raise UsageError(f"a rig has two cameras or more, not {len(points)}; give the points of each camera")
    extra = camera_options or {}
    if stray := sorted(set(extra) - set(points)):
        raise UsageError(f"there are options for a camera {stray[0]!r}, but no points; give its points")
    own = {name: {**options, **extra.get(name, {})} for name in points}
    points, told = with_poses(points)
    if len(points) == 2:
        (left, first), (right, second) = points.items()
        stereo = calibrate_stereo(first, second, own[left], own[right], progress=progress)
        return replace(of_two(stereo, left, right), warnings=(*told, *stereo.warnings))
    check_options(own)
    check_one_target(points)
    _connected_frames(points)
    found = cameras_on_one_target(points, own, progress)
    rig = fit_camera_rig(
        found.cameras,
        refine_cameras=found.refinable,
        outliers=options.get("outliers", "reject"),
        target_kept=found.target_kept,
    )
    return replace(rig, warnings=(*told, *rig.warnings))


def fit_camera_rig(
    cameras: Mapping[str, Calibration],
    *,
    refine_cameras: bool = False,
    outliers: str = "reject",
    target_kept: bool = False,
) -> CameraRig:
    """Find the poses of cameras relative to the first one; the parameters are as for `fit_rig`."""
    names = list(cameras)
    views = _connected_frames({name: camera.points for name, camera in cameras.items()})
    cameras = dict(zip(names, _with_agreeing_poses(list(cameras.values()), views), strict=True))
    problem = rig_problem(list(cameras.values()), views.of_views)
    edges = examined(problem, views.seen)
    start = connected(edges, names)
    left_out = views_left_out(edges, problem)
    times = _times(cameras)

    def fitted() -> tuple[RigFit, list[str]]:
        within = _detached(problem, left_out, names)
        fit, warnings = adjusted(within, within.start(start), refine_cameras, names)
        moving = with_delays(fit, times, names)
        return (
            (fit, warnings)
            if moving is fit
            else adjusted(moving.problem, moving.state, refine_cameras, names)
        )

    fit, warnings = fitted()
    if any(map(is_suspect, left_out.values())):
        fits = fitting(_detached(problem, _named(left_out), names), fit)
        held = _views(problem, fits) & {view for view, why in left_out.items() if is_suspect(why)}
        if held:
            left_out = {view: why for view, why in left_out.items() if view not in held}
            fit, warnings = fitted()
    for _ in names:
        found, _ = named_cause(fit, names)
        if found is None or found.cause is not MOVED_CAMERA:
            break
        late, apart = without_a_part(fit, found)
        why = f"{MOVED} {'after' if late else 'before'} {found.text}"
        left_out |= dict.fromkeys(_views(problem, apart), why)
        fit, warnings = fitted()
    if left_out and outliers == "keep":
        raise DegenerateGeometryError(
            f"{_describe(left_out, names)}; remove these views, or use --outliers reject"
        )
    least, stretched = _covariance(fit), None
    target = cameras[names[0]].target
    if target is not None and all(camera.target is target for camera in cameras.values()):
        uncertain = with_target_uncertainty(target, fit)
        least = uncertain if least is None or uncertain is None else not_smaller(least, uncertain)
    if target_kept or any(camera.target_stretched for camera in cameras.values()):
        stretched = covariance_of_stretch(fit)
    if target_kept and stretched is not None:
        kept = tuple(replace(camera, target_stretched=stretched[0]) for camera in fit.problem.calibrations)
        fit = replace(fit, problem=replace(fit.problem, calibrations=kept))
    rig = _assembled(fit, names, least, None if stretched is None else stretched[1])
    if left_out:
        warnings.insert(0, _describe(left_out, names))
    told = [f"{name}: {text}" for name, camera in rig.cameras.items() for text in camera.warnings]
    return replace(
        rig,
        left_out={(names[c], view): why for (c, view), why in left_out.items()},
        judgement=assess_camera_rig,
        warnings=(*warnings, *told),
    )


def _connected_frames(points: Mapping[str, Correspondences]) -> FrameNames:
    """The frames of all views; an error if they do not connect all cameras."""
    views = match_views({name: one.view_names for name, one in points.items()})
    seen = views.seen.astype(int)
    together = seen[:, seen.sum(axis=0) > 1]
    refuse_apart(list(points), together @ together.T > 0)
    return views


def _with_agreeing_poses(cameras: list[Calibration], views: FrameNames) -> list[Calibration]:
    """Cameras with the poses of flat targets on which they agree with others."""
    if not any(camera.second_poses for camera in cameras):
        return cameras
    frames = [dict(zip(own.tolist(), camera.points.view_names, strict=True))
              for own, camera in zip(views.of_views, cameras, strict=True)]  # fmt: skip
    for a in range(len(cameras)):
        for b in range(a + 1, len(cameras)):
            both = tuple((frames[a][k], frames[b][k]) for k in frames[a].keys() & frames[b].keys())
            if both:
                cameras[a], cameras[b] = with_agreeing_poses(cameras[a], cameras[b], ViewPairs(both))
    return cameras


def _detached(problem: RigProblem, left_out: Mapping[tuple[int, str], str], names: list[str]) -> RigProblem:
    """The problem without the views that are left out of the rig; each camera must still be in it."""
    apart = [
        np.array([(c, name) in left_out for name in own], dtype=bool) for c, own in enumerate(problem.names)
    ]
    found = problem.detached(apart)
    member = np.zeros((len(names), len(found.scale)), dtype=int)
    for row, observed in zip(member, found.observations, strict=True):
        row[observed.view[found.together[observed.view]]] = 1
    if not (member.sum(axis=1) > 0).all():
        lost = names[int(np.argmin(member.sum(axis=1)))]
        raise DegenerateGeometryError(f"no view connects camera {lost}: {_describe(left_out, names)}")
    refuse_apart(names, member @ member.T > 0)
    return found


def _views(problem: RigProblem, chosen: Sequence[NDArray[np.bool_]]) -> set[tuple[int, str]]:
    """The chosen views of each camera, (V_c,) bool, by the index of the camera and by name."""
    return {
        (c, view)
        for c, (own, which) in enumerate(zip(problem.names, chosen, strict=True))
        for view, is_in in zip(own, which, strict=True)
        if is_in
    }


def _named(left_out: Mapping[tuple[int, str], str]) -> dict[tuple[int, str], str]:
    """The views with a fault that has a name."""
    return {view: why for view, why in left_out.items() if not is_suspect(why)}


def _describe(left_out: Mapping[tuple[int, str], str], names: list[str]) -> str:
    """The views that are left out, by reason."""
    by_reason: dict[str, list[str]] = {}
    for (camera, view), why in left_out.items():
        by_reason.setdefault(why, []).append(f"{names[camera]}/{view}")
    parts = [f"{name_some(views)}: {why}" for why, views in by_reason.items()]
    n = len(left_out)
    return f"{n} view{'s' * (n > 1)} contradict{'s' * (n == 1)} the rig ({'; '.join(parts)})"


def _times(cameras: Mapping[str, Calibration]) -> list[Array] | None:
    """Times of each camera's views, if all are known."""
    times = [camera.points.view_times for camera in cameras.values()]
    known = [one for one in times if one is not None]
    return known if len(known) == len(times) else None


def with_delays(fit: RigFit, times: Sequence[Array] | None, names: Sequence[str]) -> RigFit:
    """The fit with the motion of the target and the delays of the cameras, if the frames show them.

    Delays are tried where they are the cause of the contradictions, stated times wherever they are known.
    """
    squares, degrees = scatter(fit)
    if not is_significant(squares, degrees):
        return fit
    found, _ = named_cause(fit, names)
    late = found is not None and found.cause is LATE_CAMERA
    best, most = fit, LEVEL
    for stated in ([times] if times is not None else []) + ([None] if late else []):
        trial = timed(fit, stated)
        if trial is not None:
            evidence = log_evidence(squares, scatter(trial)[0], degrees, len(names) - 1)
            if evidence > most:
                best, most = trial, evidence
    return best


def _covariance(fit: RigFit) -> Array | None:
    """Covariance of the shared unknowns if that of independent points is too small; else None."""
    squares, degrees = scatter(fit)
    return covariance_over_frames(fit) if is_significant(squares, degrees) else None


def _assembled(fit: RigFit, names: list[str], least: Array | None, stretched: Array | None) -> CameraRig:
    found = RigAssembly(fit, least, stretched)
    cameras = dict(zip(names, found.cameras, strict=True))
    none = dict.fromkeys((*POSE_NAMES, "baseline"), 0.0)
    first = next(iter(cameras.values()))
    return CameraRig(
        cameras,
        dict(zip(names, [_HERE, *found.poses], strict=True)),
        dict(zip(names, [none, *found.stds], strict=True)),
        found.covariance,
        _frames(fit.problem, names),
        delays=dict(zip(names[1:], found.delays, strict=False)),
        timed=fit.problem.motion is not None and fit.problem.motion.stated,
        rmse_px=found.rmse_px,
        max_px=max(camera.max_px for camera in found.cameras),
        converged=first.converged,
        stop_reason=first.stop_reason,
        iterations=fit.iterations,
    )


def _frames(problem: RigProblem, names: list[str]) -> dict[str, dict[str, str]]:
    """The views of each frame that several cameras saw, by the name that the first of them gave it."""
    frames: dict[int, dict[str, str]] = {}
    for camera, own, observed in zip(names, problem.names, problem.observations, strict=True):
        for view, frame in zip(own, observed.view.tolist(), strict=True):
            if problem.together[frame]:
                frames.setdefault(frame, {})[camera] = view
    return {next(iter(views.values())): views for views in frames.values()}


def of_two(rig: Rig, left: str, right: str) -> CameraRig:
    """A stereo rig as a rig of two cameras with names."""
    stds = [dict.fromkeys((*POSE_NAMES, "baseline"), 0.0), rig.std]
    left_out: dict[tuple[str, str], str] = {}
    for (a, b), why in rig.left_out.items():
        left_out |= {(left, a): why, (right, b): why}
    return CameraRig(
        {left: rig.left, right: rig.right},
        {left: _HERE, right: rig.pose},
        dict(zip((left, right), stds, strict=True)),
        rig.covariance,
        {a: {left: a, right: b} for a, b in rig.pairs},
        left_out,
        rmse_px=rig.rmse_px,
        max_px=rig.max_px,
        converged=rig.converged,
        stop_reason=rig.stop_reason,
        iterations=rig.iterations,
        warnings=rig.warnings,
        judgement=None if rig.judgement is None else (lambda _: rig.verdict),
        stereo=rig,
    )

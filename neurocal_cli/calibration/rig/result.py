"""A rig in pixels and world units from the adjusted, normalised one, with its covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.covariance import (
    coefficient_warnings,
    parameter_covariance,
    pose_std,
    with_scale,
)
from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.calibration.calibration import Calibration, NetworkRecord, StopReason, ViewResult
from neurocal_cli.calibration.lens_choice.monotonic_fit import told_of_fold, where_not_monotonic
from neurocal_cli.calibration.result import view_results
from neurocal_cli.calibration.rig.adjust import RigFit
from neurocal_cli.calibration.rig.rig import Rig, named_std
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array, euler_jacobian
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.observations.target import std_of_scale


def assembled(fit: RigFit, names: Sequence[str], found: Covariance) -> Rig:
    """An adjusted rig in pixels and world units.

    `found` is the covariance of all shared unknowns, normalised, with further ones after them.
    """
    problem, state, columns = fit.problem, fit.state, fit.state.columns
    first = problem.calibrations[0]
    scale_std = std_of_scale(first.points, first.target)
    first_pose, *poses = problem.poses(state)
    covariance = _of_poses(fit, found, poses, scale_std)
    own = [covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(poses))]
    stds = [named_std(block, pose.t) for block, pose in zip(own, poses, strict=True)]
    of_points, delays = [], {}
    for side, observed in enumerate(problem.observations):
        errors = point_residuals(observed.views, problem.camera(state, side)) * observed.views.pixel_scale
        of_points.append((errors**2).sum(axis=1))
    if state.timed:
        variances = np.diagonal(_shared_block(fit, found, np.concatenate(columns.delays)))
        known = zip(state.delay[1:].tolist(), np.sqrt(variances).tolist(), strict=True)
        delays = dict(zip(names[1:], known, strict=True))
    cameras = [_calibration(fit, found, side, one, scale_std) for side, one in enumerate(of_points)]
    several = [{names[k]: view for k, view in views.items()} for views in problem.views if len(views) > 1]
    return Rig(
        dict(zip(names, cameras, strict=True)),
        dict(zip(names, [first_pose, *poses], strict=True)),
        dict(zip(names, [dict.fromkeys((*POSE_NAMES, "baseline"), 0.0), *stds], strict=True)),
        covariance,
        {next(iter(views.values())): views for views in several},
        delays=delays,
        timed=problem.motion is not None and problem.motion.stated,
        rmse_px=float(np.sqrt(np.concatenate(of_points).mean())),
        max_px=max(camera.max_px for camera in cameras),
        converged=cameras[0].converged,
        stop_reason=cameras[0].stop_reason,
        iterations=fit.iterations,
    )


def _of_poses(fit: RigFit, found: Covariance, poses: Sequence[Pose], scale_std: float) -> Array:
    """Covariance of the angles and translations of all poses but the first."""
    n = len(poses)
    J, followed = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
    for k, pose in enumerate(poses):
        J[k, :3, k, :3] = euler_jacobian(pose.R)
        J[k, 3:, k, 3:] = np.eye(3) * fit.problem.unit
        followed[k, 3:] = pose.t  # the scale of the target
    flat = J.reshape(6 * n, 6 * n)
    block = flat @ _shared_block(fit, found, np.concatenate(fit.state.columns.rigs)) @ flat.T
    return np.asarray(block + scale_std**2 * np.outer(followed, followed))


def _shared_block(fit: RigFit, found: Covariance, columns: NDArray[np.intp]) -> Array:
    """Covariance of some of the shared parameters, 0 for given ones."""
    free = fit.free[columns]
    return np.where(np.outer(free, free), found.shared[np.ix_(columns, columns)], 0.0)


def _calibration(fit: RigFit, found: Covariance, side: int, squares: Array, scale_std: float) -> Calibration:
    """One camera after the common bundle adjustment, with the squared errors of its points [px^2]."""
    problem, views = fit.problem, fit.problem.observations[side].views
    given, intrinsics = problem.calibrations[side], intrinsics_of(fit, side)
    alone = [camera.stop_reason for camera in problem.calibrations if not camera.converged]
    together = StopReason.CONVERGED if fit.converged else StopReason.MAX_ITERATIONS
    reason = alone[0] if alone else together.value
    changes: dict[str, Any] = {}
    if fit.free[fit.state.columns.cameras[side]].any():
        changes = _intrinsic_changes(fit, found, side, intrinsics)
    R, t = problem.world_poses(fit.state, side)
    stds = with_scale(_pose_stds(fit, found, side, R), t, scale_std)
    results = view_results(views, R, t, stds, squares)
    rmse = float(np.sqrt(squares.mean()))
    return replace(
        given,
        views=results,
        rmse_px=rmse,
        max_px=float(np.sqrt(squares.max())),
        converged=reason == StopReason.CONVERGED.value,
        stop_reason=reason,
        network=_network(given.network, intrinsics, results, rmse, fit.iterations),
        judgement=None,
        **changes,
    )


def _intrinsic_changes(fit: RigFit, found: Covariance, side: int, intrinsics: Intrinsics) -> dict[str, Any]:
    given, camera = fit.problem.calibrations[side], fit.state.cameras[side]
    block, std = parameter_covariance(
        intrinsics,
        camera.model,
        _shared_block(fit, found, fit.state.columns.cameras[side]),
        fit.problem.observations[side].views.pixel_scale,
        given.fixed,
        given.square_pixels,
    )
    names = list(std)
    free = [k for k, name in enumerate(names) if name not in given.fixed]
    before: tuple[str, ...] = (told_of_fold(camera.model),)
    chosen = bool(given.lens_choice)
    if given.std.keys() >= std.keys():
        alone = Distortion(camera.model, given.distortion)
        before += coefficient_warnings(alone, given.std, chosen)
    now = coefficient_warnings(camera.distortion, std, chosen)
    return {
        "intrinsics": intrinsics,
        "std": std,
        "distortion": camera.k,
        "covariance": block[np.ix_(free, free)],
        "covariance_names": tuple(names[k] for k in free),
        "warnings": (*now, *(text for text in given.warnings if text not in before)),
    }


def _pose_stds(fit: RigFit, found: Covariance, side: int, R: Array) -> Array:
    """Standard deviations of the angles and translations of the views, (V_c, 6)."""
    problem, view = fit.problem, fit.problem.observations[side].view
    of_rig, by_rig, by_pose = problem.pose_steps(fit.state, side)
    covariance = by_pose @ found.own[view] @ np.swapaxes(by_pose, 1, 2)
    if of_rig.size:
        mixed = by_rig @ found.cross[view][:, of_rig] @ np.swapaxes(by_pose, 1, 2)
        covariance = covariance + mixed + np.swapaxes(mixed, 1, 2)
        covariance += by_rig @ _shared_block(fit, found, of_rig) @ np.swapaxes(by_rig, 1, 2)
    centre = (R @ problem.centre[view][..., None])[..., 0]
    return pose_std(R, centre, problem.scale[view], covariance)


def non_monotonic_sides(fit: RigFit) -> list[int]:
    """Cameras whose distortion is not monotonic inside the image after the common bundle adjustment."""
    return [
        side
        for side, (camera, given) in enumerate(zip(fit.state.cameras, fit.problem.calibrations, strict=True))
        if fit.free[fit.state.columns.cameras[side]].any()
        and where_not_monotonic(camera.distortion, intrinsics_of(fit, side).A, given.points) is not None
    ]


def intrinsics_of(fit: RigFit, side: int) -> Intrinsics:
    """Intrinsic parameters of one camera [px]; given entries of A keep their exact values."""
    given = fit.problem.calibrations[side]
    estimated = fit.free[fit.state.columns.cameras[side]][:5].copy()
    if not estimated.any():
        return given.intrinsics
    estimated[2] |= given.square_pixels
    views, entries = fit.problem.observations[side].views, fit.state.cameras[side].entries[0].copy()
    entries *= views.pixel_scale
    entries[3:] += views.pixel_centre
    A = intrinsic_matrix(np.where(estimated, entries, given.K[ENTRIES]))
    if not estimated[1] and not given.intrinsics.skewed:
        return Intrinsics(A[0, 0], A[1, 1], A[0, 2], A[1, 2])
    return Intrinsics.from_matrix(A)


def _network(
    record: NetworkRecord | None,
    intrinsics: Intrinsics,
    views: Mapping[str, ViewResult],
    rmse: float,
    iterations: int,
) -> NetworkRecord | None:
    """The network's weights for the refined camera, so that P = S1 W V S2 holds."""
    if record is None or not views.keys() <= record.S2.keys():
        return record
    V = {}
    for name, view in views.items():
        S2 = record.S2[name]
        centre = -S2[:3, 3] / S2[0, 0]
        V[name] = np.column_stack([view.pose.R, (view.pose.R @ centre + view.pose.t) * S2[0, 0]])
    return replace(
        record,
        W=np.asarray(np.linalg.solve(record.S1, intrinsics.A)),
        V=V,
        refine_iterations=record.refine_iterations + iterations,
        rmse_after=rmse,
    )

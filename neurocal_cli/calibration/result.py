"""From a normalised solution to a calibration in pixels and world units, with its covariance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.board.camera_covariance import CameraCovariance, CameraSeen, camera_covariance
from neurocal_cli.adjustment.covariance import (
    coefficient_warnings,
    covariance_by_camera,
    entry_covariance,
    parameter_covariance,
    pose_std,
    with_scale,
)
from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.adjustment.observability import refuse_undetermined
from neurocal_cli.adjustment.problem import intrinsic_matrix, normalised, translations
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.calibration import Calibration, NetworkRecord, Rejected, StopReason, ViewResult
from neurocal_cli.calibration.lens_choice.given_model import undetermined_coefficients
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.network.local_minima import second_poses
from neurocal_cli.observations.target import scale_of, std_of_scale

_XI = 5  # index of xi, after A's five entries
_TOLD = 0.1  # width of the range of xi from which on a warning is given
_PROBABLE = 0.01  # odds from which on a second pose is told
_LEAST = 0.04  # probability with which it is in the std, so that it is never more than five of them away
_NAMED = 5  # number of outliers that the warning names


def calibration_of(
    solution: Solution, rejected: Rejected, *, method: str, trainer: str, seed: int, name: str
) -> Calibration:
    """Convert a solution to pixels and world units, with standard deviations and warnings.

    Raises `DegenerateGeometryError` if the points do not determine the camera.
    """
    problem, views, state = solution.problem, solution.problem.views, solution.state
    known = _covariance_of(solution)
    refuse_undetermined(problem, state, known.plain)
    A = problem.matrix(state.entries[0])
    if problem.type != 3 and not problem.free[1]:
        intrinsics = Intrinsics(A[0, 0], A[1, 1], A[0, 2], A[1, 2])
    else:
        intrinsics = problem.intrinsics or Intrinsics.from_matrix(A)
    entries = _entries(solution, known)
    fixed = problem.fixed if solution.ambiguity is None else problem.fixed - {"xi"}
    block, std = parameter_covariance(
        intrinsics, problem.distortion.model, entries, views.pixel_scale, fixed, problem.square
    )
    squared = (solution.residuals**2).sum(axis=1) * views.pixel_scale**2
    rmse = float(np.sqrt(squared.mean()))
    free = tuple(parameter for parameter in std if parameter not in fixed)
    places = [n for n, parameter in enumerate(std) if parameter in free]
    reason = StopReason.CONVERGED if solution.record.certain else StopReason.NO_AGREEMENT
    if not solution.adjusted.converged:
        reason = StopReason.MAX_ITERATIONS
    chosen = solution.model_errors is not None
    found, second = _with_second_poses(solution, _view_results(solution, known.found, squared))
    return Calibration(
        intrinsics=intrinsics,
        std=std,
        fixed=fixed,
        square_pixels=problem.square,
        views=found,
        second_poses=second,
        points=problem.points,
        type=problem.type,
        method=method,
        trainer=trainer,
        seed=seed,
        converged=reason is StopReason.CONVERGED,
        stop_reason=reason.value,
        rmse_px=rmse,
        max_px=float(np.sqrt(squared.max())),
        covariance=block[np.ix_(places, places)],
        covariance_names=free,
        distortion_model=problem.distortion.model,
        distortion=state.k,
        network=_network_record(solution, rmse),
        straight_lines=solution.straight_lines,
        camera_name=name,
        rejected=rejected,
        target=solution.target,
        target_stretched=known.stretched,
        lens_choice=solution.model_errors or {},
        warnings=(
            *coefficient_warnings(state.distortion, std, chosen or solution.ambiguity is not None),
            *_lens_warnings(solution),
            *_view_warnings(solution),
            *_rejection_warnings(rejected, len(problem.points)),
        ),
    )


# Poses that the points do not determine have an infinite std already.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def with_given_covariance(found: Calibration, given: Calibration) -> Calibration:
    """A calibration of type 3 whose poses have the uncertainty of the given camera, as far as it is known."""
    names, covariance = given.known_covariance
    if not names or not np.isfinite(covariance).all():
        return found
    views = arrange(found.points)
    state = found.state(views.names)
    entries = entry_covariance(found.intrinsics, state.model, names, covariance, views.pixel_scale)
    block = covariance_by_camera(views, normalised(state, views), entries)
    added = pose_std(state.R, (state.R @ views.centre[..., None])[..., 0], views.scale, block)
    results = dict(found.views)
    for name, more in zip(views.names, added.tolist(), strict=True):
        std = found.views[name].std
        both = {one: float(np.hypot(std[one], by)) for one, by in zip(POSE_NAMES, more, strict=True)}
        results[name] = replace(found.views[name], std=both)
    return replace(found, views=results, given_covariance=covariance, given_names=names)


def _covariance_of(solution: Solution) -> CameraCovariance:
    """The covariance of camera and poses, normalised."""
    return camera_covariance(
        CameraSeen(
            solution.minimum,
            solution.problem.points,
            solution.target,
            tuple(solution.model_errors or ()),
            solution.shared,
            solution.by_prior,
            solution.target_kept,
            solution.covariance if solution.target is None else None,
        )
    )


def _entries(solution: Solution, known: CameraCovariance) -> Array:
    """(5 + K, 5 + K) covariance of A's entries and the distortion coefficients, normalised; 0 if given.

    It includes the spread of other cameras that explain the points equally well (`ambiguity`).
    """
    free, ambiguity = solution.problem.free_camera, solution.ambiguity
    entries = np.zeros((len(free), len(free)))
    entries[np.ix_(free, free)] = known.entries
    if ambiguity is None:
        return entries
    free[_XI] = True
    inflation = known.entries[0, 0] / known.plain.shared[0, 0]  # for views that are not independent
    entries[np.ix_(free, free)] = ambiguity.widened(entries[np.ix_(free, free)], free, max(inflation, 1.0))
    return entries


def _view_results(solution: Solution, cov: Covariance, squared: Array) -> dict[str, ViewResult]:
    """Poses in world units with their standard deviations, and each view's unweighted reprojection error."""
    problem, state = solution.problem, solution.state
    views, R = problem.views, state.R
    centre = (R @ views.centre[..., None])[..., 0]
    t = translations(views, state)
    if problem.poses is not None:
        R = np.stack([problem.poses[name].R for name in views.names])
        t = np.stack([problem.poses[name].t for name in views.names])
    std = np.zeros((len(R), 6))
    if problem.free_poses:
        std = with_scale(
            pose_std(R, centre, views.scale, cov.own), t, std_of_scale(problem.points, solution.target)
        )
    return view_results(views, R, t, std, squared, not problem.free_poses)


def view_results(
    views: Views, R: Array, t: Array, std: Array, squared: Array, given: bool = False
) -> dict[str, ViewResult]:
    """Poses in world units, their std (V, 6), and the reprojection error by the points' squared ones (N,)."""
    rms = np.sqrt(np.add.reduceat(squared, views.first) / views.counts)
    R.setflags(write=False)
    t.setflags(write=False)
    rows = zip(views.names, R, t, std.tolist(), views.counts.tolist(), rms.tolist(), strict=True)
    return {
        name: ViewResult(Pose.exact(R_k, t_k), dict(zip(POSE_NAMES, sigma, strict=True)), n, r, given)
        for name, R_k, t_k, sigma, n, r in rows
    }


def _with_second_poses(
    solution: Solution, found: dict[str, ViewResult]
) -> tuple[dict[str, ViewResult], dict[str, ViewResult]]:
    """Views with the probability of their poses, and second poses of flat targets that are probable, too.

    Seen from afar, a flat target tilted the other way looks nearly the same (Schweighofer and Pinz 2006). For
    normal noise of the variance s^2, a second pose with the squared error c_2 instead of c_1 is
    exp(-(c_2 - c_1) / (2 s^2)) times as probable. The variance about the reported pose covers both.
    """
    problem, adjusted = solution.problem, solution.adjusted
    seconds = second_poses(problem, adjusted)
    which, posed = seconds.views, seconds.posed
    if not which.size or solution.spare_equations <= 0:
        return found, {}
    variance = max(float(adjusted.cost.sum()) / solution.spare_equations, 1e-300)
    odds = np.exp(-0.5 * np.maximum(posed.cost - adjusted.cost[which], 0.0) / variance)
    views = problem.views.subset(which)
    t = translations(views, posed.state)
    squared = (point_residuals(views, posed.state) ** 2).sum(axis=1) * views.pixel_scale**2
    rms = np.sqrt(np.add.reduceat(squared, views.first) / views.counts)
    second: dict[str, ViewResult] = {}
    for k in np.flatnonzero(odds > _PROBABLE):
        name, p = views.names[k], float(odds[k] / (1 + odds[k]))
        other = Pose.exact(posed.state.R[k], t[k])
        one = found[name]
        turned = (other.euler - one.pose.euler + np.pi) % (2 * np.pi) - np.pi
        apart = np.concatenate([turned, other.t - one.pose.t])
        own = np.array([one.std[key] for key in POSE_NAMES])
        if (np.abs(apart) < own).all():  # seen from the front, both are one pose
            continue
        std = dict(zip(POSE_NAMES, np.hypot(own, np.sqrt(max(p, _LEAST)) * apart).tolist(), strict=True))
        found[name] = replace(one, std=std, probability=1 - p)
        second[name] = ViewResult(other, {}, one.n_points, float(rms[k]), probability=p)
    return found, second


def _network_record(solution: Solution, rmse: float) -> NetworkRecord:
    views, record, state = solution.problem.views, solution.record, solution.state
    px, n = views.pixel_scale, len(views.index)
    return NetworkRecord(
        W=intrinsic_matrix(state.entries[0]),
        V=dict(zip(views.names, np.concatenate([state.R, state.t[..., None]], axis=2), strict=True)),
        S1=views.S1,
        S2=dict(zip(views.names, views.S2, strict=True)),
        starts=record.starts,
        agreed=int(record.agreed.min()),
        iterations=record.iterations,
        refine_iterations=solution.adjusted.iterations,
        loss=float(np.sqrt(record.squares / n)) * px,
        rmse_before=float(np.sqrt(record.before / n)) * px,
        rmse_after=rmse,
        curve=tuple((record.curve * px).tolist()),
    )


def _lens_warnings(solution: Solution) -> Iterator[str]:
    """Warn of a distortion that the points determine in part."""
    problem, ambiguity = solution.problem, solution.ambiguity
    model = problem.distortion.model
    if ambiguity is not None and not np.diff(ambiguity.range)[0] < _TOLD:
        first, last = ambiguity.range
        with_it = "alpha_u, alpha_v and alpha" if model == "double_sphere" else "alpha_u, alpha_v, k1 and k2"
        yield (
            f"xi and the parameters correlated with it ({with_it}) are poorly determined: values of xi from "
            f"{first:.2f} to {last:.2f} fit equally well; the projection is nearly the same for all of them, "
            "and the verdict gives its std"
        )
    if model == "rich":
        return
    if problem.penalty is not None:
        from neurocal_cli.calibration.lens_choice.monotonic_fit import told_of_fold

        yield told_of_fold(model)
    # The standard deviations of eucm do not show it: without distortion alpha is 0, and beta has no effect.
    doubtful = not solution.adjusted.converged or model == "eucm"
    if doubtful and solution.model_errors is None and problem.free_distortion:
        yield from filter(None, [undetermined_coefficients(problem, solution.adjusted)])


def _view_warnings(solution: Solution) -> Iterator[str]:
    """Warn of errors that last from view to view, and of points with contradictory units."""
    n_views, repeated = solution.problem.views.n_views, solution.repeated
    if repeated.n_groups < repeated.n_poses:
        yield (
            "the points' errors last from view to view, as in a video; the "
            f"{n_views} views count as {max(repeated.worth * n_views, 1.0):.0f}"
        )
    yield from filter(None, [scale_of(solution.problem.points).contradiction])


def _rejection_warnings(rejected: Rejected, kept: int) -> Iterator[str]:
    """Name the views left out with their reasons, and the first outliers by line and id."""
    for name, reason in rejected.views.items():
        yield f"view {name!r} is left out: {reason}"
    points = rejected.points
    if points is None:
        return
    single = np.flatnonzero([points.view_names[v] not in rejected.views for v in points.view_index])
    if single.size:
        places = []
        for row in single[:_NAMED]:
            label = "" if points.point is None else f" ({points.point[row]})"
            places.append(f"{points.place(int(row))}{label}")
        more = f" and {single.size - _NAMED} more, listed in the calibration" if single.size > _NAMED else ""
        share = f"{single.size} of {kept + len(rejected)} points"
        yield f"{share} are outliers and are left out: {', '.join(places)}{more}"

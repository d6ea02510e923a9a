"""From the normalised solution to a calibration in pixels and world units, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.covariance import Covariance, covariance
from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.observability import refuse_undetermined
from neurocal_cli.bundle_adjustment.outlier_views import seen_from_behind
from neurocal_cli.bundle_adjustment.parameter_uncertainty import (
    parameter_covariance,
    parameter_warnings,
    pose_std,
)
from neurocal_cli.bundle_adjustment.problem import Known, intrinsic_matrix
from neurocal_cli.bundle_adjustment.residual_correlation import point_residuals
from neurocal_cli.bundle_adjustment.units import translations
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.calibrating.fitting import Fit
from neurocal_cli.calibration import Calibration, NetworkRecord, Rejected, StopReason, ViewResult
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["assemble"]

_NAMED = 5  # wrong points that the warning names


def assemble(fit: Fit, rejected: Rejected, *, method: str, trainer: str, seed: int, name: str) -> Calibration:
    """Put a fit into the user's units.

    Raises
    ------
    DegenerateGeometryError
        The points leave the answer open.
    """
    job = fit.job
    found = _Assembly(
        fit.points, job.views, job.known, fit.solution, fit.lens_choice is not None
    ).calibration(method, trainer, seed, name)
    return replace(
        found,
        rejected=rejected,
        lens_choice=fit.lens_choice or {},
        straight_lines=fit.straight_lines,
        warnings=(
            *found.warnings,
            *_corner_warning(job),
            *_mirrored_warning(seen_from_behind(job.views, fit.solution.adjusted.state)),
            *_rejection_warnings(rejected, len(fit.points)),
        ),
    )


def _corner_warning(job: Job) -> tuple[str, ...]:
    """Where no point is, a lens is anyone's guess."""
    if job.restraint is None:
        return ()
    return (
        f"the points do not reach the image's corners, where the distortion {job.known.lens.model} that fits "
        "them best folds back; the best one that does not is given, and what it says of the corners is a "
        "guess: add views that show the board there",
    )


def _mirrored_warning(views: list[str]) -> tuple[str, ...]:
    """A flat target that is mirrored gives the right camera, but a wrong pose."""
    if not views:
        return ()
    names = ", ".join(map(repr, views[:_NAMED])) + (
        f" and {len(views) - _NAMED} more" * (len(views) > _NAMED)
    )
    return (
        f"the target is seen from its other side in {names}, as if mirrored: the poses of these views are "
        "wrong; check the order of their points",
    )


def _rejection_warnings(rejected: Rejected, kept: int) -> tuple[str, ...]:
    """Name wrong views, and the first of the wrong points by their line and id."""
    lines = [f"view {name!r} is left out: {reason}" for name, reason in rejected.views.items()]
    points = rejected.points
    if points is None:
        return tuple(lines)
    single = np.flatnonzero([points.view_names[v] not in rejected.views for v in points.view_index])
    if single.size:
        places = []
        for row in single[:_NAMED]:
            label = "" if points.point is None else f" ({points.point[row]})"
            places.append(f"{points.place(int(row))}{label}")
        more = f" and {single.size - _NAMED} more, listed in the calibration" if single.size > _NAMED else ""
        share = f"{single.size} of {kept + len(rejected)} points"
        lines.append(f"{share} contradict the others and are left out: {', '.join(places)}{more}")
    return tuple(lines)


@dataclass(frozen=True, eq=False)
class _Assembly:
    """Turns the normalised solution into a calibration in pixels and world units."""

    points: Correspondences
    views: Views
    known: Known
    solution: Solution
    lens_chosen: bool

    def calibration(self, method: str, trainer: str, seed: int, name: str) -> Calibration:
        views, known, solution = self.views, self.known, self.solution
        adjusted = solution.adjusted
        cov = covariance(
            adjusted.normal, known.free_camera, known.free_poses, views.n_equations, solution.shared
        )
        refuse_undetermined(views, known, adjusted.state, cov)
        A = known.matrix(adjusted.state.entries[0], views)
        intrinsics = known.intrinsics or Intrinsics.from_matrix(A)
        if known.type != 3 and not known.free[1]:
            intrinsics = Intrinsics(A[0, 0], A[1, 1], A[0, 2], A[1, 2])
        block, std = self._camera_covariance(intrinsics, cov)
        results, rmse, largest = self._views(cov)
        free = [n for n, name in enumerate(std) if name not in known.fixed]
        reason = StopReason.CONVERGED
        if not adjusted.converged:
            reason = StopReason.MAX_ITERATIONS
        elif not solution.tally.certain:
            reason = StopReason.NO_AGREEMENT
        return Calibration(
            intrinsics=intrinsics,
            std=std,
            fixed=known.fixed,
            views=results,
            points=self.points,
            type=known.type,
            method=method,
            trainer=trainer,
            seed=seed,
            converged=reason is StopReason.CONVERGED,
            stop_reason=reason.value,
            rmse_px=rmse,
            max_px=largest,
            covariance=block[np.ix_(free, free)],
            covariance_names=tuple(np.array(list(std))[free].tolist()),
            distortion_model=known.lens.model,
            distortion=adjusted.state.k,
            network=self._network(rmse),
            camera_name=name,
            warnings=parameter_warnings(
                intrinsics, Distortion(known.lens.model, adjusted.state.k), std, self.lens_chosen
            ),
        )

    def _camera_covariance(self, intrinsics: Intrinsics, cov: Covariance) -> tuple[Array, dict[str, float]]:
        """Covariance of the intrinsic parameters and the lens's coefficients, and their std; 0 if given."""
        known = self.known
        free = np.flatnonzero(known.free_camera)
        entries = np.zeros((len(known.free_camera),) * 2)
        entries[np.ix_(free, free)] = cov.entries
        return parameter_covariance(
            intrinsics, known.lens.model, entries, self.views.pixel_scale, known.fixed
        )

    def _views(self, cov: Covariance) -> tuple[dict[str, ViewResult], float, float]:
        """Poses in world units with their std, and the pixel error (3), unweighted."""
        views, known = self.views, self.known
        R = self.solution.adjusted.state.R
        centre = (R @ views.centre[..., None])[..., 0]
        t_world = translations(views, self.solution.adjusted.state)
        if known.poses is not None:
            R = np.stack([known.poses[name].R for name in views.names])
            t_world = np.stack([known.poses[name].t for name in views.names])
        std = pose_std(R, centre, views.scale, cov.poses)
        squared = self._squared_errors()
        rms = np.sqrt(np.add.reduceat(squared, views.first) / views.counts)
        R.setflags(write=False)
        t_world.setflags(write=False)
        results = {
            name: ViewResult(
                Pose.exact(*pose), dict(zip(POSE_NAMES, sigma, strict=True)), n, r, not known.free_poses
            )
            for name, pose, sigma, n, r in zip(
                views.names,
                zip(R, t_world, strict=True),
                std.tolist(),
                views.counts.tolist(),
                rms.tolist(),
                strict=True,
            )
        }
        return results, float(np.sqrt(squared.mean())), float(np.sqrt(squared.max()))

    def _squared_errors(self) -> Array:
        """Squared pixel error of each point, sorted by view; (N,)."""
        errors = point_residuals(self.views, self.solution.adjusted.state)
        return np.asarray((errors**2).sum(axis=1) * self.views.pixel_scale**2)

    def _network(self, rmse: float) -> NetworkRecord:
        views, tally = self.views, self.solution.tally
        state = self.solution.adjusted.state
        px, n = views.pixel_scale, len(views.index)
        return NetworkRecord(
            W=intrinsic_matrix(state.entries[0]),
            V={name: np.column_stack([state.R[k], state.t[k]]) for k, name in enumerate(views.names)},
            S1=views.S1,
            S2={name: views.S2(k) for k, name in enumerate(views.names)},
            starts=tally.starts,
            agreed=int(tally.agreed.min()),
            iterations=tally.iterations,
            refine_iterations=tally.refinements,
            loss=float(np.sqrt(tally.squares / n)) * px,
            rmse_before=float(np.sqrt(tally.before / n)) * px,
            rmse_after=rmse,
            curve=tuple((tally.curve * px).tolist()),
        )

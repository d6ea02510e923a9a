"""Assembly of a `Rig` in pixels and world units from the adjusted, normalised one, with its covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.parameter_uncertainty import (
    parameter_covariance,
    parameter_warnings,
    pose_std,
    with_scale,
)
from neurocal_cli.bundle_adjustment.point_batches import PointBatches
from neurocal_cli.bundle_adjustment.problem import intrinsic_matrix
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, residuals
from neurocal_cli.calibration import Calibration, NetworkRecord, StopReason, ViewResult
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.distortion.monotonic_fit import where_not_monotonic
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array, euler_jacobian
from neurocal_cli.least_squares.normal_equations import solve_scaled
from neurocal_cli.least_squares.schur_complement import SchurCovariance, schur_covariance
from neurocal_cli.stereo.adjust import RigFit
from neurocal_cli.stereo.open_covariance import covariance_of_choice
from neurocal_cli.stereo.pair_covariance import not_smaller
from neurocal_cli.stereo.reprojection import Observations, rig_jacobian
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.target import scale_of

_SINGULAR = 1e-13  # a smaller eigenvalue of a normal matrix with unit diagonal is rounding


def assemble_rig(
    fit: RigFit,
    left_out: Mapping[tuple[str, str], str],
    least: Array | None = None,
    stretched: Array | None = None,
) -> Rig:
    """Convert an adjusted rig to the user's units.

    Parameters
    ----------
    fit : RigFit
    left_out : dict of str by (left name, right name)
    least : (f, f) array, optional
        Lower bound of the covariance of the free shared parameters, normalised.
    stretched : (f, f) array, optional
        Covariance to add because the print may be stretched.

    Raises
    ------
    DegenerateGeometryError
        The points do not determine the parameters.
    """
    return _RigAssembly(fit, least, stretched).rig(left_out)


def non_monotonic_sides(fit: RigFit) -> list[int]:
    """Cameras whose distortion is not monotonic inside the image after the common bundle adjustment."""
    problem, state = fit.problem, fit.state
    found = []
    for side, own in enumerate(state.columns.cameras):
        camera, observed, given = state.cameras[side], problem.observations[side], problem.calibrations[side]
        estimated = fit.free[own]
        if not estimated.any():
            continue
        A = _intrinsics(given, camera, observed, estimated[:5]).A if estimated[:5].any() else given.K
        if where_not_monotonic(camera.distortion, A, given.points) is not None:
            found.append(side)
    return found


class _RigAssembly:
    def __init__(self, fit: RigFit, least: Array | None, stretched: Array | None) -> None:
        self.fit, self.problem, self.calibrations = fit, fit.problem, fit.problem.calibrations
        self.state, self.columns = fit.state, fit.state.columns
        self.scale_std = scale_of(self.calibrations[0].points).std
        self.shared = np.flatnonzero(fit.free)
        inverse = schur_covariance(fit.normal, self.shared, self.columns.pose)
        if not inverse.smallest > _SINGULAR:
            raise DegenerateGeometryError(
                "the points do not determine the rig and both cameras (the normal matrix is singular); "
                "spread them in depth, or give known parameters (--no-skew, --left-intrinsics, "
                "--right-intrinsics)"
            )
        self.covariance = replace(
            inverse,
            shared=fit.variance * inverse.shared,
            own=fit.variance * inverse.own,
            cross=fit.variance * inverse.cross,
        )
        if least is not None:
            self.covariance = _widened(self.covariance, not_smaller(self.covariance.shared, least))
        for more in (covariance_of_choice(fit), stretched):
            if more is not None:
                self.covariance = _widened(self.covariance, self.covariance.shared + more)

    def rig(self, left_out: Mapping[tuple[str, str], str]) -> Rig:
        """The rig in pixels and world units, with the pairs left out and why."""
        state, frames = self.state, self.problem.frames
        errors = [
            _squared_errors(observed, state.camera_with_poses(side, frames, observed))
            for side, observed in enumerate(self.problem.observations)
        ]
        sums = [
            observed.batches.sum_by_view(e.sum(axis=1))
            for observed, e in zip(self.problem.observations, errors, strict=True)
        ]
        reason = self._stop_reason()
        left, right = (
            self._calibration(side, sums[side], float(errors[side].max()), reason) for side in (0, 1)
        )
        pose = Pose(state.R, state.t * frames.unit)
        block, std = self._rig_covariance(pose)
        n_points = sum(observed.n_points for observed in self.problem.observations)
        pairs = self.problem.pairs
        return Rig(
            left,
            right,
            pose,
            std,
            block,
            tuple(pairs[k] for k in np.argsort(self.problem.paired)),
            dict(left_out),
            rmse_px=float(np.sqrt(sum(s.sum() for s in sums) / n_points)),
            max_px=float(np.sqrt(max(e.max() for e in errors))),
            converged=reason == StopReason.CONVERGED.value,
            stop_reason=reason,
            iterations=self.fit.iterations,
        )

    def _stop_reason(self) -> str:
        for calibration in self.calibrations:
            if not calibration.converged:
                return calibration.stop_reason
        return (StopReason.CONVERGED if self.fit.converged else StopReason.MAX_ITERATIONS).value

    def _rig_covariance(self, pose: Pose) -> tuple[Array, dict[str, float]]:
        """Covariance of the rig's angles and translation, and standard deviations, also of the baseline."""
        J = np.zeros((7, 6))
        J[:3, :3] = euler_jacobian(pose.R)
        J[3:6, 3:] = np.eye(3) * self.problem.frames.unit
        baseline = np.linalg.norm(pose.t)
        J[6, 3:] = self.problem.frames.unit * (pose.t / baseline if baseline > 0 else 0.0)
        block = J @ self._shared_block(self.columns.rig) @ J.T
        followed = np.array([0.0, 0.0, 0.0, *pose.t, baseline])  # the scale of the target
        block += self.scale_std**2 * np.outer(followed, followed)
        std = np.sqrt(np.maximum(np.diagonal(block), 0.0)).tolist()
        return block[:6, :6], dict(zip((*POSE_NAMES, "baseline"), std, strict=True))

    def _shared_block(self, columns: NDArray[np.intp]) -> Array:
        """Covariance of some of the shared parameters, 0 for given ones."""
        place = {int(column): k for k, column in enumerate(self.shared)}
        known = [k for k, column in enumerate(columns.tolist()) if column in place]
        block = np.zeros((len(columns), len(columns)))
        rows = [place[int(columns[k])] for k in known]
        block[np.ix_(known, known)] = self.covariance.shared[np.ix_(rows, rows)]
        return block

    def _calibration(self, side: int, squares: Array, largest: float, reason: str) -> Calibration:
        """One camera after the common bundle adjustment."""
        given, observed = self.calibrations[side], self.problem.observations[side]
        camera = self.state.cameras[side]
        columns = self.columns.cameras[side]
        estimated = self.fit.free[columns]
        intrinsics = given.intrinsics
        if estimated[:5].any():
            intrinsics = _intrinsics(given, camera, observed, estimated[:5])
        changes: dict[str, Any] = {}
        if estimated.any():
            changes = self._intrinsic_changes(given, intrinsics, camera, observed, columns)
        rms = np.sqrt(squares / observed.batches.counts)
        R, t = self._world_poses(side)
        stds = with_scale(self._pose_stds(side, R), t, self.scale_std)
        R.setflags(write=False)
        t.setflags(write=False)
        views = {
            name: ViewResult(Pose.exact(R[k], t[k]), dict(zip(POSE_NAMES, stds[k].tolist(), strict=True)),
                             int(observed.batches.counts[k]), float(rms[k]))
            for k, name in enumerate(self.problem.names[side])
        }  # fmt: skip
        rmse = float(np.sqrt(squares.sum() / observed.n_points))
        return replace(
            given,
            views=views,
            rmse_px=rmse,
            max_px=float(np.sqrt(largest)),
            converged=reason == StopReason.CONVERGED.value,
            stop_reason=reason,
            network=_network(given.network, intrinsics, views, rmse, self.fit.iterations),
            judgement=None,
            **changes,
        )

    def _intrinsic_changes(
        self,
        given: Calibration,
        intrinsics: Intrinsics,
        camera: CameraState,
        observed: Observations,
        columns: NDArray[np.intp],
    ) -> dict[str, Any]:
        block, std = parameter_covariance(
            intrinsics, camera.model, self._shared_block(columns), observed.pixel_scale, given.fixed
        )
        names = list(std)
        free = [k for k, name in enumerate(names) if name not in given.fixed]
        before: tuple[str, ...] = ()
        chosen = bool(given.lens_choice)
        if given.std.keys() >= std.keys():
            alone = Distortion(camera.model, given.distortion)
            before = parameter_warnings(given.intrinsics, alone, given.std, chosen)
        now = parameter_warnings(intrinsics, camera.distortion, std, chosen)
        return {
            "intrinsics": intrinsics,
            "std": std,
            "distortion": camera.k,
            "covariance": block[np.ix_(free, free)],
            "covariance_names": tuple(names[k] for k in free),
            "warnings": (*now, *(text for text in given.warnings if text not in before)),
        }

    def _world_poses(self, side: int) -> tuple[Array, Array]:
        """Poses of the views in their camera, in world units."""
        frames, observed = self.problem.frames, self.problem.observations[side]
        state = self.state.camera_with_poses(side, frames, observed)
        scale, centre = frames.scale[observed.view][:, None], frames.centre[observed.view]
        return state.R, state.t * scale - (state.R @ centre[..., None])[..., 0]

    def _pose_stds(self, side: int, R: Array) -> Array:
        """Standard deviations of the angles and translations of the views, (V_c, 6)."""
        frames, observed, columns = self.problem.frames, self.problem.observations[side], self.columns
        T = rig_jacobian(frames, observed, self.state, side)[:, POSE]
        by_rig, by_pose = T[:, :, columns.rig], T[:, :, columns.pose]
        own = self.covariance.own[observed.view]
        places = np.flatnonzero(np.isin(self.shared, columns.rig))
        cross = np.zeros((len(own), 6, 6))
        if len(places) == 6:
            cross = self.covariance.cross[observed.view][:, places]
        mixed = by_rig @ cross @ np.swapaxes(by_pose, 1, 2)
        covariance = by_pose @ own @ np.swapaxes(by_pose, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
        covariance += by_rig @ self._shared_block(columns.rig) @ np.swapaxes(by_rig, 1, 2)
        centre = (R @ frames.centre[observed.view][..., None])[..., 0]
        return pose_std(R, centre, frames.scale[observed.view], covariance)


def _widened(covariance: SchurCovariance, shared: Array) -> SchurCovariance:
    """Replace the covariance of the shared unknowns, and propagate the change to the own ones."""
    follow = solve_scaled(
        np.broadcast_to(covariance.shared, (len(covariance.cross), *shared.shape)), covariance.cross
    )
    more = np.swapaxes(follow, 1, 2) @ (shared - covariance.shared) @ follow
    return replace(covariance, shared=shared, own=covariance.own + more, cross=shared @ follow)


def _intrinsics(
    given: Calibration, camera: CameraState, observed: Observations, estimated: NDArray[np.bool_]
) -> Intrinsics:
    """Intrinsic parameters [px]; given entries of A keep their exact values."""
    entries = camera.entries[0] * observed.pixel_scale
    entries[3:] += observed.pixel_centre
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


def _squared_errors(observed: Observations, camera: CameraState) -> Array:
    """Squared pixel errors, (T, n) [px^2]; 0 for padding."""
    batches: PointBatches = observed.batches
    squares = (residuals(batches, camera) ** 2).sum(axis=1) * observed.pixel_scale**2
    if batches.whitening is not None:
        squares = np.where(batches.whitening[:, 0] > 0, squares, 0.0)
    return np.asarray(squares)

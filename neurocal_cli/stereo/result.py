"""From the adjusted, normalised rig to a `Rig` in pixels and world units, with its covariance."""

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
)
from neurocal_cli.bundle_adjustment.point_batches import PointBatches
from neurocal_cli.bundle_adjustment.problem import intrinsic_matrix
from neurocal_cli.bundle_adjustment.reprojection import ENTRIES, POSE, CameraState, residuals
from neurocal_cli.calibration import Calibration, NetworkRecord, StopReason, ViewResult
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.distortion.monotonic_fit import where_not_monotonic
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array, euler_jacobian
from neurocal_cli.least_squares.schur_complement import SchurCovariance, schur_covariance
from neurocal_cli.stereo.adjust import AdjustedRig
from neurocal_cli.stereo.problem import RigProblem
from neurocal_cli.stereo.reprojection import Columns, Sightings, through_rig
from neurocal_cli.stereo.rig import Rig

__all__ = ["assemble_rig", "folding_sides"]

_SINGULAR = 1e-13  # eigenvalue of a normal matrix with unit diagonal, below which rounding rules


def assemble_rig(
    problem: RigProblem,
    calibrations: tuple[Calibration, Calibration],
    adjusted: AdjustedRig,
    free: NDArray[np.bool_],
    left_out: Mapping[tuple[str, str], str],
) -> Rig:
    """Put a adjusted rig into the user's units.

    Raises
    ------
    DegenerateGeometryError
        The points leave the answer open.
    """
    return _RigAssembly(problem, calibrations, adjusted, free).rig(left_out)


def folding_sides(
    problem: RigProblem,
    calibrations: tuple[Calibration, Calibration],
    adjusted: AdjustedRig,
    free: NDArray[np.bool_],
) -> list[int]:
    """Cameras whose lens, as the common refinement has it, folds back inside the image."""
    columns, shared = Columns.of(adjusted.state), np.flatnonzero(free)
    found = []
    for side, own in enumerate((columns.left, columns.right)):
        camera, seen, given = adjusted.state.cameras[side], problem.sightings[side], calibrations[side]
        estimated = np.isin(own, shared)
        if not estimated.any():
            continue
        A = _intrinsics(given, camera, seen, estimated[:5]).A if estimated[:5].any() else given.K
        if where_not_monotonic(camera.distortion, A, given.points) is not None:
            found.append(side)
    return found


class _RigAssembly:
    def __init__(
        self,
        problem: RigProblem,
        calibrations: tuple[Calibration, Calibration],
        adjusted: AdjustedRig,
        free: NDArray[np.bool_],
    ) -> None:
        self.problem, self.calibrations, self.adjusted = problem, calibrations, adjusted
        self.columns = Columns.of(adjusted.state)
        self.shared = np.flatnonzero(free)
        inverse = schur_covariance(adjusted.normal, self.shared, self.columns.pose)
        if not inverse.smallest > _SINGULAR:
            raise DegenerateGeometryError(
                "the points do not determine the rig and both cameras (the normal matrix is singular); "
                "spread them in depth, or give known parameters (--no-skew, --left-intrinsics, "
                "--right-intrinsics)"
            )
        n_equations = sum(seen.n_equations for seen in problem.sightings)
        unknowns = len(self.shared) + 6 * len(problem.frames.scale)
        variance = adjusted.cost / max(n_equations - unknowns, 1)
        self.covariance = _scaled(inverse, variance)

    def rig(self, left_out: Mapping[tuple[str, str], str]) -> Rig:
        state, frames = self.adjusted.state, self.problem.frames
        errors = [
            _squared_errors(seen, state.seen_by(side, frames, seen))
            for side, seen in enumerate(self.problem.sightings)
        ]
        sums = [
            seen.batches.sum_by_view(e.sum(axis=1))
            for seen, e in zip(self.problem.sightings, errors, strict=True)
        ]
        reason = self._stop_reason()
        left, right = (
            self._calibration(side, sums[side], float(errors[side].max()), reason) for side in (0, 1)
        )
        pose = Pose(state.R, state.t * frames.unit)
        block, std = self._rig_covariance(pose)
        n_points = sum(seen.n_points for seen in self.problem.sightings)
        return Rig(
            left,
            right,
            pose,
            std,
            block,
            tuple(
                (self.problem.names[0][a], self.problem.names[1][b])
                for a, b in sorted(
                    zip(self.problem.paired.tolist(), self.problem.paired_right.tolist(), strict=True)
                )
            ),
            dict(left_out),
            rmse_px=float(np.sqrt(sum(s.sum() for s in sums) / n_points)),
            max_px=float(np.sqrt(max(e.max() for e in errors))),
            converged=reason == StopReason.CONVERGED.value,
            stop_reason=reason,
            iterations=self.adjusted.iterations,
        )

    def _stop_reason(self) -> str:
        for calibration in self.calibrations:
            if not calibration.converged:
                return calibration.stop_reason
        return (StopReason.CONVERGED if self.adjusted.converged else StopReason.MAX_ITERATIONS).value

    def _rig_covariance(self, pose: Pose) -> tuple[Array, dict[str, float]]:
        """Covariance of the rig's angles and translation, and their std with the baseline's."""
        J = np.zeros((7, 6))
        J[:3, :3] = euler_jacobian(pose.R)
        J[3:6, 3:] = np.eye(3) * self.problem.frames.unit
        baseline = np.linalg.norm(pose.t)
        J[6, 3:] = self.problem.frames.unit * (pose.t / baseline if baseline > 0 else 0.0)
        block = J @ self._shared_block(self.columns.rig) @ J.T
        std = np.sqrt(np.maximum(np.diagonal(block), 0.0)).tolist()
        return block[:6, :6], dict(zip((*POSE_NAMES, "baseline"), std, strict=True))

    def _shared_block(self, columns: NDArray[np.intp]) -> Array:
        """Covariance of some of the shared unknowns, 0 for those that were given."""
        place = {int(column): k for k, column in enumerate(self.shared)}
        known = [k for k, column in enumerate(columns.tolist()) if column in place]
        block = np.zeros((len(columns), len(columns)))
        rows = [place[int(columns[k])] for k in known]
        block[np.ix_(known, known)] = self.covariance.shared[np.ix_(rows, rows)]
        return block

    def _calibration(self, side: int, squares: Array, largest: float, reason: str) -> Calibration:
        """One camera, as it is after the common refinement."""
        given, seen = self.calibrations[side], self.problem.sightings[side]
        camera = self.adjusted.state.cameras[side]
        columns = (self.columns.left, self.columns.right)[side]
        estimated = np.isin(columns, self.shared)
        intrinsics = given.intrinsics
        if estimated[:5].any():
            intrinsics = _intrinsics(given, camera, seen, estimated[:5])
        changes: dict[str, Any] = {}
        if estimated.any():
            changes = self._intrinsic_changes(given, intrinsics, camera, seen, columns)
        rms = np.sqrt(squares / seen.batches.counts)
        R, t = self._world_poses(side)
        stds = self._pose_stds(side, R)
        R.setflags(write=False)
        t.setflags(write=False)
        views = {
            name: ViewResult(Pose.exact(R[k], t[k]), dict(zip(POSE_NAMES, stds[k].tolist(), strict=True)),
                             int(seen.batches.counts[k]), float(rms[k]))
            for k, name in enumerate(self.problem.names[side])
        }  # fmt: skip
        rmse = float(np.sqrt(squares.sum() / seen.n_points))
        return replace(
            given,
            views=views,
            rmse_px=rmse,
            max_px=float(np.sqrt(largest)),
            converged=reason == StopReason.CONVERGED.value,
            stop_reason=reason,
            network=_network(given.network, intrinsics, views, rmse, self.adjusted.iterations),
            judgement=None,
            **changes,
        )

    def _intrinsic_changes(
        self,
        given: Calibration,
        intrinsics: Intrinsics,
        camera: CameraState,
        seen: Sightings,
        columns: NDArray[np.intp],
    ) -> dict[str, Any]:
        block, std = parameter_covariance(
            intrinsics, camera.model, self._shared_block(columns), seen.pixel_scale, given.fixed
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
        """Each view's pose in its camera, in world units."""
        frames, seen = self.problem.frames, self.problem.sightings[side]
        state = self.adjusted.state.seen_by(side, frames, seen)
        scale, centre = frames.scale[seen.view][:, None], frames.centre[seen.view]
        return state.R, state.t * scale - (state.R @ centre[..., None])[..., 0]

    def _pose_stds(self, side: int, R: Array) -> Array:
        """Standard deviations of each view's angles and translation, (V_c, 6)."""
        frames, seen, columns = self.problem.frames, self.problem.sightings[side], self.columns
        T = through_rig(frames, seen, self.adjusted.state, columns, side)[:, POSE]
        by_rig, by_pose = T[:, :, columns.rig], T[:, :, columns.pose]
        own = self.covariance.own[seen.view]
        places = np.flatnonzero(np.isin(self.shared, columns.rig))
        cross = np.zeros((len(own), 6, 6))
        if len(places) == 6:
            cross = self.covariance.cross[seen.view][:, places]
        mixed = by_rig @ cross @ np.swapaxes(by_pose, 1, 2)
        covariance = by_pose @ own @ np.swapaxes(by_pose, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
        covariance += by_rig @ self._shared_block(columns.rig) @ np.swapaxes(by_rig, 1, 2)
        centre = (R @ frames.centre[seen.view][..., None])[..., 0]
        return pose_std(R, centre, frames.scale[seen.view], covariance)


def _scaled(inverse: SchurCovariance, variance: float) -> SchurCovariance:
    return SchurCovariance(
        variance * inverse.shared, variance * inverse.own, variance * inverse.cross, inverse.smallest
    )


def _intrinsics(
    given: Calibration, camera: CameraState, seen: Sightings, estimated: NDArray[np.bool_]
) -> Intrinsics:
    """Intrinsic parameters [px]; given entries of A stay exactly as they were."""
    entries = camera.entries[0] * seen.pixel_scale
    entries[3:] += seen.pixel_centre
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
    """The network's weights for the camera as it is now, so that P = S1 W V S2 still."""
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


def _squared_errors(seen: Sightings, camera: CameraState) -> Array:
    """Squared pixel errors, (T, n) [px^2]; 0 for padding."""
    batches: PointBatches = seen.batches
    squares = (residuals(batches, camera) ** 2).sum(axis=1) * seen.pixel_scale**2
    if batches.whitening is not None:
        squares = np.where(batches.whitening[:, 0] > 0, squares, 0.0)
    return np.asarray(squares)

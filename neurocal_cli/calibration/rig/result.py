"""A rig in pixels and world units from the adjusted, normalised one, with its covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.covariance import (
    parameter_covariance,
    parameter_warnings,
    pose_std,
    with_scale,
)
from neurocal_cli.adjustment.normal_equations import Covariance
from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.calibration.calibration import Calibration, NetworkRecord, StopReason, ViewResult
from neurocal_cli.calibration.lens_choice.monotonic_fit import told_of_fold, where_not_monotonic
from neurocal_cli.calibration.rig.adjust import RigFit
from neurocal_cli.calibration.rig.rig import named_std
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array, euler_jacobian
from neurocal_cli.camera.pinhole import POSE_NAMES, Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.observations.target import std_of_scale


class RigAssembly:
    """An adjusted rig in pixels and world units.

    `found` is the covariance of all shared unknowns, normalised, with further ones after them.
    """

    def __init__(self, fit: RigFit, found: Covariance) -> None:
        self.fit, self.problem, self.state, self.columns = fit, fit.problem, fit.state, fit.state.columns
        first = self.problem.calibrations[0]
        self.scale_std = std_of_scale(first.points, first.target)
        self.found = found
        self.poses = [
            Pose(R, t * self.problem.unit) for R, t in zip(self.state.R[1:], self.state.t[1:], strict=True)
        ]
        self.covariance, self.stds = self._of_poses()
        self._measure()

    def _measure(self) -> None:
        """The errors of all points, and the cameras."""
        problem, sums, largest = self.problem, [], []  # of the squared errors [px^2]
        for side, observed in enumerate(problem.observations):
            errors = point_residuals(observed.views, problem.camera(self.state, side))
            squares = (errors**2).sum(axis=1) * observed.views.pixel_scale**2
            sums.append(np.add.reduceat(squares, observed.views.first))
            largest.append(float(squares.max()))
        n_points = sum(observed.views.counts.sum() for observed in problem.observations)
        self.rmse_px = float(np.sqrt(sum(part.sum() for part in sums) / n_points))
        self.cameras = [
            self._calibration(side, *errors) for side, errors in enumerate(zip(sums, largest, strict=True))
        ]

    def _of_poses(self) -> tuple[Array, list[dict[str, float]]]:
        """Covariance of the angles and translations of all poses; their and the distances' std."""
        n, unit = len(self.poses), self.problem.unit
        J, followed = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
        for k, pose in enumerate(self.poses):
            J[k, :3, k, :3] = euler_jacobian(pose.R)
            J[k, 3:, k, 3:] = np.eye(3) * unit
            followed[k, 3:] = pose.t  # the scale of the target
        flat = J.reshape(6 * n, 6 * n)
        block = flat @ self._shared_block(np.concatenate(self.columns.rigs)) @ flat.T
        block += self.scale_std**2 * np.outer(followed, followed)
        own = [slice(6 * k, 6 * k + 6) for k in range(n)]
        return block, [named_std(block[at, at], pose.t) for at, pose in zip(own, self.poses, strict=True)]

    @property
    def delays(self) -> list[tuple[float, float]]:
        """Delay of the images of each camera but the first, and its standard deviation; empty if unknown."""
        if not self.state.timed:
            return []
        variances = np.diagonal(self._shared_block(np.concatenate(self.columns.delays)))
        return list(zip(self.state.delay[1:].tolist(), np.sqrt(variances).tolist(), strict=True))

    def _shared_block(self, columns: NDArray[np.intp]) -> Array:
        """Covariance of some of the shared parameters, 0 for given ones."""
        free = self.fit.free[columns]
        return np.where(np.outer(free, free), self.found.shared[np.ix_(columns, columns)], 0.0)

    def _calibration(self, side: int, sums: Array, largest: float) -> Calibration:
        """One camera after the common bundle adjustment, with its squared errors [px^2] by view."""
        given, counts = self.problem.calibrations[side], self.problem.observations[side].views.counts
        intrinsics = intrinsics_of(self.fit, side)
        alone = [camera.stop_reason for camera in self.problem.calibrations if not camera.converged]
        together = StopReason.CONVERGED if self.fit.converged else StopReason.MAX_ITERATIONS
        reason = alone[0] if alone else together.value
        changes: dict[str, Any] = {}
        if self.fit.free[self.columns.cameras[side]].any():
            changes = self._intrinsic_changes(side, intrinsics)
        rms = np.sqrt(sums / counts)
        R, t = self.problem.world_poses(self.state, side)
        stds = with_scale(self._pose_stds(side, R), t, self.scale_std)
        R.setflags(write=False)
        t.setflags(write=False)
        views = {
            name: ViewResult(Pose.exact(R[k], t[k]), dict(zip(POSE_NAMES, stds[k].tolist(), strict=True)),
                             int(counts[k]), float(rms[k]))
            for k, name in enumerate(self.problem.names[side])
        }  # fmt: skip
        rmse = float(np.sqrt(sums.sum() / counts.sum()))
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

    def _intrinsic_changes(self, side: int, intrinsics: Intrinsics) -> dict[str, Any]:
        given, camera = self.problem.calibrations[side], self.state.cameras[side]
        block, std = parameter_covariance(
            intrinsics,
            camera.model,
            self._shared_block(self.columns.cameras[side]),
            self.problem.observations[side].views.pixel_scale,
            given.fixed,
            given.square_pixels,
        )
        names = list(std)
        free = [k for k, name in enumerate(names) if name not in given.fixed]
        before: tuple[str, ...] = (told_of_fold(camera.model),)
        chosen = bool(given.lens_choice)
        if given.std.keys() >= std.keys():
            alone = Distortion(camera.model, given.distortion)
            before += parameter_warnings(given.intrinsics, alone, given.std, chosen)
        now = parameter_warnings(intrinsics, camera.distortion, std, chosen)
        return {
            "intrinsics": intrinsics,
            "std": std,
            "distortion": camera.k,
            "covariance": block[np.ix_(free, free)],
            "covariance_names": tuple(names[k] for k in free),
            "warnings": (*now, *(text for text in given.warnings if text not in before)),
        }

    def _pose_stds(self, side: int, R: Array) -> Array:
        """Standard deviations of the angles and translations of the views, (V_c, 6)."""
        view, (of_rig, by_rig, by_pose) = (
            self.problem.observations[side].view,
            self.problem.pose_steps(self.state, side),
        )
        covariance = by_pose @ self.found.own[view] @ np.swapaxes(by_pose, 1, 2)
        if of_rig.size:
            mixed = by_rig @ self.found.cross[view][:, of_rig] @ np.swapaxes(by_pose, 1, 2)
            covariance = covariance + mixed + np.swapaxes(mixed, 1, 2)
            covariance += by_rig @ self._shared_block(of_rig) @ np.swapaxes(by_rig, 1, 2)
        centre = (R @ self.problem.centre[view][..., None])[..., 0]
        return pose_std(R, centre, self.problem.scale[view], covariance)


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

"""Covariance of a rig whose target was estimated with the cameras, and so is uncertain as well.

All views share the unknowns of both cameras and of the rig; poses and target points are eliminated. The
derivatives by the rig's unknowns follow from those of each camera by the chain rule.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.reprojection import POSE, camera_columns
from neurocal_cli.geometry import Array
from neurocal_cli.stereo.adjust import RigFit
from neurocal_cli.stereo.problem import RigProblem
from neurocal_cli.stereo.reprojection import Observations, rig_jacobian, rig_normal_blocks
from neurocal_cli.target import Target
from neurocal_cli.target_shape.information import Information, point_terms
from neurocal_cli.target_shape.posterior import known_sizes
from neurocal_cli.target_shape.prior import prior_of_target
from neurocal_cli.target_shape.surveyed import noise_variance


def with_target_uncertainty(target: Target, fit: RigFit) -> Array | None:
    """(F, F) covariance of the free shared parameters of the rig; None if they are not determined."""
    prior = prior_of_target(target)
    info = _information(target, fit).turned(prior.axes)
    spare = info.equations - len(info.camera) - 6 * len(info.pose)
    offsets = prior.along_axes(target.offsets)
    variance = info.cost / max(spare, 1.0)
    info = info.around_given(offsets)
    try:
        if prior.stated is not None:
            variance = noise_variance(info, prior, target.sizes["stated"])
        found = known_sizes(info, prior, target.sizes, variance)
    except np.linalg.LinAlgError:
        return None
    return found.variance * found.camera


def _information(target: Target, fit: RigFit) -> Information:
    problem, state, n = fit.problem, fit.state, len(target.given)
    columns, shared, frames = state.columns, np.flatnonzero(fit.free), problem.frames
    N, _ = rig_normal_blocks(frames, problem.observations, state)
    point, point_right = np.zeros((n, 3, 3)), np.zeros((n, 3))
    point_shared = np.zeros((n, 3, columns.n_shared))
    pose_point = np.zeros((len(frames.scale), 6, n, 3))
    for side, (observed, own) in enumerate(zip(problem.observations, columns.cameras, strict=True)):
        camera = state.camera_with_poses(side, frames, observed)
        label, scale = _labels(target, problem, observed), frames.scale[observed.view]
        terms = point_terms(observed.batches, camera, scale, label, camera_columns(len(own) - 5), n)
        T, w = rig_jacobian(frames, observed, state, side), observed.weight
        point += w * terms.point
        point_right += w * terms.point_right
        point_shared[:, :, own] += w * terms.point_camera
        point_shared[:, :, columns.rig] += w * np.einsum(
            "vqnj,vqr->njr", terms.pose_point, T[:, POSE][:, :, columns.rig]
        )
        pose_point[observed.view] += w * np.einsum(
            "vqnj,vqr->vrnj", terms.pose_point, T[:, POSE][:, :, columns.pose]
        )
    return Information(
        camera=N[:, shared[:, None], shared].sum(axis=0),
        camera_right=N[:, shared, -1].sum(axis=0),
        pose=N[:, columns.pose[:, None], columns.pose],
        pose_camera=N[:, columns.pose[:, None], shared],
        pose_right=N[:, columns.pose, -1],
        point=point,
        point_camera=point_shared[:, :, shared],
        point_right=point_right,
        pose_point=pose_point,
        cost=float(N[:, -1, -1].sum()),
        equations=sum(observed.n_equations for observed in problem.observations),
    )


def _labels(target: Target, problem: RigProblem, observed: Observations) -> NDArray[np.intp]:
    """(T, n) index of the target point in each slot of the batches; -1 for padding."""
    batches, frames = observed.batches, problem.frames
    frame = observed.view[batches.view]
    world = batches.local * frames.scale[frame][:, None, None] + frames.centre[frame][:, :, None]
    label = target.rows_of(np.swapaxes(world, 1, 2).reshape(-1, 3)).reshape(len(world), -1)
    return label if batches.whitening is None else np.where(batches.whitening[:, 0] == 0, -1, label)

"""How triangulated points follow errors of a rig and its cameras, and how uncertain both make them.

The pixels of a point X in the first camera's frame move by E dc with the unknowns c of the cameras and their
poses, and by J dX with the point. So from the same pixels, an error dc shows the point X - N^-1 J^T E dc with
N = J^T J, summed over the cameras that see it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.cross_validation import inverse_or_nan
from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant, scatter
from neurocal_cli.calibration.rig.covariance import contradicting_covariance, covariance_by_given
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array, cross_matrix
from neurocal_cli.camera.pinhole import Intrinsics


def camera_in_pixels(fit: RigFit, side: int) -> Camera:
    """A camera of the rig at its minimum."""
    state = fit.state.cameras[side]
    entries = fit.problem.observations[side].in_pixels(state.entries[0])
    return Camera(Intrinsics.from_matrix(intrinsic_matrix(entries)), state.distortion)


def in_camera(fit: RigFit, points: Array, side: int) -> tuple[Array, Array]:
    """Points (N, 3) of the first camera's frame in another one, and their derivatives by its pose."""
    state, unit = fit.state, fit.problem.unit
    turned = points @ state.R[side].T
    shift = np.broadcast_to(unit * np.eye(3), (len(points), 3, 3))
    return turned + unit * state.t[side], np.concatenate([-cross_matrix(turned), shift], axis=2)


def point_moves(fit: RigFit, points: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """How points (N, 3) follow what the frames share, and their covariance by pixels of unit variance.

    They are in the first camera's frame [world unit], and `seen` (C, N) tells which cameras see them. Returns
    (N, 3, n_shared) and (N, 3, 3) arrays.
    """
    columns = fit.state.columns
    normal = np.zeros((len(points), 3, 3))
    right, axes = np.zeros((len(points), 3, columns.n_shared)), np.arange(3)
    for side, rows in enumerate(map(np.flatnonzero, seen)):
        own, by_pose = in_camera(fit, points[rows], side)
        by_camera, by_point = camera_in_pixels(fit, side).project_jacobian(own)
        by_camera[:, :, :5] *= fit.problem.observations[side].pixel_scale
        if fit.state.cameras[side].square:
            by_camera[:, :, 0] += by_camera[:, :, 2]
        J = by_point @ fit.state.R[side]
        Jt = np.swapaxes(J, 1, 2)
        normal[rows] += Jt @ J
        right[np.ix_(rows, axes, columns.cameras[side])] += Jt @ by_camera
        if side:
            right[np.ix_(rows, axes, columns.rigs[side])] += Jt @ by_point @ by_pose
    by_pixel = inverse_or_nan(normal)
    return -by_pixel @ right, by_pixel


def shared_covariance(fit: RigFit) -> Array:
    """(n_shared, n_shared) covariance of what the frames share: of the fit, and of given cameras."""
    free = np.flatnonzero(fit.free)
    shared = np.zeros((len(fit.free), len(fit.free)))
    if is_significant(*scatter(fit)):
        shared[np.ix_(free, free)] = contradicting_covariance(fit)
    else:
        shared[np.ix_(free, free)] = fit.variance * fit.normal.only(free).covariance().shared
    given = covariance_by_given(fit.problem, fit.state, fit.normal, fit.free)
    return shared if given is None else shared + given.shared

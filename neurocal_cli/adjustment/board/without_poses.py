"""The normal equations of cameras and offsets, with the poses eliminated (Schur complement)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.board.information import Information
from neurocal_cli.camera.geometry import Array


class WithoutPoses:
    """Information with the poses eliminated; results for different views can be added.

    With the lower triangular Cholesky factors L of the poses' matrices, `root` (P, p, p) is their inverses,
    and `rows` (P p, f + 3 n + 1) the products of these with the coupling to cameras, offsets and the right
    side. `logdet` is the log determinant of the poses' part, and `poses` (P,) are the indices of the poses
    among those of all views.
    """

    def __init__(self, info: Information, poses: NDArray[np.intp] | None = None) -> None:
        self.info, (P, p), d = info, info.pose.shape[:2], info.point_right.size
        self.poses = np.arange(P) if poses is None else poses
        self.root = np.linalg.inv(np.linalg.cholesky(info.pose))
        f = len(info.camera)
        rows = np.empty((P, p, f + d + 1))
        np.matmul(self.root, info.pose_camera, out=rows[:, :, :f])
        np.matmul(self.root, info.pose_point.reshape(P, p, d), out=rows[:, :, f:-1])
        np.matmul(self.root, info.pose_right[..., None], out=rows[:, :, -1:])
        self.rows = rows.reshape(P * p, f + d + 1)
        self.logdet = -2 * float(np.log(np.diagonal(self.root, axis1=1, axis2=2)).sum())

    @cached_property
    def matrix(self) -> Array:
        """(f + 3 n + 1, f + 3 n + 1) reduced matrix, bordered by the right side and the cost."""
        info, f, n = self.info, len(self.info.camera), len(self.info.point)
        M = self.rows.T @ self.rows
        np.negative(M, out=M)
        M[:f, :f] += info.camera
        across = info.point_camera.reshape(3 * n, f)
        M[f:-1, :f] += across
        M[:f, f:-1] += across.T
        blocks = M[f:-1, f:-1].reshape(n, 3, n, 3)
        np.einsum("ninj->nij", blocks)[...] += info.point
        right = np.concatenate([info.camera_right, info.point_right.ravel(), [info.cost]])
        M[-1] += right
        M[:-1, -1] += right[:-1]
        return np.asarray(M)

    def at(self, offsets: Array) -> tuple[Array, Array, Array]:
        """The cameras' matrix (f, f), right sides (f, k) and costs (k,) for given offsets (k, n, 3)."""
        info, f, k = self.info, len(self.info.camera), len(offsets)
        flat = offsets.reshape(k, -1).T
        by_camera, left = self.rows[:, :f], self.rows[:, -1:] - self.rows[:, f:-1] @ flat
        by_point = (info.point @ offsets[..., None])[..., 0] - 2 * info.point_right
        right = info.camera_right[:, None] - info.point_camera.reshape(len(flat), f).T @ flat
        return (
            info.camera - by_camera.T @ by_camera,
            right - by_camera.T @ left,
            info.cost + (offsets * by_point).sum(axis=(1, 2)) - (left**2).sum(axis=0),
        )


def sum_of(matrices: Sequence[Array]) -> Array:
    """The sum; several times as fast as NumPy's over an axis of a stack."""
    total = matrices[0].copy()
    for matrix in matrices[1:]:
        total += matrix
    return total

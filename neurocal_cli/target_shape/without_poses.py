"""The quadratic in cameras and offsets with the poses eliminated (Schur complement)."""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information


class WithoutPoses:
    """Information with the poses eliminated; results for different views can be added.

    Parameters
    ----------
    info : Information

    Attributes
    ----------
    rows : (P p, f + 3 n + 1) array
        Factor of the Schur complement's correction, for cameras, offsets and the right side.
    logdet : float
        Log determinant of the poses' part.
    """

    def __init__(self, info: Information) -> None:
        self.info, (P, p), d = info, info.pose.shape[:2], info.point_right.size
        root = np.linalg.inv(np.linalg.cholesky(info.pose))
        columns = [info.pose_camera, info.pose_point.reshape(P, p, d), info.pose_right[..., None]]
        self.rows = (root @ np.concatenate(columns, axis=2)).reshape(P * p, len(info.camera) + d + 1)
        self.logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())

    def matrix(self) -> Array:
        """(f + 3 n + 1, f + 3 n + 1) reduced matrix, bordered by the right side and the cost."""
        info, f, n = self.info, len(self.info.camera), len(self.info.point)
        M = self.rows.T @ -self.rows
        M[:f, :f] += info.camera
        across = info.point_camera.reshape(3 * n, f)
        M[f:-1, :f] += across
        M[:f, f:-1] += across.T
        at = f + 3 * np.arange(n)
        for i in range(3):
            for j in range(3):
                M[at + i, at + j] += info.point[:, i, j]
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

"""Solve the normal equations of cameras, poses and offsets for given prior precisions of the offsets' parts.

The Schur complement eliminates the poses or the points, whichever have more unknowns, block by block. The
remaining system is dense. So the work grows linearly with the number of views or of points.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information
from neurocal_cli.target_shape.prior import Prior

_SMALL = 48  # largest triangular matrix that is inverted directly; others are split in halves
_RIDGE = 1e-10  # added to a unit diagonal if rounding has made a matrix indefinite


class System:
    """The quadratic in the whole offsets along each point's axes, with its parts.

    Everything independent of the precisions is computed once. `s` is the number of camera parameters and
    smooth coefficients.
    """

    def __init__(self, info: Information, prior: Prior) -> None:
        self.info, self.prior = info, prior
        self.n, (self.P, self.p) = len(info.point), info.pose.shape[:2]
        self.f, self.m = len(info.camera), prior.basis.shape[2]
        self.s = self.f + self.m
        self.gauge = prior.gauge if self.P else prior.gauge[:, :0]
        self.points_first = 3 * self.n >= self.p * self.P
        if self.points_first:
            self._prepare()
        else:
            self._eliminate_poses()

    def _prepare(self) -> None:
        """Compute the matrices from which the points will be eliminated."""
        info, basis = self.info, self.prior.basis
        by_basis = info.point @ basis  # (n, 3, m)
        flat = basis.reshape(3 * self.n, self.m)
        across = info.point_camera.reshape(3 * self.n, self.f).T @ flat
        inner = flat.T @ by_basis.reshape(3 * self.n, self.m)
        shared = np.block([[info.camera, across], [across.T, inner]])
        right = np.concatenate([info.camera_right, info.point_right.ravel() @ flat])
        pose_basis = info.pose_point.reshape(self.P * self.p, 3 * self.n) @ flat
        pose_shared = np.concatenate([info.pose_camera, pose_basis.reshape(self.P, self.p, self.m)], axis=2)
        self.bordered = self._with_points(shared, right, pose_shared)
        # (n, 3, s + P p + 1): coupling of each point to all other unknowns and to the right side
        poses = np.moveaxis(info.pose_point, 2, 0).reshape(self.n, self.p * self.P, 3).swapaxes(1, 2)
        by_shared = [info.point_camera, by_basis]
        self.by_point = np.concatenate([*by_shared, poses, info.point_right[..., None]], axis=2)
        self.rows = np.empty_like(self.by_point)  # large arrays are quicker to fill again than to allocate

    def _with_points(self, shared: Array, right: Array, pose_shared: Array) -> Array:
        """The bordered matrix of cameras, smooth parts and poses, before points are eliminated."""
        info, s, P, p = self.info, self.s, self.P, self.p
        dim = s + p * P
        M = np.zeros((dim + 1, dim + 1))
        M[:s, :s] = shared
        M[:s, s:dim] = pose_shared.reshape(p * P, s).T
        M[s:dim, :s] = M[:s, s:dim].T
        at = s + p * np.arange(P)
        for i in range(p):
            for j in range(p):
                M[at + i, at + j] = info.pose[:, i, j]
        M[:s, -1], M[s:dim, -1], M[-1, -1] = right, info.pose_right.reshape(-1), info.cost
        M[-1, :dim] = M[:dim, -1]
        return M

    def _eliminate_poses(self) -> None:
        """Eliminate the poses: the bordered matrix of cameras, smooth parts and points."""
        without = WithoutPoses(self.info)
        M, f, s, m = without.matrix(), self.f, self.s, self.m
        basis = self.prior.basis.reshape(3 * self.n, m)
        by_basis = M[:, f:-1] @ basis
        dense = np.empty((len(M) + m,) * 2)
        old = np.r_[:f, s : len(dense)]
        dense[np.ix_(old, old)] = M
        dense[old, f:s] = by_basis
        dense[f:s, old] = by_basis.T
        dense[f:s, f:s] = basis.T @ by_basis[f:-1]
        self.dense, self.logdet_poses = dense, without.logdet

    def solve(self, smooth: Array, single: Array) -> Solved:
        """Solve for given precisions (m,) of the smooth parts and (n, 3) of the single points."""
        return self._points_first(smooth, single) if self.points_first else self._poses_first(smooth, single)

    def least(self, smooth: Array, single: Array) -> tuple[float, float]:
        """Cost at the minimum and log determinant, without the rest of `Solved`."""
        if self.points_first:
            M, root, _ = self._without_points(smooth, single)
            logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
        else:
            M, logdet = self._without_poses(smooth, single), self.logdet_poses
        scale = 1.0 / np.sqrt(np.diagonal(M)[:-1])
        scaled = M[:-1, :-1] * scale[:, None] * scale
        try:
            factor = np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            factor = np.linalg.cholesky(scaled + _RIDGE * np.eye(len(scaled)))
        part = np.linalg.solve(factor, scale * M[:-1, -1])
        return float(M[-1, -1] - part @ part), logdet + 2 * float(
            np.log(np.diagonal(factor)).sum() - np.log(scale).sum()
        )

    def minimum(self, smooth: Array, single: Array) -> tuple[Array, Array, Array]:
        """Step (f,) of the cameras, coefficients (m,) of smooth parts, offsets (n, 3) of single points."""
        if not self.points_first:
            M = self._without_poses(smooth, single)
            x = np.asarray(np.linalg.solve(M[:-1, :-1], M[:-1, -1]))
            return x[: self.f], x[self.f : self.s], x[self.s :].reshape(self.n, 3)
        M, root, rows = self._without_points(smooth, single)
        x = np.asarray(np.linalg.solve(M[:-1, :-1], M[:-1, -1]))
        own = rows[:, :, -1] - rows[:, :, :-1] @ x
        return x[: self.f], x[self.f : self.s], (np.swapaxes(root, 1, 2) @ own[..., None])[..., 0]

    def _without_poses(self, smooth: Array, single: Array) -> Array:
        """The bordered matrix of cameras, smooth parts and points, with the precisions."""
        s, f = self.s, self.f
        M = self.dense.copy()
        at = np.arange(len(M) - 1)
        M[at[f:s], at[f:s]] += smooth
        M[at[s:], at[s:]] += single.ravel()
        return M

    def _poses_first(self, smooth: Array, single: Array) -> Solved:
        M = self._without_poses(smooth, single)
        root, logdet = _root_of_inverse(M[:-1, :-1])
        half = root @ M[:-1, -1]
        x, s = half @ root, self.s
        return Solved(
            x[: self.f], x[self.f : s], x[s:].reshape(self.n, 3), float(M[-1, -1] - half @ half),
            logdet + self.logdet_poses, root[:, : self.f], root[:, self.f : s], root[:, s:],
            np.zeros((self.n, 3, 3)), lambda: self._followed_poses(root),
        )  # fmt: skip

    def _followed_poses(self, root: Array) -> tuple[Array, Array]:
        """Poses eliminated first: covariances (P, 6, 6) for known other unknowns, and roots (P, d, 6)."""
        info = self.info
        by_point = info.pose_point.reshape(self.P, self.p, 3 * self.n)
        by_smooth = by_point @ self.prior.basis.reshape(3 * self.n, self.m)
        own = np.linalg.inv(info.pose)
        gain = own[:, :6] @ np.concatenate([info.pose_camera, by_smooth, by_point], axis=2)
        return np.asarray(own[:, :6, :6]), -root @ np.swapaxes(gain, 1, 2)

    def _without_points(self, smooth: Array, single: Array) -> tuple[Array, Array, Array]:
        """The bordered matrix of cameras, smooth parts and poses; roots and rows of the points."""
        own = self.info.point + single[:, :, None] * np.eye(3)
        root = np.linalg.inv(np.linalg.cholesky(own))  # (n, 3, 3)
        rows = np.matmul(root, self.by_point, out=self.rows)
        flat = rows.reshape(3 * self.n, -1)
        M = self.bordered - flat.T @ flat
        at = np.arange(self.f, self.s)
        M[at, at] += smooth
        return M, root, rows

    def _points_first(self, smooth: Array, single: Array) -> Solved:
        f, s, n, P, p = self.f, self.s, self.n, self.P, self.p
        M, own_root, rows = self._without_points(smooth, single)
        root, logdet = _root_of_inverse(M[:-1, :-1])
        half = root @ M[:-1, -1]
        x, back = half @ root, np.swapaxes(own_root, 1, 2)
        # Back-substitution of the points: their response to all other unknowns.
        e = back @ (rows[:, :, -1] - rows[:, :, :-1] @ x)[..., None]
        follow = (back @ rows[:, :, :-1]).reshape(3 * n, len(x))
        logdet -= 2 * float(np.log(np.diagonal(own_root, axis1=1, axis2=2)).sum())
        poses = root[:, s:].reshape(len(x), P, p)[:, :, :6].swapaxes(0, 1)
        return Solved(
            x[:f], x[f:s], e[..., 0], float(M[-1, -1] - half @ half), logdet,
            root[:, :f], root[:, f:s], root @ -follow.T, back @ own_root,
            lambda: (np.zeros((P, 6, 6)), poses),
        )  # fmt: skip


class WithoutPoses:
    """Information with the poses eliminated (Schur complement); results for different views can be added.

    `rows` (P p, f + 3 n + 1) is a factor of the correction for cameras, offsets and the right side, and
    `logdet` the log determinant of the poses' part.
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


@frozen_dataclass(eq=False)
class Solved:
    """The minimum of the quadratic, and the inverse of its matrix: the covariance for unit noise.

    The covariance of two unknowns is the product of their columns in the roots. To that of single points,
    `own` is added.
    """

    camera: Array  # (f,) step of the cameras
    smooth: Array  # (m,) coefficients of the smooth parts
    single: Array  # (n, 3) offsets of the single points' parts
    cost: float
    logdet: float  # log determinant of the whole matrix
    camera_root: Array  # (d, f)
    smooth_root: Array  # (d, m)
    single_root: Array  # (d, 3 n)
    own: Array  # (n, 3, 3)
    # Covariances (P, 6, 6) of the poses for known other unknowns, and roots (P, d, 6) of the rest.
    pose_parts: Callable[[], tuple[Array, Array]]

    def smooth_variance(self, places: NDArray[np.intp]) -> float:
        """Sum of the variances of some coefficients."""
        return float(np.square(self.smooth_root[:, places]).sum())

    def single_variance(self) -> Array:
        """(n, 3) variances of the single points' parts."""
        by_root = np.einsum("ij,ij->j", self.single_root, self.single_root).reshape(-1, 3)
        return by_root + np.diagonal(self.own, axis1=1, axis2=2)

    def offset_root(self, prior: Prior) -> Array:
        """(d, 3 n) root of the whole offsets."""
        return self.single_root + self.smooth_root @ prior.basis.reshape(self.single.size, -1).T

    def offset_variance(self, prior: Prior, gauge: Array) -> Array:
        """(n, 3) variance of the whole offsets, without the gauge: rotations, shifts and scale of all points.

        With G the orthonormal gauge directions (3 n, 7), it is the diagonal of (I - G G^T) C (I - G G^T).
        """
        root = self.offset_root(prior)
        root = root - (root @ gauge) @ gauge.T
        G = gauge.reshape(*self.single.shape, -1)
        own = self.own @ G
        inner = np.einsum("nig,nih->gh", G, own)
        by_own = np.diagonal(self.own, axis1=1, axis2=2) + ((G @ inner - 2 * own) * G).sum(axis=2)
        return np.asarray(np.einsum("ij,ij->j", root, root).reshape(-1, 3) + by_own)

    def poses(self, prior: Prior, gauge: Array) -> Array:
        """(P, 6, 6) covariance of each pose of a target whose gauge is held."""
        own, root = self.pose_parts()
        covariance = own + np.swapaxes(root, 1, 2) @ root
        if not gauge.size:
            return np.asarray(covariance)
        by_gauge = self.offset_root(prior) @ gauge
        G = gauge.reshape(*self.single.shape, -1)
        of_gauge = by_gauge.T @ by_gauge + np.einsum("nig,nih->gh", G, self.own @ G)
        across = np.swapaxes(root, 1, 2) @ by_gauge
        return np.asarray(covariance - across @ np.linalg.solve(of_gauge, np.swapaxes(across, 1, 2)))


def _root_of_inverse(M: Array) -> tuple[Array, float]:
    """A factor R of the inverse R^T R, and the log determinant of the matrix."""
    scale = 1.0 / np.sqrt(np.diagonal(M))
    scaled = M * scale[:, None]
    scaled *= scale
    try:
        root = _inverse_of_triangular(np.linalg.cholesky(scaled))
    except np.linalg.LinAlgError:  # nearly degenerate coefficients, such as xi and alpha
        root = _inverse_of_triangular(np.linalg.cholesky(scaled + _RIDGE * np.eye(len(M))))
    logdet = -2 * float(np.log(np.diagonal(root)).sum() + np.log(scale).sum())
    root *= scale
    return root, logdet


def _inverse_of_triangular(L: NDArray[np.floating]) -> Array:
    """Inverse of a lower triangular matrix, by halves: in a third of the time of NumPy's general inverse."""
    n, h = len(L), len(L) // 2
    if n <= _SMALL:
        return np.asarray(np.linalg.inv(L))
    inverse = np.zeros((n, n))
    inverse[:h, :h], inverse[h:, h:] = _inverse_of_triangular(L[:h, :h]), _inverse_of_triangular(L[h:, h:])
    inverse[h:, :h] = -inverse[h:, h:] @ (L[h:, :h] @ inverse[:h, :h])
    return inverse

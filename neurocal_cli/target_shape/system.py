"""Solve the normal equations of cameras, poses and offsets for given prior precisions of the offsets' parts.

The Schur complement eliminates the poses or the points, whichever have more unknowns, block by block. The
remaining system is dense. So the work grows linearly with the number of views or of points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information
from neurocal_cli.target_shape.prior import Prior
from neurocal_cli.target_shape.without_poses import WithoutPoses

_SMALL = 48  # largest triangular matrix that is inverted directly; others are split in halves
_RIDGE = 1e-10  # added to a unit diagonal if rounding has made a matrix indefinite


class System:
    """The quadratic with its parts; everything independent of the precisions is computed once.

    Parameters
    ----------
    info : Information
        In the whole offsets from the given target, along each point's axes.
    prior : Prior
    """

    def __init__(self, info: Information, prior: Prior) -> None:
        self.info, self.prior = info, prior
        self.n, (self.P, self.p) = len(info.point), info.pose.shape[:2]
        self.f, self.m = len(info.camera), prior.basis.shape[2]
        self.gauge = prior.gauge if self.P else prior.gauge[:, :0]
        self.points_first = 3 * self.n >= self.p * self.P
        if self.points_first:
            self._prepare()
        else:
            self._eliminate_poses()

    @property
    def s(self) -> int:
        """Number of camera parameters and smooth coefficients."""
        return self.f + self.m

    def _prepare(self) -> None:
        """Compute the matrices from which the points will be eliminated."""
        info, basis = self.info, self.prior.basis
        by_basis = info.point @ basis  # (n, 3, m)
        across = np.einsum("nif,nim->fm", info.point_camera, basis)
        flat = basis.reshape(3 * self.n, self.m)
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
        s, f = self.s, self.f
        dim = s + 3 * self.n
        M = self._without_poses(smooth, single)
        root, logdet = _root_of_inverse(M[:dim, :dim])
        half = root @ M[:dim, -1]
        x, variance = half @ root, np.einsum("ij,ij->j", root, root)
        cost = float(M[-1, -1] - half @ half)
        var_single = variance[s:].reshape(self.n, 3)

        def rest() -> Rest:
            inverse = root.T @ root
            cross = inverse[f:s, s:].reshape(self.m, self.n, 3)
            along_gauge = (inverse[s:, s:] @ self.gauge).reshape(self.n, 3, -1)
            return Rest(
                self._with_offsets(inverse[:f, f:s], inverse[:f, s:].reshape(f, self.n, 3)),
                self._variance(inverse[f:s, f:s], cross, var_single, along_gauge),
                self._poses(inverse),
            )

        return Solved(
            x[:f], x[f:s], x[s:].reshape(self.n, 3), cost, logdet + self.logdet_poses,
            variance[f:s], var_single, root[:, :f].T @ root[:, :f], rest,
        )  # fmt: skip

    def _poses(self, inverse: Array) -> Array | None:
        """(P, 6, 6) covariance of the poses from that of all other unknowns; only for surveyed points.

        Without a survey it would include the gauge freedom of the target.
        """
        if self.prior.stated is None:
            return None
        own = np.linalg.inv(self.info.pose)
        by_point = self.info.pose_point.reshape(self.P, self.p, -1)
        gain = own @ np.concatenate([self.info.pose_camera, by_point], axis=2)
        return np.asarray(own + gain @ inverse @ np.swapaxes(gain, 1, 2))

    def _without_points(self, smooth: Array, single: Array) -> tuple[Array, Array, Array]:
        """The bordered matrix of cameras, smooth parts and poses; roots and rows of the points."""
        own = self.info.point + single[:, :, None] * np.eye(3)
        root = np.linalg.inv(np.linalg.cholesky(own))  # (n, 3, 3)
        rows = root @ self.by_point
        flat = rows.reshape(3 * self.n, -1)
        M = self.bordered - flat.T @ flat
        at = np.arange(self.f, self.s)
        M[at, at] += smooth
        return M, root, rows

    def _points_first(self, smooth: Array, single: Array) -> Solved:
        s, f, n, P, p = self.s, self.f, self.n, self.P, self.p
        dim = s + p * P
        M, own_root, rows = self._without_points(smooth, single)
        root, logdet = _root_of_inverse(M[:dim, :dim])
        half = root @ M[:dim, -1]
        x, variance = half @ root, np.einsum("ij,ij->j", root, root)
        cost = float(M[-1, -1] - half @ half)
        # Back-substitution of the points: their response to all other unknowns.
        back = np.swapaxes(own_root, 1, 2)
        e = (back @ (rows[:, :, -1] - rows[:, :, :-1] @ x)[..., None])[..., 0]
        follow = (back @ rows[:, :, :-1]).reshape(3 * n, dim)
        by_root = follow @ root.T
        var_single = np.diagonal(back @ own_root, axis1=1, axis2=2) + (
            np.einsum("ij,ij->i", by_root, by_root).reshape(n, 3)
        )
        logdet -= 2 * float(np.log(np.diagonal(own_root, axis1=1, axis2=2)).sum())

        def rest() -> Rest:
            inverse, spread = root.T @ root, by_root @ root
            cross = -spread.T.reshape(dim, n, 3)
            own = ((back @ own_root) @ self.gauge.reshape(n, 3, -1)).reshape(3 * n, -1)
            along_gauge = own + spread @ (follow.T @ self.gauge)
            return Rest(
                self._with_offsets(inverse[:f, f:s], cross[:f]),
                self._variance(inverse[f:s, f:s], cross[f:s], var_single, along_gauge.reshape(n, 3, -1)),
                inverse[s:, s:].reshape(P, p, P, p)[np.arange(P), :6, np.arange(P), :6],
            )

        return Solved(
            x[:f], x[f:s], e, cost, logdet, variance[f:s], var_single, root[:, :f].T @ root[:, :f], rest
        )

    def _with_offsets(self, smooth: Array, single: Array) -> Array:
        """(f, n, 3) covariance between the cameras and the whole offsets."""
        return np.asarray(np.einsum("fm,nim->fni", smooth, self.prior.basis) + single)

    def _variance(self, smooth: Array, cross: Array, single: Array, single_gauge: Array) -> Array:
        """(n, 3) variance of the whole offsets, without the gauge: rotations, shifts and scale of all points.

        With G the orthonormal gauge directions, it is the diagonal of (I - G G^T) C (I - G G^T).
        """
        basis, G = self.prior.basis, self.gauge.reshape(self.n, 3, -1)
        diagonal = (
            ((basis @ smooth) * basis).sum(axis=2) + 2 * np.einsum("nim,mni->ni", basis, cross) + single
        )
        by_smooth = np.einsum("nim,nig->mg", basis, G)
        C_G = basis @ (smooth @ by_smooth + np.einsum("mni,nig->mg", cross, G))
        C_G += np.einsum("mni,mg->nig", cross, by_smooth) + single_gauge
        inner = np.einsum("nig,nih->gh", G, C_G)
        return np.asarray(diagonal - 2 * (G * C_G).sum(axis=2) + ((G @ inner) * G).sum(axis=2))


class Rest(NamedTuple):
    """Blocks of the covariance that are needed only for the final sizes.

    Attributes
    ----------
    camera_offsets : (f, n, 3) array
        Covariance between the cameras and the whole offsets.
    offset_variance : (n, 3) array
        Variance of the whole offsets, without the gauge.
    poses : (P, 6, 6) array, optional
        Covariance of each pose.
    """

    camera_offsets: Array
    offset_variance: Array
    poses: Array | None


@frozen_dataclass(eq=False)
class Solved:
    """The minimum of the quadratic, and blocks of the inverse of its matrix.

    Attributes
    ----------
    camera : (f,) array
        Step of the cameras.
    smooth : (m,) array
        Coefficients of the smooth parts.
    single : (n, 3) array
        Offsets of the single points' parts.
    cost : float
    logdet : float
        Log determinant of the whole matrix.
    smooth_variance, single_variance : (m,), (n, 3) array
    camera_covariance : (f, f) array
    rest : callable
        Computes further blocks.
    """

    camera: Array
    smooth: Array
    single: Array
    cost: float
    logdet: float
    smooth_variance: Array
    single_variance: Array
    camera_covariance: Array
    rest: Callable[[], Rest]


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

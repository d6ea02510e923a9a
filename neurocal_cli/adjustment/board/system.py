"""Solve the normal equations of cameras, poses and offsets for given sizes of the prior's parts.

The Schur complement eliminates the poses or the points block by block, and the remaining system is dense. So
the work grows linearly with the number of views or of points.

- `PosesFirst` leaves the cameras and the whole offsets (`WithoutPoses`). Their coordinates are those in which
  the prior is diagonal whatever its sizes, so that a change of the sizes changes only the matrix's diagonal.
- `PointsFirst` leaves the cameras, the poses and the coefficients of the smooth parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, cached_property
from itertools import product

import numpy as np

from neurocal_cli.adjustment.board.information import Information
from neurocal_cli.adjustment.board.prior import Gauge, Parts, Prior, coordinates_of
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


class WithoutPoses:
    """Information with the poses eliminated; results for different views can be added.

    `rows` (P p, f + 3 n + 1) are the inverses of the lower triangular Cholesky factors of the poses' matrices
    times the coupling to cameras, offsets and the right side. `logdet` is the log determinant of the poses'
    part.
    """

    def __init__(self, info: Information) -> None:
        self.info, (P, p), d = info, info.pose_point.shape[:2], 3 * len(info.point)
        root, cross = np.linalg.inv(np.linalg.cholesky(info.cameras.own)), info.cameras.cross
        f = len(info.cameras.shared) - 1
        rows = np.empty((P, p, f + d + 1))
        np.matmul(root, cross[:, :, :-1], out=rows[:, :, :f])
        np.matmul(root, info.pose_point.reshape(P, p, d), out=rows[:, :, f:-1])
        np.matmul(root, cross[:, :, -1:], out=rows[:, :, -1:])
        self.rows = rows.reshape(P * p, f + d + 1)
        self.logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())

    @cached_property
    def matrix(self) -> Array:
        """(f + 3 n + 1, f + 3 n + 1) reduced matrix, bordered by the right side and the cost."""
        info, f, n = self.info, len(self.info.cameras.shared) - 1, len(self.info.point)
        M = self.rows.T @ self.rows
        np.negative(M, out=M)
        at = np.append(np.arange(f), len(M) - 1)
        M[np.ix_(at, at)] += info.cameras.shared
        across = info.by_camera.reshape(3 * n, f + 1)
        M[f:-1, at] += across
        M[at, f:-1] += across.T
        blocks = M[f:-1, f:-1].reshape(n, 3, n, 3)
        np.einsum("ninj->nij", blocks)[...] += info.point
        return np.asarray(M)

    def at(self, offsets: Array) -> tuple[Array, Array, Array]:
        """The cameras' matrix (f, f), right sides (f, k) and costs (k,) for given offsets (k, n, 3)."""
        info, shared, k = self.info, self.info.cameras.shared, len(offsets)
        f = len(shared) - 1
        flat = offsets.reshape(k, -1).T
        by_camera, left = self.rows[:, :f], self.rows[:, -1:] - self.rows[:, f:-1] @ flat
        by_point = (info.point @ offsets[..., None])[..., 0] - 2 * info.by_camera[..., -1]
        right = shared[:-1, -1:] - info.by_camera[..., :-1].reshape(len(flat), f).T @ flat
        return (
            shared[:-1, :-1] - by_camera.T @ by_camera,
            right - by_camera.T @ left,
            info.cost + (offsets * by_point).sum(axis=(1, 2)) - (left**2).sum(axis=0),
        )


_SMALL = 32  # largest matrix whose Cholesky factor is inverted directly; others are split in halves
_RIDGE = 1e-10  # added to a unit diagonal if rounding has made a matrix indefinite
# Offsets over poses and smooth coefficients, up to which eliminating the poses is faster. On boards of 54 to
# 300 points in 8 to 60 views, both take the same time at 1.7; at 0.75 and 3.9 one takes three times as long.
_AS_FAST = 1.75


@frozen_dataclass(eq=False)
class Solved:
    """The minimum of the quadratic, and the covariance for unit noise."""

    camera_step: Array  # (f,)
    offsets: Callable[[], Array]  # (n, 3) whole offsets
    cost: float
    logdet: float  # log determinant of the whole matrix over that of the prior's precisions
    parts: Callable[[], Parts]
    camera: Array  # (f, f) covariance of the cameras
    joint: Callable[[], JointCovariance]


@frozen_dataclass(eq=False)
class JointCovariance:
    """Covariance of cameras, offsets and poses for unit noise.

    The covariance of two unknowns is the product of their columns in the roots. To that of the offsets of
    one point, `own` is added. The poses follow by the quadratic.
    """

    camera_root: Array  # (d, f)
    offset_root: Array  # (d, 3 n)
    own: Array  # (n, 3, 3)
    info: Information

    def offset_variance(self, gauge: Gauge) -> Array:
        """(n, 3) variance of the offsets with the gauge held.

        With the directions G and H^T offsets = 0, it is the diagonal of (1 - G H^T) C (1 - H G^T).
        """
        root = self.offset_root - (self.offset_root @ gauge.held) @ gauge.directions.T
        G, H = self._of_points(gauge.directions), self._of_points(gauge.held)
        own = self.own @ H
        inner = np.einsum("nig,nih->gh", H, own)
        by_own = np.diagonal(self.own, axis1=1, axis2=2) + ((G @ inner - 2 * own) * G).sum(axis=2)
        return np.asarray(np.einsum("ij,ij->j", root, root).reshape(-1, 3) + by_own)

    def _of_points(self, gauge: Array) -> Array:
        return gauge.reshape(*self.own.shape[:2], -1)

    def poses(self, gauge: Gauge) -> Array:
        """(P, 6, 6) covariance of each pose of a target whose gauge is held."""
        by_gauge, own = self.offset_root @ gauge.held, self.own @ self._of_points(gauge.held)
        of_gauge = np.linalg.inv(by_gauge.T @ by_gauge + gauge.held.T @ own.reshape(gauge.held.shape))
        cameras, pose_point = self.info.cameras, self.info.pose_point
        inverse = np.linalg.inv(cameras.own)[:, :6]
        by_points = (inverse @ pose_point.reshape(*pose_point.shape[:2], -1)).reshape(-1, 6, *own.shape[:2])
        flat = by_points.reshape(-1, self.offset_root.shape[1])
        root = ((inverse @ cameras.cross[:, :, :-1]) @ self.camera_root.T).reshape(-1, 6, len(by_gauge))
        root += (flat @ self.offset_root.T).reshape(root.shape)
        across = root @ by_gauge + (flat @ own.reshape(gauge.held.shape)).reshape(len(root), 6, -1)
        alone = inverse[:, :, :6] + np.einsum(
            "vqni,nij,vrnj->vqr", by_points, self.own, by_points, optimize=True
        )
        return np.asarray(
            alone + root @ np.swapaxes(root, 1, 2) - across @ of_gauge @ np.swapaxes(across, 1, 2)
        )


def system_of(info: Information, prior: Prior) -> PosesFirst | PointsFirst:
    """The quadratic in the whole offsets along each point's axes, with its prior, as it is solved faster."""
    if points_first(info.cameras.cross[..., -1].size, prior):
        return PointsFirst(info, prior)
    whole = WithoutPoses(info)
    return PosesFirst(info, prior, whole.matrix, whole.logdet)


def points_first(of_poses: int, prior: Prior) -> bool:
    """Whether it is faster to eliminate the points than the poses, which have this number of unknowns."""
    n, _, m = prior.basis.shape
    return 3 * n > _AS_FAST * (m + of_poses)


class PosesFirst:
    """The system with the poses eliminated: cameras and independent coordinates of the offsets.

    `matrix` and `of_poses` are the matrix and the log determinant of `WithoutPoses`.
    Everything independent of the sizes is computed once.
    """

    def __init__(self, info: Information, prior: Prior, matrix: Array, of_poses: float) -> None:
        self.info, self.coordinates, self.f = info, coordinates_of(prior), len(info.cameras.shared) - 1
        self.of_poses = of_poses
        M = self._by_coordinates(self._by_coordinates(matrix).T)
        hold_untold(M, self.f)
        self.matrix, self.right, self.given_cost = M[:-1, :-1], M[:-1, -1], float(M[-1, -1])

    def _by_coordinates(self, rows: Array) -> Array:
        """Rows by cameras, coordinates and right side, instead of by cameras, offsets and right side."""
        f = self.f
        return np.concatenate([rows[:f], self.coordinates.of_rows(rows[f:-1]), rows[-1:]])

    def solve(self, ratios: Mapping[str, float]) -> Solved:
        """Solve for given sizes of the parts, in units of the noise's standard deviation."""
        f, coordinates = self.f, self.coordinates
        variances = coordinates.variances(ratios)
        root, logdet = _root_of_inverse(self.matrix + np.diag(np.append(np.zeros(f), 1.0 / variances)))
        half, camera, own = root @ self.right, root[:, :f], root[:, f:]
        x = half @ root

        def parts() -> Parts:
            prior = coordinates.units * coordinates.prior.as_array(ratios) ** 2
            found = np.einsum("ij,ij->j", own, own)
            return Parts.of(prior, x[f:], found, lambda factors: _squared(own @ factors))

        return Solved(
            x[:f], lambda: coordinates.offsets(x[f:]), self.given_cost - float(half @ half),
            logdet + self.of_poses + float(np.log(variances).sum()),
            cache(parts), camera.T @ camera, cache(lambda: self._joint(root)),
        )  # fmt: skip

    def _joint(self, root: Array) -> JointCovariance:
        n = len(self.coordinates.prior.axes)
        offsets = self.coordinates.offsets(root[:, self.f :]).reshape(len(root), 3 * n)
        return JointCovariance(root[:, : self.f], offsets, np.zeros((n, 3, 3)), self.info)


class PointsFirst:
    """The system with the points eliminated: cameras, coefficients of the smooth parts and poses.

    Everything independent of the sizes is computed once. `s` is the number of camera parameters and
    smooth coefficients.
    """

    def __init__(self, info: Information, prior: Prior) -> None:
        self.info, self.prior = info, prior
        self.n, (self.P, self.p) = len(info.point), info.pose_point.shape[:2]
        self.f, self.m = len(info.cameras.shared) - 1, prior.basis.shape[2]
        self.s = self.f + self.m
        basis, shared, cross = prior.basis, info.cameras.shared, info.cameras.cross
        by_basis = info.point @ basis  # (n, 3, m)
        flat = basis.reshape(3 * self.n, self.m)
        across = info.by_camera.reshape(3 * self.n, self.f + 1).T @ flat
        inner = flat.T @ by_basis.reshape(3 * self.n, self.m)
        pose_basis = info.pose_point.reshape(self.P * self.p, 3 * self.n) @ flat
        # The matrix of cameras, smooth parts and poses before points are eliminated, bordered by the right
        # side and the cost.
        s, dim = self.s, self.s + self.p * self.P
        M = np.zeros((dim + 1, dim + 1))
        M[:s, :s] = np.block([[shared[:-1, :-1], across[:-1]], [across[:-1].T, inner]])
        M[s:dim, : self.f], M[s:dim, self.f : s] = cross[:, :, :-1].reshape(dim - s, self.f), pose_basis
        M[:s, s:dim] = M[s:dim, :s].T
        at = s + self.p * np.arange(self.P)
        for i, j in product(range(self.p), repeat=2):
            M[at + i, at + j] = info.cameras.own[:, i, j]
        M[: self.f, -1], M[self.f : s, -1] = shared[:-1, -1], across[-1]
        M[s:dim, -1], M[-1, -1] = cross[:, :, -1].reshape(-1), info.cost
        M[-1, :dim] = M[:dim, -1]
        hold_untold(M, self.f)
        self.bordered = M
        # (n, 3, s + P p + 1): coupling of each point to all other unknowns and to the right side
        poses = np.moveaxis(info.pose_point, 2, 0).reshape(self.n, self.p * self.P, 3).swapaxes(1, 2)
        by_camera, right = info.by_camera[..., :-1], info.by_camera[..., -1:]
        self.by_point = np.concatenate([by_camera, by_basis, poses, right], axis=2)

    def solve(self, ratios: Mapping[str, float]) -> Solved:
        """Solve for given sizes of the parts, in units of the noise's standard deviation."""
        f, s, n = self.f, self.s, self.n
        of_smooth, of_single = self.prior.variances(ratios)
        own_root = np.linalg.inv(np.linalg.cholesky(self.info.point + np.eye(3) / of_single[:, :, None]))
        rows = own_root @ self.by_point
        flat = rows.reshape(3 * n, -1)
        M, at = self.bordered - flat.T @ flat, np.arange(f, s)
        M[at, at] += 1.0 / of_smooth
        root, of_rest = _root_of_inverse(M[:-1, :-1])
        of_points = -2 * np.log(np.diagonal(own_root, axis1=1, axis2=2)).sum()
        logdet = float(of_rest + of_points + np.log(of_smooth).sum() + np.log(of_single).sum())
        half = root @ M[:-1, -1]
        x, back = half @ root, np.swapaxes(own_root, 1, 2)
        # Back-substitution of the points: their response to all other unknowns.
        e = (back @ (rows[:, :, -1] - rows[:, :, :-1] @ x)[..., None])[..., 0]
        camera, smooth, own = root[:, :f], root[:, f:s], back @ own_root
        single = cache(lambda: root @ -(back @ rows[:, :, :-1]).reshape(3 * n, len(x)).T)

        def joint() -> JointCovariance:
            offsets = single() + smooth @ self.prior.basis.reshape(3 * n, -1).T
            return JointCovariance(camera, offsets, own, self.info)

        def parts() -> Parts:
            free = np.concatenate([smooth, single()], axis=1)
            variances = np.einsum("ij,ij->j", free, free)
            variances[s - f :] += np.diagonal(own, axis1=1, axis2=2).ravel()

            def covariance(factors: Array) -> Array:
                of_points = factors[s - f :].reshape(n, 3, -1)
                by_points = np.tensordot(of_points, own @ of_points, axes=((0, 1), (0, 1)))
                return _squared(free @ factors) + by_points

            prior = self.prior.units * self.prior.as_array(ratios) ** 2
            return Parts.of(prior, np.concatenate([x[f:s], e.ravel()]), variances, covariance)

        return Solved(
            x[:f], lambda: self.prior.basis @ x[f:s] + e, float(M[-1, -1] - half @ half), logdet,
            cache(parts), camera.T @ camera, joint,
        )  # fmt: skip


def hold_untold(M: Array, f: int) -> None:
    """Let those of the f parameters of cameras that no view tells stay as they are.

    Of few views, a camera of several may have none.
    """
    untold = np.flatnonzero(np.diagonal(M)[:f] == 0)
    M[untold, untold] = 1.0


def _squared(rows: Array) -> Array:
    """Products of the columns."""
    return np.asarray(rows.T @ rows)


def _root_of_inverse(M: Array) -> tuple[Array, float]:
    """A factor R of the inverse R^T R, and the log determinant of the matrix."""
    root = np.zeros_like(M)
    try:
        _fill_root(M, root)
    except np.linalg.LinAlgError:  # nearly degenerate coefficients, such as xi and alpha
        _fill_root(M + np.diag(_RIDGE * np.diagonal(M)), root)
    return root, -2 * float(np.log(np.diagonal(root)).sum())


def _fill_root(M: Array, root: Array) -> None:
    """The inverse of the Cholesky factor, by halves; 400 rows take two thirds of the time of NumPy's way."""
    n, h = len(M), len(M) // 2
    if n <= _SMALL:
        root[...] = np.linalg.inv(np.linalg.cholesky(M))
        return
    first, last = root[:h, :h], root[h:, h:]
    _fill_root(M[:h, :h], first)
    L = M[h:, :h] @ first.T
    _fill_root(M[h:, h:] - L @ L.T, last)
    np.matmul(-last, L @ first, out=root[h:, :h])

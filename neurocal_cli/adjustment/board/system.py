"""Solve the normal equations of cameras, poses and offsets for given sizes of the prior's parts.

The Schur complement eliminates the poses or the points block by block, and the remaining system is dense. So
the work grows linearly with the number of views or of points.

- Without the poses, the cameras and the whole offsets are left (`WithoutPoses`). Their coordinates are those
  in which the prior is diagonal whatever its sizes, so that other sizes change only the matrix's diagonal.
- Without the points, the cameras, the poses and the coefficients of the smooth parts are left.
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


def points_first(of_poses: int, prior: Prior) -> bool:
    """Whether it is faster to eliminate the points than the poses, which have this number of unknowns."""
    n, _, m = prior.basis.shape
    return 3 * n > _AS_FAST * (m + of_poses)


@frozen_dataclass(eq=False)
class System:
    """The quadratic in the cameras, coordinates of the offsets and single points, with their prior.

    Everything independent of the sizes is computed once. The single points are eliminated at each solution;
    if the poses were eliminated before, there are none, and all offsets follow from the coordinates.
    """

    info: Information
    prior: Prior
    units: Array  # (m + 3 s, G) prior variances of m coordinates and s single points for parts of size 1
    offsets: Callable[[Array], Array]  # (..., n, 3) whole offsets of these (..., m + 3 s)
    # Matrix of the cameras, the coordinates and the poses, if these are left, before points are eliminated;
    # bordered by the right side and the cost.
    bordered: Array
    by_point: Array  # (s, 3, ...) coupling of each single point to all of them and to the right side
    of_poses: float = 0.0  # log determinant of the poses' part, if they are eliminated

    def solve(self, ratios: Mapping[str, float]) -> Solved:
        """Solve for given sizes of the parts, in units of the noise's standard deviation."""
        f, n, width = len(self.info.cameras.shared) - 1, len(self.by_point), len(self.bordered)
        prior = self.units * self.prior.as_array(ratios) ** 2
        variances = prior.sum(axis=1)
        s = f + len(variances) - 3 * n
        of_single = variances[s - f :].reshape(n, 3)
        own_root = np.linalg.inv(np.linalg.cholesky(self.info.point[:n] + np.eye(3) / of_single[:, :, None]))
        rows = own_root @ self.by_point
        flat = rows.reshape(3 * n, width)
        M, at = self.bordered - flat.T @ flat, np.arange(f, s)
        M[at, at] += 1.0 / variances[: s - f]
        root, of_rest = _root_of_inverse(M[:-1, :-1])
        of_points = -2 * np.log(np.diagonal(own_root, axis1=1, axis2=2)).sum()
        half = root @ M[:-1, -1]
        x, back = half @ root, np.swapaxes(own_root, 1, 2)
        own, camera = back @ own_root, root[:, :f]
        # Back-substitution of the points: their response to all other unknowns.
        e = (back @ (rows[:, :, -1] - rows[:, :, :-1] @ x)[..., None])[..., 0]
        found = np.concatenate([x[f:s], e.ravel()])

        @cache
        def free() -> Array:
            single = -(back @ rows[:, :, :-1]).reshape(3 * n, width - 1)
            return np.concatenate([root[:, f:s], root @ single.T], axis=1)

        def joint() -> JointCovariance:
            of_all = np.zeros((len(self.info.point), 3, 3))
            of_all[:n] = own
            return JointCovariance(camera, self.offsets(free()).reshape(len(root), -1), of_all, self.info)

        def parts() -> Parts:
            spread = np.einsum("ij,ij->j", free(), free())
            spread[s - f :] += np.diagonal(own, axis1=1, axis2=2).ravel()

            def covariance(factors: Array) -> Array:
                of_points = factors[s - f :].reshape(n, 3, factors.shape[1])
                by_points = np.tensordot(of_points, own @ of_points, axes=((0, 1), (0, 1)))
                return _squared(free() @ factors) + by_points

            return Parts.of(prior, found, spread, covariance)

        return Solved(
            x[:f], lambda: self.offsets(found), float(M[-1, -1] - half @ half),
            float(of_rest + of_points + np.log(variances).sum()) + self.of_poses,
            cache(parts), camera.T @ camera, cache(joint),
        )  # fmt: skip


def system_of(info: Information, prior: Prior) -> System:
    """The quadratic in the whole offsets along each point's axes, with its prior, as it is solved faster."""
    if points_first(info.cameras.cross[..., -1].size, prior):
        return with_single_points(info, prior)
    coordinates, f, whole = coordinates_of(prior), len(info.cameras.shared) - 1, WithoutPoses(info)

    def by_coordinates(rows: Array) -> Array:
        """Rows by cameras, coordinates and right side, instead of by cameras, offsets and right side."""
        return np.concatenate([rows[:f], coordinates.of_rows(rows[f:-1]), rows[-1:]])

    M = by_coordinates(by_coordinates(whole.matrix).T)
    hold_untold(M, f)
    no_points = np.zeros((0, 3, len(M)))
    return System(info, prior, coordinates.units, coordinates.offsets, M, no_points, whole.logdet)


def with_single_points(info: Information, prior: Prior) -> System:
    """The system of the smooth parts, single points and poses."""
    n, (P, p) = len(info.point), info.pose_point.shape[:2]
    f, m = len(info.cameras.shared) - 1, prior.basis.shape[2]
    basis, shared, cross = prior.basis, info.cameras.shared, info.cameras.cross
    by_basis = info.point @ basis  # (n, 3, m)
    flat = basis.reshape(3 * n, m)
    across = info.by_camera.reshape(3 * n, f + 1).T @ flat
    inner = flat.T @ by_basis.reshape(3 * n, m)
    s, dim = f + m, f + m + p * P
    M = np.zeros((dim + 1, dim + 1))
    M[:s, :s] = np.block([[shared[:-1, :-1], across[:-1]], [across[:-1].T, inner]])
    M[s:dim, :f] = cross[:, :, :-1].reshape(dim - s, f)
    M[s:dim, f:s] = info.pose_point.reshape(dim - s, 3 * n) @ flat
    M[:s, s:dim] = M[s:dim, :s].T
    at = s + p * np.arange(P)
    for i, j in product(range(p), repeat=2):
        M[at + i, at + j] = info.cameras.own[:, i, j]
    M[:f, -1], M[f:s, -1] = shared[:-1, -1], across[-1]
    M[s:dim, -1], M[-1, -1] = cross[:, :, -1].reshape(-1), info.cost
    M[-1, :dim] = M[:dim, -1]
    hold_untold(M, f)
    poses = np.moveaxis(info.pose_point, 2, 0).reshape(n, p * P, 3).swapaxes(1, 2)
    by_point = [info.by_camera[..., :-1], by_basis, poses, info.by_camera[..., -1:]]

    def offsets(free: Array) -> Array:
        return np.asarray((free[..., :m] @ flat.T + free[..., m:]).reshape(*free.shape[:-1], n, 3))

    return System(info, prior, prior.units, offsets, M, np.concatenate(by_point, axis=2))


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

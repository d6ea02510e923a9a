"""Least-squares points in space from their pixels in two cameras or more, some thousand at a time.

A point is C + B (x, y, 1) / w, where C is the centre of the first camera that saw it, and the third column of
B its axis or, of a wide lens, the ray of the pixel. So x and y follow from the first image alone, w is one
over the distance, in which the other images are nearly linear, and two or three steps of Gauss-Newton lead to
points at any distance up to infinity. Halved steps do for damping: the iteration is not that of
`adjustment.levenberg_marquardt`, and its equations are written out over all points, which takes a fraction of
the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.directions import project_directions
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import nearly_undistorted
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.projection import image_points_with_jacobian, normalised_points

BLOCK = 4096
"""Points at a time, whose arrays stay in the processor's cache."""
_MAX_STEPS, _HALVINGS = 30, 8
_SMALL_STEP = 1e-9  # px; a smaller change of all images ends the iteration
# A rise of the squared error by less, as a factor and in px^2, is rounding.
_RISE, _ROUNDING = 1 + 1e-9, 1e-15
Rows = Sequence[Sequence[Any]]

_TERMS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))


def in_noise(camera: Camera, noise: float) -> Camera:
    """The camera of pixels that are divided by their noise, so that a pixel of each camera counts alike."""
    if noise == 1:
        return camera
    return replace(camera, intrinsics=Intrinsics.from_matrix(camera.A / [[noise], [noise], [1.0]]))


@frozen_dataclass(eq=False)
class Sighting:
    """The pixels of some points in one camera."""

    camera: Camera
    pose: Array  # (3, 4, m), or (3, 4, 1) of all: [R | t], X_camera = R X + t
    pixels: Array  # (m, 2)
    at: NDArray[np.intp] | slice  # (m,) which points they are

    @cached_property
    def rays(self) -> Array:
        """(3, m) unit viewing directions in the camera's frame."""
        return self.camera.unproject(self.pixels).T

    @property
    def near_rays(self) -> Sequence[Array | float]:
        """The same, nearly and of any length."""
        if self.camera.distortion.wide:
            return tuple(self.rays)
        seen = normalised_points(self.camera.entries, *self.pixels.T)
        return *nearly_undistorted(self.camera.distortion, *seen), 1.0

    def images(self, rows: Rows | None, x: Array, y: Array, w: Array) -> tuple[Array, Array, Any, Any]:
        """Pixels u, v of points, their derivatives by x, y and w, and which of them it sees.

        `rows` are the point in the camera's frame, times w, by x, y, 1 and w; None of (x, y, 1) itself, whose
        image does not depend on w.
        """
        camera = self.camera
        (a, s, b, u0, v0), model, k = camera.entries, camera.model, camera.distortion.coefficients
        if rows is None:
            u, v, _, _, (ux, uy, vx, vy), _ = image_points_with_jacobian(camera.entries, model, k, x, y)
            return u, v, ((ux, vx), (uy, vy), ()), True
        X, Y, Z = (row[0] * x + row[1] * y + row[2] + row[3] * w for row in rows)
        if camera.distortion.wide:
            x, y, by_x, by_y, _, fine = project_directions(model, k, X, Y, Z, by_coefficients=False)
            fine &= X * self.rays[0] + Y * self.rays[1] + Z * self.rays[2] > 0  # a ray has one side only
            by = []
            for column in _columns(rows):
                dx, dy = (sum(d * along for d, along in zip(ds, column, strict=True)) for ds in (by_x, by_y))
                by.append((a * dx + s * dy, b * dy))
            return a * x + s * y + u0, b * y + v0, by, fine
        q = 1.0 / Z
        x, y = X * q, Y * q
        u, v, _, _, (ux, uy, vx, vy), _ = image_points_with_jacobian(camera.entries, model, k, x, y)
        by = []
        for across, along, down in _columns(rows):
            dx, dy = (across - x * down) * q, (along - y * down) * q
            by.append((ux * dx + uy * dy, vx * dx + vy * dy))
        return u, v, by, Z > 0

    def misses(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(m,) squared distances of the pixels from the images of points (m, 3), and which it sees."""
        own = np.einsum("ijn,nj->ni", self.pose[:, :3], points) + self.pose[:, 3].T
        projected, fine = self.camera.project(own)
        return ((self.pixels - projected) ** 2).sum(axis=1), fine & ((own * self.rays.T).sum(axis=1) > 0)


class SightedPoints:
    """n points, and what each camera sees of them: the first one all."""

    def __init__(self, n: int, seen: Sequence[Sighting]) -> None:
        self.n, self.seen = n, seen
        first = seen[0]
        turn = np.swapaxes(first.pose[:, :3], 0, 1)
        by_axis = not first.camera.distortion.wide
        self.B = turn if by_axis else np.einsum("ijn,jkn->ikn", turn, _basis(first.rays))
        self.C = -np.einsum("ijn,jn->in", turn, first.pose[:, 3])
        # Of each camera, see `Sighting.images`.
        self.through = [None if by_axis else self._through(first), *map(self._through, seen[1:])]

    def _through(self, one: Sighting) -> Rows:
        """Numbers are faster than arrays of one."""
        B, C = (whole if whole.shape[-1] == 1 else whole[..., one.at] for whole in (self.B, self.C))
        R, t = one.pose[:, :3], one.pose[:, 3]
        turned, moved = np.einsum("ijn,jkn->ikn", R, B), np.einsum("ijn,jn->in", R, C) + t
        n = max(turned.shape[-1], moved.shape[-1])
        both = np.concatenate(
            [np.broadcast_to(turned, (3, 3, n)), np.broadcast_to(moved, (3, n))[:, None]], 1
        )
        return list(both[..., 0].tolist() if n == 1 else both)

    def fitted(self) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Least-squares points (n, 3), covariances (n, 6), squared errors, and which points are behind.

        They are nan for points that the pixels do not determine.
        """
        q = self._start()
        lost = ~np.isfinite(q).all(axis=0)
        q[:, lost] = 1.0  # any finite values
        N, seen = self._normal(q)
        for _ in range(_MAX_STEPS):
            step = _solved(N)
            if not _length(N, step).max(initial=0.0) > _SMALL_STEP:
                break
            trial, cost = self._normal(q + step), N[9]
            for _ in range(_HALVINGS):
                if not (worse := ~(trial[0][9] <= cost * _RISE + _ROUNDING)).any():
                    break
                step[:, worse] *= 0.5
                trial = self._normal(q + step)
            else:
                step[:, ~(trial[0][9] <= cost * _RISE + _ROUNDING)] = 0.0
                trial = self._normal(q + step)
            q, (N, seen) = q + step, trial
        points, covariance = self._in_space(q, _inverse(N))
        lost |= ~np.isfinite(points).all(axis=1) | ~np.isfinite(covariance).all(axis=1)
        points[lost], covariance[lost], N[9, lost] = np.nan, np.nan, np.nan
        return points, covariance, N[9], lost | ~seen | ~(q[2] > 0)

    def _start(self) -> Array:
        """(3, n) x, y and w near the minimum; not finite where there is none."""
        first, q = self.seen[0], np.zeros((3, self.n))
        if not first.camera.distortion.wide:
            q[0], q[1], _ = first.near_rays
        above, below = np.zeros((2, self.n))
        # At the distance along the first ray whose images are nearest to the other rays.
        for one, rows in zip(self.seen[1:], self.through[1:], strict=True):
            assert rows is not None
            x, y = q[:2, one.at]
            near, ray = [row[0] * x + row[1] * y + row[2] for row in rows], one.near_rays
            for i, j in ((1, 2), (2, 0), (0, 1)):
                across = near[i] * ray[j] - near[j] * ray[i]
                along = rows[i][3] * ray[j] - rows[j][3] * ray[i]
                above[one.at] -= across * along
                below[one.at] += along * along
        q[2] = above / below
        return q

    def _normal(self, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Normal equations (10, n) of x, y, w and the residual (`_TERMS`), and which points all see."""
        N, seen = np.zeros((10, self.n)), np.ones(self.n, dtype=bool)
        for one, rows in zip(self.seen, self.through, strict=True):
            u, v, by, fine = one.images(rows, *q[:, one.at])
            J = [*by, (one.pixels[:, 0] - u, one.pixels[:, 1] - v)]
            for row, (i, j) in zip(N, _TERMS, strict=True):
                if J[i] and J[j]:
                    term = J[i][0] * J[j][0]
                    term += J[i][1] * J[j][1]
                    row[one.at] += term
            seen[one.at] &= fine
        return N, seen

    def _in_space(self, q: Array, inverse: Sequence[Array]) -> tuple[Array, Array]:
        """Points (n, 3) and their covariances (n, 6) from those of x, y and w."""
        xx, xy, xw, yy, yw, ww = inverse
        Z = 1.0 / q[2]
        X, Y, Z2 = q[0] * Z, q[1] * Z, Z * Z
        # d(X, Y, Z) = Z (dx - X dw, dy - Y dw, -Z dw).
        own = np.stack([
            Z2 * (xx - 2 * X * xw + X * X * ww), Z2 * (xy - Y * xw - X * yw + X * Y * ww),
            Z2 * Z * (X * ww - xw), Z2 * (yy - 2 * Y * yw + Y * Y * ww), Z2 * Z * (Y * ww - yw), Z2 * Z2 * ww,
        ])  # fmt: skip
        points = np.stack([X, Y, Z])
        if self.C.any() or self.B.shape[2] > 1 or (self.B[:, :, 0] != np.eye(3)).any():
            whole = own[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
            a, b = np.triu_indices(3)
            own = np.einsum("ijn,jkn,lkn->iln", self.B, whole, self.B, optimize=True)[a, b]
            points = np.einsum("ijn,jn->in", self.B, points) + self.C
        return points.T.copy(), own.T.copy()


def _columns(rows: Rows) -> list[list[Any]]:
    """Those of x, y and w."""
    return [[row[k] for row in rows] for k in (0, 1, 3)]


def _basis(rays: Array) -> Array:
    """(3, 3, n) right-handed unit vectors, the third of which is the ray (3, n)."""
    # The coordinate axis that is most across the ray.
    first = np.cross(np.eye(3)[np.argmin(np.abs(rays), axis=0)], rays.T)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first.T, np.cross(rays.T, first).T, rays], axis=1)


def _solved(N: Array) -> Array:
    """(3, n) steps of x, y, w by a written-out Cholesky factorisation; 0 where there is none."""
    a, b, c, d, e, f, gx, gy, gw, _ = N
    l10, l20 = b / a, c / a
    d1 = d - l10 * b
    e1 = e - l10 * c
    l21 = e1 / d1
    f2 = f - l20 * c - l21 * e1
    gy = gy - l10 * gx
    w = (gw - l20 * gx - l21 * gy) / f2
    y = gy / d1 - l21 * w
    step = np.stack([gx / a - l10 * y - l20 * w, y, w])
    step[:, ~np.isfinite(step).all(axis=0)] = 0.0
    return step


def _length(N: Array, step: Array) -> Array:
    """Change of the images by a step [px]: its length in the metric of the normal matrix."""
    a, b, c, d, e, f = N[:6]
    x, y, w = step
    return np.sqrt(np.abs(x * (a * x + 2 * (b * y + c * w)) + y * (d * y + 2 * e * w) + f * w * w))


def _inverse(N: Array) -> list[Array]:
    """Entries xx, xy, xw, yy, yw, ww of the inverse of each symmetric 3 x 3 matrix."""
    a, b, c, d, e, f = N[:6]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    return [A / det, B / det, C / det, (a * f - c * c) / det, (b * c - a * e) / det, (a * d - b * b) / det]

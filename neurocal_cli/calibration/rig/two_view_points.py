"""Least-squares points of two ordinary cameras, some thousand at a time.

Gauss-Newton estimates the point as (x, y, 1) / w. Its left image depends on x and y alone, and its right
image is nearly linear in w at any distance up to infinity, so two or three steps are enough. It is the
iteration of `many_views.Sightings` with the equations written out over all points, which takes a fraction of
its time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import nearly_undistorted
from neurocal_cli.camera.projection import image_points_with_jacobian, normalised_points

_MAX_STEPS = 30
_SMALL_STEP = 1e-9  # px; a smaller change of all images ends the iteration
# A rise of the squared error by less, as a factor and in px^2, is rounding.
_RISE, _ROUNDING = 1 + 1e-9, 1e-18


class PointBatch:
    """Some thousand points, all arrays (n,).

    The rig (3, 4, n) or (3, 4, 1) is [R | t] of each point, or of all. The pixels are (2, n).
    """

    def __init__(self, cameras: tuple[Camera, Camera], rig: Array, left: Array, right: Array) -> None:
        self.cameras, self.pixels = cameras, (left, right)
        # Plain numbers for a common rig are faster than arrays of one element.
        entries = rig[..., 0].tolist() if rig.shape[2] == 1 else rig
        self.R, self.t = [row[:3] for row in entries], [row[3] for row in entries]

    def _image(self, side: int, x: Array, y: Array) -> tuple[Array, Array, tuple[Any, Any, Any, Any]]:
        """Pixels of normalised points in one image, and du/dx, du/dy, dv/dx, dv/dy."""
        camera = self.cameras[side]
        image = image_points_with_jacobian(camera.entries, camera.model, camera.distortion.coefficients, x, y)
        return image.u, image.v, image.by_point

    def _turned(self, x: Array, y: Array) -> list[Array]:
        """R (x, y, 1), the direction of the left ray in the right camera's frame."""
        return [row[0] * x + row[1] * y + row[2] for row in self.R]

    def optimal(self) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Least-squares points (n, 3), covariances (n, 6), epipolar errors, and which points are behind."""
        x, y, w = self._start()
        left_out = ~np.isfinite(x + w)
        x[left_out], y[left_out], w[left_out] = 0.0, 0.0, 1.0  # any finite values
        N, cost = self._normal(x, y, w)
        for _ in range(_MAX_STEPS):
            step = _solve(N)
            moved = _step_length(N, step)
            if not moved.max(initial=0.0) > _SMALL_STEP:
                break
            x, y, w, N, cost = self._descend((x, y, w), step, N, cost)
        points = np.stack([x / w, y / w, 1 / w], axis=1)
        covariance = _point_covariance(_inverse_entries(N), x, y, w)
        depth = self.R[2][0] * x + self.R[2][1] * y + self.R[2][2] + w * self.t[2]  # in the right camera
        behind = left_out | ~(w > 0) | ~(depth > 0)
        epipolar = np.sqrt(cost)
        points[left_out], covariance[left_out], epipolar[left_out] = np.nan, np.nan, np.nan
        return points, covariance, epipolar, behind

    def _start(self) -> tuple[Array, Array, Array]:
        """x, y and w near the minimum; not finite where there is none."""
        (x, y), right = (
            nearly_undistorted(camera.distortion, *normalised_points(camera.entries, *pixels))
            for camera, pixels in zip(self.cameras, self.pixels, strict=True)
        )
        return x, y, self._nearest_w(x, y, *right)

    def _descend(
        self, state: tuple[Array, Array, Array], step: list[Array], N: list[Array], cost: Array
    ) -> tuple[Array, Array, Array, list[Array], Array]:
        """One step of each point, halved where it raises the error."""
        x, y, w = (value + change for value, change in zip(state, step, strict=True))
        N_new, new = self._normal(x, y, w)
        length = 1.0
        while (worse := ~(new <= cost * _RISE + _ROUNDING)).any() and length > 1e-3:
            length *= 0.5
            x, y, w = (
                np.where(worse, value + length * change, now)
                for value, change, now in zip(state, step, (x, y, w), strict=True)
            )
            N_new, new = self._normal(x, y, w)
        if worse.any():
            x, y, w = (np.where(worse, old, now) for old, now in zip(state, (x, y, w), strict=True))
            N_new, new = (
                [np.where(worse, a, b) for a, b in zip(N, N_new, strict=True)],
                np.where(worse, cost, new),
            )
        return x, y, w, N_new, new

    def _nearest_w(self, x: Array, y: Array, x_r: Array, y_r: Array) -> Array:
        """Inverse depth along the left ray nearest to the right image point, by linear least squares."""
        h0, h1, h2 = self._turned(x, y)
        t0, t1, t2 = self.t
        a, b = t0 - x_r * t2, t1 - y_r * t2
        return np.asarray((a * (x_r * h2 - h0) + b * (y_r * h2 - h1)) / (a * a + b * b))

    def _normal(self, x: Array, y: Array, w: Array) -> tuple[list[Array], Array]:
        """Normal equations: xx, xy, xw, yy, yw, ww, then the right-hand sides x, y, w; and the cost."""
        u, v, (ux, uy, vx, vy) = self._image(0, x, y)
        du, dv = self.pixels[0][0] - u, self.pixels[0][1] - v
        xx, xy, yy = ux * ux + vx * vx, ux * uy + vx * vy, uy * uy + vy * vy
        gx, gy = ux * du + vx * dv, uy * du + vy * dv
        cost = du * du + dv * dv
        u, v, (ux, uy, uw), (vx, vy, vw) = self._right(x, y, w)
        du, dv = self.pixels[1][0] - u, self.pixels[1][1] - v
        cost = cost + du * du + dv * dv
        return [
            xx + ux * ux + vx * vx, xy + ux * uy + vx * vy, ux * uw + vx * vw,
            yy + uy * uy + vy * vy, uy * uw + vy * vw, uw * uw + vw * vw,
            gx + ux * du + vx * dv, gy + uy * du + vy * dv, uw * du + vw * dv,
        ], cost  # fmt: skip

    def _right(
        self, x: Array, y: Array, w: Array
    ) -> tuple[Array, Array, tuple[Array, Array, Array], tuple[Array, Array, Array]]:
        """Right pixels and their derivatives by x, y, w."""
        h0, h1, h2 = (h + t * w for h, t in zip(self._turned(x, y), self.t, strict=True))
        q = 1.0 / h2
        x_r, y_r = h0 * q, h1 * q
        u, v, (ux, uy, vx, vy) = self._image(1, x_r, y_r)
        by_u, by_v = [], []
        by_state = [[*row[:2], t] for row, t in zip(self.R, self.t, strict=True)]  # of h, by x, y, w
        for across, along, down in zip(*by_state, strict=True):
            dx, dy = (across - x_r * down) * q, (along - y_r * down) * q
            by_u.append(ux * dx + uy * dy)
            by_v.append(vx * dx + vy * dy)
        return u, v, (by_u[0], by_u[1], by_u[2]), (by_v[0], by_v[1], by_v[2])


def _solve(N: list[Array]) -> list[Array]:
    """Steps of x, y, w by a written-out Cholesky factorisation."""
    a, b, c, d, e, f, gx, gy, gw = N
    l10, l20 = b / a, c / a
    d1 = d - l10 * b
    e1 = e - l10 * c
    l21 = e1 / d1
    f2 = f - l20 * c - l21 * e1
    gy = gy - l10 * gx
    gw = gw - l20 * gx - l21 * gy
    w = gw / f2
    y = gy / d1 - l21 * w
    x = gx / a - l10 * y - l20 * w
    good = np.isfinite(x + y + w)
    if not good.all():
        x, y, w = (np.where(good, value, 0.0) for value in (x, y, w))
    return [x, y, w]


def _step_length(N: list[Array], step: list[Array]) -> Array:
    """Change of the images by a step [px]: its length in the metric of the normal matrix."""
    a, b, c, d, e, f = N[:6]
    x, y, w = step
    return np.sqrt(np.abs(x * (a * x + 2 * (b * y + c * w)) + y * (d * y + 2 * e * w) + f * w * w))


def _point_covariance(inverse: list[Array], x: Array, y: Array, w: Array) -> Array:
    """(n, 6) covariance of (x, y, 1) / w from that of x, y, w."""
    xx, xy, xw, yy, yw, ww = inverse
    q = 1.0 / w
    q2 = q * q
    # d(X, Y, Z) = q (dx - X dw, dy - Y dw, -Z dw) with X = x q, Y = y q, Z = q.
    X, Y = x * q, y * q
    return np.stack(
        [
            q2 * (xx - 2 * X * xw + X * X * ww),
            q2 * (xy - Y * xw - X * yw + X * Y * ww),
            q2 * q * (X * ww - xw),
            q2 * (yy - 2 * Y * yw + Y * Y * ww),
            q2 * q * (Y * ww - yw),
            q2 * q2 * ww,
        ],
        axis=1,
    )


def _inverse_entries(N: list[Array]) -> list[Array]:
    """Entries xx, xy, xw, yy, yw, ww of the inverse of each symmetric 3 x 3 matrix."""
    a, b, c, d, e, f = N[:6]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * A + b * B + c * C
    return [A / det, B / det, C / det, (a * f - c * c) / det, (b * c - a * e) / det, (a * d - b * b) / det]

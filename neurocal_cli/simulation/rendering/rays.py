"""Rays of pixels: through the intrinsics and the lens, there and back, with derivatives.

Coordinates are kept as separate arrays x and y, which is twice as fast as columns of one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.distortion_models import bend, distort
from neurocal_cli.geometry import Array
from neurocal_cli.simulation.rendering.scene import Camera

__all__ = ["Lens", "Rays"]

_MOST_STEPS = 50
_SETTLED = 1e-13
# Beyond this share of the radius where the distortion folds back, a ray counts as unseen.
_USABLE = 0.999
_LEAST_INVERSE = 1e-4  # of a radius squared: rays beyond 89.4 degrees are none of this model's


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays (x, y, 1) of image points, in the camera's frame.

    Attributes
    ----------
    u, v : arrays [px]
    x, y : arrays
        Ideal normalised coordinates; NaN where the lens sees nothing.
    xu, xv, yu, yv : arrays [1/px]
        Derivatives of x and y by u and v.
    """

    u: Array
    v: Array
    x: Array
    y: Array
    xu: Array
    xv: Array
    yu: Array
    yv: Array


@dataclass(frozen=True)
class Lens:
    """The maps between rays and pixels of a camera."""

    camera: Camera

    @cached_property
    def _matrix(self) -> Array:
        return self.camera.intrinsics.A

    @cached_property
    def straight(self) -> bool:
        """Whether there is no distortion."""
        return not any(self.camera.distortion)

    @cached_property
    def radius(self) -> float:
        """Normalised radius up to which the radial distortion grows; infinite where it always does."""
        k1, k2, _, _, k3 = self.camera.distortion
        # The slope 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 as a polynomial in 1 / r^2.
        roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > _LEAST_INVERSE)]
        return float(_USABLE / np.sqrt(real.max())) if real.size else np.inf

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels of points in the camera's frame.

        Parameters
        ----------
        points : (..., 3) array

        Returns
        -------
        pixels : (..., 2) array [px]
        seen : (...) bool array
            In front of the camera and within reach of the lens.
        """
        depth = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = points[..., 0] / depth, points[..., 1] / depth
            seen = (depth > 0) & (np.hypot(x, y) < self.radius)
            x, y = self._distort(x, y)
            A = self._matrix
            pixels = np.stack([A[0, 0] * x + A[0, 1] * y + A[0, 2], A[1, 1] * y + A[1, 2]], axis=-1)
        return pixels, seen

    def rays(self, u: Array, v: Array, near: tuple[Array, Array] | None = None) -> Rays:
        """Rays of image points.

        Parameters
        ----------
        u, v : arrays of one shape [px]
        near : (x, y), optional
            Ideal coordinates of rays nearby, to start from; they must broadcast.
        """
        A = self._matrix
        yd = (v - A[1, 2]) / A[1, 1]
        xd = (u - A[0, 2] - A[0, 1] * yd) / A[0, 0]
        zero = np.zeros_like(xd)
        xu, xv, yv = 1 / A[0, 0], -A[0, 1] / (A[0, 0] * A[1, 1]), 1 / A[1, 1]
        if self.straight:
            return Rays(u, v, xd, yd, zero + xu, zero + xv, zero, zero + yv)
        x, y = self._undistort(xd, yd, near)
        j11, j12, j22 = self._jacobian(x, y)
        scale = 1 / (j11 * j22 - j12 * j12)
        # The distortion's Jacobian is symmetric; its inverse times that of the affine map.
        i11, i12, i22 = scale * j22, -scale * j12, scale * j11
        return Rays(u, v, x, y, i11 * xu, i11 * xv + i12 * yv, i12 * xu, i12 * xv + i22 * yv)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        return (x, y) if self.straight else distort("plumb_bob", self.camera.distortion, x, y)

    def _jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Entries (0, 0), (0, 1) = (1, 0) and (1, 1) of the derivative of `_distort`."""
        _, (xx, xy, _, yy), _ = bend("plumb_bob", self.camera.distortion, x, y)
        return xx, xy, yy

    def _undistort(self, xd: Array, yd: Array, near: tuple[Array, Array] | None) -> tuple[Array, Array]:
        """Newton's method; it climbs to the root from the inside, so it needs no damping."""
        x, y = (xd.copy(), yd.copy()) if near is None else (near[0] + 0 * xd, near[1] + 0 * yd)
        self._hold(x, y)
        settled = _SETTLED * (1 + np.abs(xd) + np.abs(yd))
        for _ in range(_MOST_STEPS):
            fx, fy = self._distort(x, y)
            fx -= xd
            fy -= yd
            wrong = np.abs(fx) + np.abs(fy)
            unsettled = wrong > settled
            inside = x * x + y * y < 0.9999 * self.radius**2 if np.isfinite(self.radius) else True
            if not (unsettled & inside).any():
                break
            j11, j12, j22 = self._jacobian(x, y)
            scale = 1 / (j11 * j22 - j12 * j12)
            x -= scale * (j22 * fx - j12 * fy)
            y -= scale * (j11 * fy - j12 * fx)
            self._hold(x, y)
        lost = wrong > 1e-9
        x[lost] = np.nan
        y[lost] = np.nan
        return x, y

    def _hold(self, x: Array, y: Array) -> None:
        """Keep rays within the radius where the distortion can be undone."""
        if np.isfinite(self.radius):
            with np.errstate(divide="ignore"):
                factor = np.minimum(1, self.radius / np.hypot(x, y))
            x *= factor
            y *= factor

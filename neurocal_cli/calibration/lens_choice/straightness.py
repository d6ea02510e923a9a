"""Images of straight lines with distortion: distances of points from them, and the derivatives.

A line of the undistorted image, normalised by a camera A, is ``x(t) = b + t e``. Its distorted image is

    m = F(x(t)) = A distort(x(t); k)

The error of a point is its distance from this curve, in (whitened) pixels. The line (two parameters) and
the foot t of each point minimise it. With the unit normal nu of the curve at the foot, the error is
``r = nu . (m - F)``. Feet and normals do not change it to first order, so ``dr = -nu . dF`` is exact. Least
squares is maximum likelihood for the points of one line. The positions of the lines in the world do not
enter.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from neurocal_cli.calibration.lens_choice.collinear_points import CollinearPoints
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.camera.projection import image_points_with_jacobian, normalised_points

_SETTLED = 1e-10  # a step of feet and lines below this, in normalised image units, ends the iteration
_MOST_STEPS = 15


@frozen_dataclass(eq=False)
class LineImages:
    """Images of the points on lines, in any unit and from any origin."""

    lines: CollinearPoints
    pixels: Array  # (M, 2) of each point on each line
    # (M, 3) entries (0, 0), (0, 1), (1, 1) of the factor that whitens a pixel's error.
    whitening: Array | None

    def whiten(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Whiten vectors in the image, one for each point on each line."""
        if self.whitening is None:
            return u, v
        return self.whitening[:, 0] * u + self.whitening[:, 1] * v, self.whitening[:, 2] * v

    def sum_by_line(self, values: Array) -> Array:
        """Sums over the points of each line."""
        return np.add.reduceat(values, self.lines.first, axis=0)


@frozen_dataclass(eq=False)
class DistortedLines:
    """Straight lines and their distorted images."""

    images: LineImages  # observed points
    entries: Array  # (5,) A11, A12, A22, A13, A23 of the camera
    distortion: Distortion
    base: Array  # (L, 2) a point of each line in the normalised image
    along: Array  # (L, 2) direction of each line
    feet: Array  # (M,) t of each point

    def with_camera(self, entries: Array, coefficients: Array) -> DistortedLines:
        """The same lines with other entries of A and other coefficients of the same model."""
        return replace(self, entries=entries, distortion=Distortion(self.distortion.model, coefficients))

    def fitted(self) -> DistortedLines:
        """Lines and feet that minimise the errors."""
        curves = self
        with np.errstate(all="ignore"):
            for _ in range(_MOST_STEPS):
                curves, step = curves._moved()
                if not _SETTLED < step < np.inf:
                    break
        return curves

    def _moved(self) -> tuple[DistortedLines, float]:
        at, n, t = self._at_feet, self.normals, self.feet
        across = at.across(n[self.images.lines.line])
        # Each line moves by (a + b t) along its normal.
        square, product = across * across, across * at.r
        s0, s1, s2 = (self.images.sum_by_line(c) for c in (square, square * t, square * t * t))
        r0, r1 = (self.images.sum_by_line(c) for c in (product, product * t))
        det = s0 * s2 - s1**2
        a, b = (s2 * r0 - s1 * r1) / det, (s0 * r1 - s1 * r0) / det
        along = self.along + b[:, None] * n
        along /= np.linalg.norm(along, axis=1)[:, None]
        u, v = at.tangent
        shift = (u * at.error[0] + v * at.error[1]) / (u * u + v * v)
        step = float(max(np.abs(a).max(), np.abs(b).max(), np.abs(shift).max()))
        return replace(self, base=self.base + a[:, None] * n, along=along, feet=t + shift), step

    @cached_property
    def _at_feet(self) -> _Images:
        return _Images(self)

    @property
    def normals(self) -> Array:
        """(L, 2) unit normals of the lines in the normalised image."""
        return np.column_stack([-self.along[:, 1], self.along[:, 0]])

    def errors(self) -> Array:
        """(M,) distances of the points from their curves, whitened, signed."""
        return self._at_feet.r

    @property
    def valid(self) -> bool:
        """Whether no line is a single point and the distortion is monotonic at all points."""
        with np.errstate(all="ignore"):
            return bool(np.isfinite(self.errors()).all() and (self._at_feet.determinant > 0).all())

    def derivatives(self) -> tuple[Array, Array, Array]:
        """Errors r (M,), their derivatives by A and the distortion, and their directions nu (M, 2).

        The second result J (M, 5 + K) is minus the derivative of r by A's entries and the coefficients, with
        the parameters of each line eliminated. The directions are in the whitened image.
        """
        at = self._at_feet
        J = at.columns()
        across = at.across(self.normals[self.images.lines.line])
        basis = np.column_stack([across, across * self.feet])
        gram = self.images.sum_by_line(basis[:, :, None] * basis[:, None, :])
        mixed = self.images.sum_by_line(basis[:, :, None] * J[:, None, :])
        taken = np.linalg.solve(gram, mixed)[self.images.lines.line]  # regular where `valid`
        J -= (basis[:, :, None] * taken).sum(axis=1)
        return at.r, J, np.column_stack(at.nu)


class _Images:
    """Predicted images of all feet, with their derivatives."""

    def __init__(self, curves: DistortedLines) -> None:
        self.entries, self.images = curves.entries, curves.images
        index = self.images.lines.line
        along = curves.along[index]
        x, y = (curves.base[index] + curves.feet[:, None] * along).T
        model, k = curves.distortion.model, curves.distortion.coefficients
        image = image_points_with_jacobian(curves.entries, model, k, x, y)
        self.x, self.y, self.slope, self.by_k = image.x, image.y, image.by_point, image.by_coefficient
        ux, uy, vx, vy = self.slope
        self.determinant = ux * vy - uy * vx
        u, v = self.images.pixels[:, 0] - image.u, self.images.pixels[:, 1] - image.v
        self.error = self.images.whiten(u, v)
        self.tangent = self._through(along)
        length = np.hypot(*self.tangent)
        self.nu = -self.tangent[1] / length, self.tangent[0] / length
        self.r = self.nu[0] * self.error[0] + self.nu[1] * self.error[1]

    def _through(self, direction: Array) -> tuple[Array, Array]:
        """Distorted and whitened images of directions in the undistorted image."""
        dx, dy = direction.T
        uu, uv, vu, vv = self.slope
        return self.images.whiten(uu * dx + uv * dy, vu * dx + vv * dy)

    def across(self, direction: Array) -> Array:
        """Components across the curve of directions in the undistorted image."""
        u, v = self._through(direction)
        return self.nu[0] * u + self.nu[1] * v

    def columns(self) -> Array:
        """(M, 5 + K) derivatives of the images across their curves by A's entries and the coefficients."""
        a, s, b, _, _ = self.entries
        zero, one = np.zeros_like(self.x), np.ones_like(self.x)
        by = [(self.x, zero), (self.y, zero), (zero, self.y), (one, zero), (zero, one)]
        by += [(a * dx + s * dy, b * dy) for dx, dy in self.by_k]
        J = np.empty((len(self.x), len(by)))
        for column, (u, v) in enumerate(by):
            u, v = self.images.whiten(u, v)
            J[:, column] = self.nu[0] * u + self.nu[1] * v
        return J


def distorted_lines(images: LineImages, entries: Array, distortion: Distortion) -> DistortedLines:
    """Fit lines to the undistorted points, then lines and feet to the observed ones.

    The result is not `valid` where the distortion does not reach a point.
    """
    base, off, (xx, xy, yy) = _undistorted_lines(images, entries, distortion)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    feet = (off * along[images.lines.line]).sum(axis=1)
    return DistortedLines(images, entries, distortion, base, along, feet).fitted()


def straightness_error(images: LineImages, entries: Array, distortion: Distortion) -> float:
    """Squared distance of undistorted points from lines over their squared spread along them.

    It does not depend on the scale. It is infinite where the distortion does not reach a point.
    """
    _, _, (xx, xy, yy) = _undistorted_lines(images, entries, distortion)
    across = 0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy))
    share = float(across.sum() / (xx + yy).sum())
    return share if np.isfinite(share) else np.inf


def _undistorted_lines(
    images: LineImages, entries: Array, distortion: Distortion
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Each line's centroid (L, 2), the undistorted points about it (M, 2), their scatter xx, xy, yy."""
    undistorted = np.column_stack(undistort(distortion, *normalised_points(entries, *images.pixels.T)))
    base = images.sum_by_line(undistorted) / images.lines.counts[:, None]
    off = undistorted - base[images.lines.line]
    products = off[:, 0] ** 2, off[:, 0] * off[:, 1], off[:, 1] ** 2
    return base, off, tuple(images.sum_by_line(product) for product in products)

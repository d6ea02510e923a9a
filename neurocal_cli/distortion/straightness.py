"""Images of straight lines through a lens: how far points lie beside them, and the derivatives.

A line of the ideal image, normalised by a camera A, is ``x(t) = b + t e``; its points are seen at

    m = F(x(t)) = A distort(x(t); k)

and the error of a point is its distance from this curve, across it, in (whitened) pixels. It is
minimal over the line (two parameters) and over the foot t of each point. With nu the unit normal of the
curve at the foot, the error is ``r = nu . (m - F)`` and, as feet and normals do not change it to first
order, ``dr = -nu . dF``: the derivatives are exact, and least squares is maximum likelihood for the
points of one line. Nothing here knows where the lines lie in the world.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.camera.projection import image_points_with_jacobian, normalised_points
from neurocal_cli.distortion.collinear_points import LinesSeen
from neurocal_cli.geometry import Array

__all__ = ["CAMERA", "Curves", "SeenLines", "bent_lines", "crookedness"]

CAMERA = 5  # columns of A's entries A11, A12, A22, A13, A23, before the lens's coefficients

_SETTLED = 1e-10  # steps of feet and lines, in normalised image units, that are none any more
_MOST_STEPS = 15


@dataclass(frozen=True, eq=False)
class SeenLines:
    """Pixels of the points on lines, in any unit and from any origin.

    Attributes
    ----------
    lines : LinesSeen
    pixels : (M, 2) array
        Of each place on a line.
    whitening : (M, 3) array or None
        Entries (0, 0), (0, 1), (1, 1) of the factor that whitens a pixel's error.
    """

    lines: LinesSeen
    pixels: Array
    whitening: Array | None

    def whiten(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Whiten vectors in the image, one at each place."""
        if self.whitening is None:
            return u, v
        return self.whitening[:, 0] * u + self.whitening[:, 1] * v, self.whitening[:, 2] * v

    def sum_by_line(self, values: Array) -> Array:
        """Sums over each line's places."""
        return np.add.reduceat(values, self.lines.first, axis=0)


@dataclass(frozen=True, eq=False)
class Curves:
    """Straight lines through a camera and its lens.

    Attributes
    ----------
    seen : SeenLines
    entries : (5,) array
        A11, A12, A22, A13, A23 of the camera.
    lens : Distortion
    base, along : (L, 2) arrays
        A point and the direction of each line in the normalised image.
    feet : (M,) array
        t of each place.
    """

    seen: SeenLines
    entries: Array
    lens: Distortion
    base: Array
    along: Array
    feet: Array

    def seen_through(self, entries: Array, coefficients: Array) -> Curves:
        """The same lines through another camera and another lens of the same model."""
        return replace(self, entries=entries, lens=Distortion(self.lens.model, coefficients))

    def settled(self) -> Curves:
        """Lines and feet moved to where the errors are smallest."""
        curves = self
        with np.errstate(all="ignore"):
            for _ in range(_MOST_STEPS):
                curves, step = curves._moved()
                if not _SETTLED < step < np.inf:
                    break
        return curves

    def _moved(self) -> tuple[Curves, float]:
        at = _Places(self)
        index, n = self.seen.lines.line, self.normals
        r, across = at.errors(), at.across(n[index])
        # Each line moves by (a + b t) along its normal.
        t = self.feet
        sums = [
            self.seen.sum_by_line(c) for c in (across * across, across * across * t, across * across * t * t)
        ]
        right = [self.seen.sum_by_line(c) for c in (across * r, across * r * t)]
        det = sums[0] * sums[2] - sums[1] ** 2
        a = (sums[2] * right[0] - sums[1] * right[1]) / det
        b = (sums[0] * right[1] - sums[1] * right[0]) / det
        along = self.along + b[:, None] * n
        along /= np.linalg.norm(along, axis=1)[:, None]
        feet, shift = at.nearer()
        step = float(max(np.abs(a).max(), np.abs(b).max(), np.abs(shift).max()))
        return replace(self, base=self.base + a[:, None] * n, along=along, feet=feet), step

    @property
    def normals(self) -> Array:
        """(L, 2) unit normals of the lines in the normalised image."""
        return np.column_stack([-self.along[:, 1], self.along[:, 0]])

    def errors(self) -> Array:
        """(M,) distances of the points from their curves, whitened, signed."""
        return _Places(self).errors()

    @property
    def sensible(self) -> bool:
        """Whether every line is one, and the lens folds back none of the points."""
        with np.errstate(all="ignore"):
            at = _Places(self)
            return bool(np.isfinite(at.errors()).all() and (at.determinant > 0).all())

    def derivatives(self) -> tuple[Array, Array, Array]:
        """Errors, and their derivatives by what is not of one line alone.

        Returns
        -------
        r : (M,) array
        J : (M, 5 + K) array
            Minus the derivative of r by A's entries and the coefficients, when the lines follow
            each change: what any line could take up is projected out.
        nu : (M, 2) array
            Direction of each error in the whitened image.
        """
        at = _Places(self)
        J = at.columns()
        across = at.across(self.normals[self.seen.lines.line])
        t = self.feet
        basis = np.column_stack([across, across * t])
        gram = self.seen.sum_by_line(basis[:, :, None] * basis[:, None, :])
        mixed = self.seen.sum_by_line(basis[:, :, None] * J[:, None, :])
        taken = np.linalg.solve(gram, mixed)[self.seen.lines.line]  # regular where `sensible`
        J -= (basis[:, :, None] * taken).sum(axis=1)
        return at.errors(), J, np.column_stack(at.nu)


class _Places:
    """All places on all lines: where they are seen, and how that changes."""

    def __init__(self, curves: Curves) -> None:
        self.curves, self.seen = curves, curves.seen
        index = self.seen.lines.line
        self.along = curves.along[index]
        x, y = (curves.base[index] + curves.feet[:, None] * self.along).T
        lens = curves.lens
        image = image_points_with_jacobian(curves.entries, lens.model, lens.coefficients, x, y)
        self.x, self.y, self.slope, self.by_k = image.x, image.y, image.by_point, image.by_coefficient
        ux, uy, vx, vy = self.slope
        self.determinant = ux * vy - uy * vx
        u, v = self.seen.pixels[:, 0] - image.u, self.seen.pixels[:, 1] - image.v
        self.error = self.seen.whiten(u, v)
        self.tangent = self._through(self.along)
        length = np.hypot(*self.tangent)
        self.nu = -self.tangent[1] / length, self.tangent[0] / length

    def _through(self, direction: Array) -> tuple[Array, Array]:
        """Directions of the normalised ideal image as seen, whitened."""
        dx, dy = direction.T
        uu, uv, vu, vv = self.slope
        return self.seen.whiten(uu * dx + uv * dy, vu * dx + vv * dy)

    def errors(self) -> Array:
        return self.nu[0] * self.error[0] + self.nu[1] * self.error[1]

    def across(self, direction: Array) -> Array:
        """How far moves in the normalised ideal image go across the curve."""
        u, v = self._through(direction)
        return self.nu[0] * u + self.nu[1] * v

    def nearer(self) -> tuple[Array, Array]:
        """Feet nearer to the points, about 0 on each line, and by how much they moved."""
        u, v = self.tangent
        shift = (u * self.error[0] + v * self.error[1]) / (u * u + v * v)
        return self.curves.feet + shift, shift

    def columns(self) -> Array:
        """(M, 5 + K) derivatives of the places across their curves."""
        a, s, b, _, _ = self.curves.entries
        zero, one = np.zeros_like(self.x), np.ones_like(self.x)
        by = [(self.x, zero), (self.y, zero), (zero, self.y), (one, zero), (zero, one)]
        by += [(a * dx + s * dy, b * dy) for dx, dy in self.by_k]
        J = np.empty((len(self.x), len(by)))
        for column, (u, v) in enumerate(by):
            u, v = self.seen.whiten(u, v)
            J[:, column] = self.nu[0] * u + self.nu[1] * v
        return J


def bent_lines(seen: SeenLines, entries: Array, lens: Distortion) -> Curves:
    """Lines through the straightened points, as a camera and its lens show them.

    The errors are smallest over lines and feet. Points that the lens cannot have seen make a result
    that is not `sensible`.
    """
    base, off, (xx, xy, yy) = _straight_lines(seen, entries, lens)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    feet = (off * along[seen.lines.line]).sum(axis=1)
    return Curves(seen, entries, lens, base, along, feet).settled()


def crookedness(seen: SeenLines, entries: Array, lens: Distortion) -> float:
    """How far straightened points lie beside lines, by how far they spread along them, both squared.

    Whatever the lens does to the scale, this stays; infinity where it cannot have seen a point.
    """
    _, _, (xx, xy, yy) = _straight_lines(seen, entries, lens)
    across = 0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy))
    share = float(across.sum() / (xx + yy).sum())
    return share if np.isfinite(share) else np.inf


def _straight_lines(
    seen: SeenLines, entries: Array, lens: Distortion
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Straightened points: each line's centre (L, 2), the points about it (M, 2), its scatter xx, xy, yy."""
    straight = np.column_stack(undistort(lens, *normalised_points(entries, *seen.pixels.T)))
    base = seen.sum_by_line(straight) / seen.lines.counts[:, None]
    off = straight - base[seen.lines.line]
    products = off[:, 0] ** 2, off[:, 0] * off[:, 1], off[:, 1] ** 2
    return base, off, tuple(seen.sum_by_line(product) for product in products)

"""Images of straight lines with distortion: distances of points from them, and the derivatives.

The images of collinear points are collinear in any pinhole camera. Only the coordinates of the target are
used. Rows, columns and diagonals of boards are found like any other line: pairs of points on one line have
the same direction and the same offset.

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
from numpy.typing import NDArray

from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, distinct_rows
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.camera.projection import image_points_with_jacobian, normalised_points
from neurocal_cli.observations.measured_directions import unit
from neurocal_cli.observations.points import Correspondences

FEWEST_ON_LINE = 4
_FEWEST_OF_EDGES = 3  # the same for points that are measured across edges, on lines along these edges

# Rounding of coordinates, as a share of the target's size: 2 micrometres on a 200 mm board. The tests in
# test_plumb_line.py repeat that lines are found and that scattered points have none.
_TOLERANCE = 1e-5
_LINES_A_POINT = 4  # rows, columns and diagonals of a board
_OF_EDGES = 8  # the same where only lines along edges are used
_NEARLY_0 = 1e-3  # component of a direction
_ALONG = 0.25  # largest sine of the angle between an edge and the line along it
_ALL_PAIRS = 700  # largest target of which all pairs are compared
_MOST_PAIRS = 500_000  # pairs of some points with all others, for larger targets
# Numbers without a relation: two directions, or two places, have the same product only if they are the same.
_OF_DIRECTION, _OF_PLACE = np.array([0.618, 0.4142, 0.2361]), np.array([0.7321, 0.2361, 0.6458])
_MOST_PLACES = 200_000  # points on lines; more of them do not change the result but cost time

Index = NDArray[np.intp]


@frozen_dataclass(eq=False)
class CollinearPoints:
    """Points of each view, grouped by the lines on which they are."""

    row: Index  # (M,) of each point on each line; a row occurs once for each line through it
    first: Index  # (L,) where each line begins in `row`

    def __len__(self) -> int:
        return len(self.first)

    @property
    def counts(self) -> Index:
        """(L,) points of each line."""
        return np.diff(self.first, append=len(self.row))

    @property
    def line(self) -> Index:
        """(M,) line of each entry of `row`."""
        return np.repeat(np.arange(len(self.first)), self.counts)

    def only(self, which: NDArray[np.bool_]) -> CollinearPoints:
        """Some of the lines; which is a mask (L,)."""
        kept = self.counts[which]
        return CollinearPoints(self.row[which[self.line]], np.cumsum(kept) - kept)


def find_lines(points: Correspondences) -> CollinearPoints:
    """Find the lines of at least `FEWEST_ON_LINE` known points in each view, or of three along edges.

    Each point is used on the four longest lines through it: the row, the column and the diagonals of a
    board. A point that was measured across an edge is used on lines along that edge.
    """
    first, ids = distinct_rows(points.world)
    target = points.world[first] - points.world[first].mean(axis=0)
    target /= np.ptp(target, axis=0).max() or 1.0
    fewest, most = FEWEST_ON_LINE, _LINES_A_POINT
    if points.across is not None:
        fewest, most = _FEWEST_OF_EDGES, _OF_EDGES
    line, member = _longest(*_lines_of(target, fewest), len(target), most)
    # Each line in each view: join the rows with the lines through their points.
    order = np.argsort(member, kind="stable")
    line, through = line[order], np.bincount(member, minlength=len(target))
    begins = np.cumsum(through) - through
    copies = through[ids]
    row = np.repeat(np.arange(len(ids)), copies)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(copies) - copies, copies)
    label = line[np.repeat(begins[ids], copies) + rank].astype(np.int64)
    label = label * points.n_views + points.view_index[row]
    order = np.argsort(label, kind="stable")
    changes = np.diff(label[order], prepend=-1) != 0
    lines = CollinearPoints(row[order], np.flatnonzero(changes))
    lines = lines.only(lines.counts >= fewest)
    if points.across is not None and len(lines):
        lines = _along_edges(lines, points.pixels, points.across)
    every = -(-len(lines.row) // _MOST_PLACES)
    return lines.only(np.arange(len(lines)) % every == 0) if every > 1 else lines


def _along_edges(lines: CollinearPoints, pixels: Array, across: Array) -> CollinearPoints:
    """Drop lines across the edges of their points: a position along an edge is not measured."""
    row, first, counts, line = lines.row, lines.first, lines.counts, lines.line
    chord = pixels[row[first + counts - 1]] - pixels[row[first]]
    order = np.lexsort(((pixels[row] * chord[line]).sum(axis=1), line))
    row = row[order]
    # The local direction, from the point before to the point after: distortion may curve the whole line.
    place = np.arange(len(row))
    before = np.maximum(place - 1, first[line])
    after = np.minimum(place + 1, (first + counts - 1)[line])
    n = unit(across)[row]
    slant = np.abs((n * unit(pixels[row[after]] - pixels[row[before]])).sum(axis=1))
    return CollinearPoints(row, first).only(~np.logical_or.reduceat(slant > _ALONG, first))


def _clusters(values: Array, gap: float) -> Index:
    """Number groups of values whose sorted neighbours are nearer than a gap."""
    order = np.argsort(values, kind="stable")
    labels = np.empty(len(values), dtype=np.intp)
    labels[order] = np.cumsum(np.diff(values[order], prepend=values[order[:1]]) > gap)
    return labels


def _lines_of(target: Array, fewest: int) -> tuple[Index, Index]:
    """Line and point of each point on the lines of a target; of a large one, on those through some points."""
    n = len(target)
    if n <= _ALL_PAIRS:
        return _through_pairs(target, *np.triu_indices(n, 1), fewest)
    some = np.linspace(0, n - 1, int(np.clip(_MOST_PAIRS // n, 4, 64))).astype(np.intp)
    a, b = np.repeat(some, n), np.tile(np.arange(n), len(some))
    return _through_pairs(target, a[a != b], b[a != b], fewest)


def _through_pairs(target: Array, a: Index, b: Index, fewest: int) -> tuple[Index, Index]:
    """Lines that several pairs of points have in common: line and point of each member."""
    along = target[b] - target[a]
    along /= np.linalg.norm(along, axis=1)[:, None]
    # Opposite directions are the same: the first component that is not nearly 0 becomes positive.
    leading = np.take_along_axis(along, (np.abs(along) > _NEARLY_0).argmax(axis=1)[:, None], axis=1)
    along *= np.where(leading < 0, -1.0, 1.0)
    offset = target[a] - (target[a] * along).sum(axis=1)[:, None] * along
    # Offsets are compared only between pairs of one direction.
    by_direction = _clusters(along @ _OF_DIRECTION, _TOLERANCE)
    labels = _clusters(4.0 * by_direction + offset @ _OF_PLACE, _TOLERANCE)
    common = np.bincount(labels)[labels] >= fewest - 1
    labels, a, b, along = labels[common], a[common], b[common], along[common]
    key = np.unique(np.concatenate([labels, labels]) * len(target) + np.concatenate([a, b]))
    line, member = np.divmod(key, len(target))
    # Keep those with enough points that are collinear, and renumber them.
    names, first, counts = np.unique(line, return_index=True, return_counts=True)
    given, where = np.unique(labels, return_index=True)
    index = np.repeat(np.arange(len(names)), counts)
    direction = along[where[np.searchsorted(given, names)]][index]
    off = target[member] - target[member[first]][index]
    off -= (off * direction).sum(axis=1)[:, None] * direction
    astray = np.linalg.norm(off, axis=1) > 3 * _TOLERANCE
    good = (counts >= fewest) & (np.bincount(index, astray, len(names)) == 0)
    return (np.cumsum(good) - 1)[index[good[index]]], member[good[index]]


def _longest(line: Index, member: Index, n: int, most: int) -> tuple[Index, Index]:
    """Keep lines that are among the `most` longest lines of at least half of their points."""
    if not line.size:
        return line, member
    counts = np.bincount(line)
    order = np.lexsort((line, -counts[line], member))
    through = np.bincount(member, minlength=n)
    rank = np.empty(len(line), dtype=np.intp)
    rank[order] = np.arange(len(line)) - np.repeat(np.cumsum(through) - through, through)
    chosen = np.bincount(line, rank < most) >= 0.5 * counts
    return line[chosen[line]], member[chosen[line]]


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

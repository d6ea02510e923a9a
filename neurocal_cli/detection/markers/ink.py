"""What the markers on a board add to its light, so that the edges beside them are fitted as plain ones are.

A marker that is read is known to the last bit, and the fit of the board says where its cells lie and how
blurred they are. What they add to the light of each pixel around the marker follows, and is a part of the
edges' model. Pixels within the marker, where it is most, are left out.

In the coordinates (a, b) of a cell of the board, the marker is a pattern of rectangles, and the light of a
blurred pattern is a sum over the corners of its outline,

    x = sum_ij W_ij P(a - a_i, b - b_j),   P(x, y) = Phi(x / s_a) Phi(y / s_b) + sum_n rho^n / n! phi_n phi_n

with Phi the normal distribution function, s_a and s_b the blur along the axes, rho its correlation, which
perspective makes, and phi_n the derivatives of Phi (Mehler's series). Edges are displaced by the shift that
the fit found for all edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies
from neurocal_cli.detection.fitting.edge_profile import Real, profile
from neurocal_cli.detection.fitting.smooth_map import LocalInverse, SmoothMap
from neurocal_cli.detection.fitting.strips import GridImage, Single

# sigma, beyond which a pattern changes the light by less than 0.0002 half contrasts, and beyond which the
# inner part of a marker with a border does not matter
_REACH = 3.7
_FITTED, _FITTED_PX = 5.0, 2.0  # sigma and px from an edge, beyond which fits use no pixels
_SLACK = 1.0  # px, for what the homographies of cells leave out
_WIDER = 1.1  # blur of pixels that are chosen, over that of the first look
# Of the map in a cell; the next ones may be of another size.
_SAMPLES = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 6)]), axis=-1).reshape(-1, 2)
_TERMS = ((0.02, 1), (0.1, 2), (0.3, 4), (0.5, 7), (1.0, 12))  # of the series up to a correlation
_MOST_RHO = 0.9
_SIGNS = (-1, 1)
_CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


@frozen_dataclass(eq=False)
class Ink:
    """The inner pattern of N cells of a board."""

    cell: NDArray[np.int64]  # (N, 2) (c, r) of the cell's first vertex in the coordinates of the map
    lines: Array  # (n + 1,) places of the pattern's lines along a side of the cell, from 0 to 1
    light: Array  # (N, n, n) -1 or 1: colours of the pattern, [b, a]
    base: Array  # (N,) -1 or 1: colour of the cell without its pattern

    def only(self, which: NDArray[np.bool_]) -> Ink:
        """Some of the cells."""
        return Ink(self.cell[which], self.lines, self.light[which], self.base[which])

    def beside(self, seen: NDArray[np.bool_]) -> Ink:
        """The cells with a corner among the vertices (rows, cols) that were found.

        The map of a part of a board does not extend to cells far from it.
        """
        rows, cols = seen.shape
        known = np.zeros(len(self.cell), dtype=np.bool_)
        for step in _CORNERS.astype(np.int64):
            c, r = (self.cell + step).T
            inside = (c >= 0) & (c < cols) & (r >= 0) & (r < rows)
            known[inside] |= seen[r[inside], c[inside]]
        return self.only(known)

    @property
    def inner(self) -> Array:
        """(N, n, n) what the pattern changes."""
        return np.asarray(self.light - self.base[:, None, None])

    @property
    def border(self) -> float:
        """Width [cells] of the border of one colour that all patterns have."""
        inner, thick = self.inner, 0
        n = inner.shape[1]
        while 2 * thick < n:
            ring = np.ones((n, n), dtype=np.bool_)
            ring[thick + 1 : n - thick - 1, thick + 1 : n - thick - 1] = False
            if not (inner[:, ring] == inner[:, :1, 0]).all() or not inner[:, 0, 0].all():
                break
            thick += 1
        return float(self.lines[thick] - self.lines[0])

    @property
    def gap(self) -> float:
        """Distance [cells] of the nearest change by a pattern from a side of its cell."""
        columns = np.flatnonzero(self.inner.any(axis=(0, 1)) | self.inner.any(axis=(0, 2)))
        return float(min(self.lines[columns[0]], 1 - self.lines[columns[-1] + 1])) if len(columns) else 1.0

    @property
    def filled(self) -> Ink:
        """The patterns with the colour of their borders everywhere."""
        return Ink(self.cell, self.lines[[0, -1]], self.light[:, :1, :1], self.base)


@frozen_dataclass(eq=False)
class Appearance:
    """How a board looks in an image, for its ink."""

    map: SmoothMap
    # (N, 3) blur at each cell, the pixel included: along the normals of lines along b and along a [px], and
    # the correlation of both
    blur: Array
    shift: float  # [px] of edges towards the light side
    tails: Array  # (2,) of the profile of all edges; see `edge_profile`

    def halfway_to(self, other: Appearance) -> Appearance:
        """With another map, and half of the change of the rest: whole steps may overshoot."""
        values = (0.5 * (getattr(self, name) + getattr(other, name)) for name in ("blur", "shift", "tails"))
        return Appearance(other.map, *values)

    def clearance(self, ink: Ink) -> float:
        """Least width of the cells of some ink, of those that the camera sees [sigma]."""
        corners = self.map.at(ink.cell[:, None] + _CORNERS)
        u, v = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
        area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
        width = area / np.maximum(np.hypot(*u.T), np.hypot(*v.T))
        return float(np.nanmin(width / self.blur[:, :2].max(axis=1), initial=np.inf))


@frozen_dataclass(eq=False)
class InkedPixels:
    """Pixels of an image near the edges of cells, which their patterns reach."""

    raw: GridImage  # NaN at other pixels within a pattern, which are too far from the edges for the fits
    ink: Ink  # of the N cells that are shown
    shown: NDArray[np.bool_]  # which of the cells these are
    pixels: Array  # (N, M, 2), padded
    used: NDArray[np.bool_]  # (N, M) False for the padding
    place: NDArray[np.intp]  # of the used ones in the flat image

    @classmethod
    def of(cls, raw: GridImage, ink: Ink, look: Appearance) -> InkedPixels:
        """Choose the pixels by a first look, which may see less blur than later ones."""
        result = raw.image.astype(np.float32)
        seen = look.map.at(ink.cell[:, None] + _SAMPLES)
        shown = np.asarray(np.isfinite(seen).all(axis=(1, 2)) & ink.inner.any(axis=(1, 2)))
        ink, look = ink.only(shown), replace(look, blur=look.blur[shown])
        if ink.border * look.clearance(ink) > _REACH:
            ink = ink.filled
        corners, sigma = look.map.at(ink.cell[:, None] + _CORNERS), _WIDER * look.blur[:, :2].max(axis=1)
        near = _near_edges(result, ink, corners, sigma, len(ink.lines) == 2)
        return cls(replace(raw, image=result), ink, shown, *near)

    def under(self, look: Appearance, most: float) -> GridImage:
        """The image with what patterns add to its light, and NaN where they change it by more than `most`.

        `most` is in half contrasts.
        """
        result = self.raw.image.astype(np.float32)
        light = np.zeros(result.shape, dtype=np.float32)
        if self.used.any():
            inverse = LocalInverse.of(look.map.at(self.ink.cell[:, None] + _SAMPLES), _SAMPLES)
            a, b, *slopes = inverse.at(inverse.from_centre(self.pixels))
            blurred = _Blurred.of(slopes, look.blur[self.shown], look.shift, look.tails)
            change = blurred.pattern(a, b, self.ink.lines, self.ink.inner)[self.used]
            np.add.at(light.reshape(-1), self.place, change)  # some pixels are near the edges of two cells
            result.reshape(-1)[self.place[np.abs(change) > most]] = np.nan
        return replace(self.raw, image=result, ink=light)


def _near_edges(
    result: NDArray[np.float32], ink: Ink, corners: Array, sigma: Array, filled: bool
) -> tuple[Array, NDArray[np.bool_], NDArray[np.intp]]:
    """Pixels (N, M, 2) near the edges of cells that their patterns reach, padded, and a mask (N, M) of them.

    Also their places in the flat image. Other pixels within a pattern, which are too far from the edges for
    the fits, become NaN in the image.
    """
    height, width = result.shape
    sides = corners[:, [1, 3]] - corners[:, :1]
    apart = np.abs(np.linalg.det(sides))[:, None] / np.hypot(*np.moveaxis(sides, 2, 0))[:, ::-1]
    room = _REACH * sigma + _SLACK
    low = np.maximum(np.floor(corners.min(axis=1) - room[:, None]), 0).astype(int)
    high = np.minimum(np.ceil(corners.max(axis=1) + room[:, None]) + 1, [width, height]).astype(int)
    changed = np.stack([ink.inner.any(axis=axis) for axis in (1, 2)], axis=1)
    first, last = changed.argmax(axis=2), changed.shape[2] - changed[:, :, ::-1].argmax(axis=2)
    middle, half = 0.5 * (ink.lines[last] + ink.lines[first]), 0.5 * (ink.lines[last] - ink.lines[first])
    to_cells = homographies(corners, np.broadcast_to(_CORNERS, corners.shape))
    parts = []
    for k, ((left, top), (right, bottom)) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        u, v = np.arange(left, right, dtype=np.float32), np.arange(top, bottom, dtype=np.float32)
        a, b, w = (x * u + (y * v + one)[:, None] for x, y, one in to_cells[k].tolist())
        a, b = a / w, b / w
        (side_a, side_b), (at_a, at_b), (half_a, half_b) = (x[k].tolist() for x in (apart, middle, half))
        inward = np.minimum(side_a * (0.5 - np.abs(a - 0.5)), side_b * (0.5 - np.abs(b - 0.5)))
        outward = np.maximum(side_a * (np.abs(a - at_a) - half_a), side_b * (np.abs(b - at_b) - half_b))
        reached = outward < float(room[k])
        near = reached & (inward < _FITTED * float(sigma[k]) + _FITTED_PX)
        if filled:
            near &= outward > -_SLACK  # pixels within the border change too much
        result[top:bottom, left:right][reached & ~near] = np.nan
        v, u = np.nonzero(near)
        parts.append((v + top) * width + (u + left))
    count = np.array([len(part) for part in parts])
    used = np.arange(max(int(count.max(initial=1)), 1)) < count[:, None]
    place = np.concatenate(parts) if parts else np.zeros(0, dtype=np.intp)
    pixels = np.repeat(corners.mean(axis=1)[:, None], used.shape[1], axis=1)
    pixels[used] = np.stack(np.divmod(place, width)[::-1], axis=-1)
    return pixels, used, place


@frozen_dataclass(eq=False)
class _Blurred:
    """Blur at M pixels of each of N cells, in the coordinates of the cell."""

    a: Single  # (N, M) standard deviation along a
    b: Single
    rho: Array  # (N,) correlation
    shift_a: Array  # (N,) displacement of edges towards the light side
    shift_b: Array
    tails: Array  # (1, 2)

    @classmethod
    def of(cls, slopes: Sequence[Array], blur: Array, shift: float, tails: Array) -> _Blurred:
        """From the derivatives of a and b by the pixel, and the blur of cells as in `Appearance`."""
        au, av, bu, bv = slopes
        across_a, across_b = np.sqrt(au * au + av * av), np.sqrt(bu * bu + bv * bv)
        rho = np.clip(blur[:, 2], -_MOST_RHO, _MOST_RHO)
        shifts = shift * across_a.mean(axis=1), shift * across_b.mean(axis=1)
        return cls(
            _single(blur[:, :1]) * across_a, _single(blur[:, 1:2]) * across_b, rho, *shifts, tails[None]
        )

    def pattern(self, a: Single, b: Single, lines: Array, cells: Array) -> Real:
        """Blurred light (N, M) of cells (N, n, n) ``[b, a]`` between lines along both axes, 0 around them."""
        corners, signs = _displaced(np.pad(cells, ((0, 0), (1, 1), (1, 1)))), np.repeat(_SIGNS, len(lines))
        # Most lines are moved in one direction only, as their edges have one polarity.
        on_a, on_b = corners.any(axis=(0, 1)), corners.any(axis=(0, 2))
        W = _single(corners[:, on_b][:, :, on_a].swapaxes(1, 2))
        (za, ea, pa), (zb, eb, pb) = (
            self._profile(x, (np.tile(lines, 2) + shift[:, None] * signs)[:, some], s)
            for x, shift, some, s in ((a, self.shift_a, on_a, self.a), (b, self.shift_b, on_b, self.b))
        )
        total = (W @ eb * ea).sum(axis=1)
        count = next(n for limit, n in _TERMS if np.abs(self.rho).max() <= limit)
        rho = _single(self.rho[:, None])
        power = np.ones_like(rho)
        # Derivatives of Phi: (-1)^(n-1) He_(n-1) phi; the signs cancel in the products.
        before_a, now_a, before_b, now_b = 0 * pa, pa, 0 * pb, pb
        for n in range(1, count + 1):
            power *= rho / np.float32(n)
            total += power * (W @ now_b * now_a).sum(axis=1)
            before_a, now_a = now_a, za * now_a - (n - 1) * before_a
            before_b, now_b = now_b, zb * now_b - (n - 1) * before_b
        return total

    def _profile(self, x: Single, lines: Array, sigma: Single) -> tuple[Single, Single, Single]:
        """Distances (N, L, M) of pixels from lines (N, L) in sigma, light and density of an edge there."""
        z = (x[:, None] - _single(lines)[..., None]) / sigma[:, None]
        value, _, density = profile(z.reshape(1, -1), _single(self.tails))
        return z, 0.5 * (1 + value.reshape(z.shape)), density.reshape(z.shape)


def _displaced(cells: Array) -> Array:
    """Corners (N, 2 m, 2 m) of patterns ``[b, a]``, by the directions in which a shift to the light moves.

    There are two lines for each of the m lines between the cells, moved backwards and forwards. An edge moves
    with an axis if its light side is that of the growing axis. A corner is where an edge across a, on one
    side of it, meets an edge across b; where squares of one colour touch it is four of them.
    """
    corners = cells[:, 1:, 1:] - cells[:, 1:, :-1] - cells[:, :-1, 1:] + cells[:, :-1, :-1]
    across_a, across_b = np.sign(np.diff(cells, axis=2)), np.sign(np.diff(cells, axis=1))
    both_a, both_b = (across_a[:, :-1], across_a[:, 1:]), (across_b[:, :, :-1], across_b[:, :, 1:])
    meeting = (np.abs(both_a[0]) + np.abs(both_a[1])) * (np.abs(both_b[0]) + np.abs(both_b[1]))
    share = np.divide(corners, meeting, out=np.zeros(corners.shape), where=meeting > 0)
    return np.block(
        [
            [
                share * sum(1.0 * ((x == along_a) & (y == along_b)) for x, y in product(both_a, both_b))
                for along_a in _SIGNS
            ]
            for along_b in _SIGNS
        ]
    )


def _single(x: Array) -> Single:
    return np.asarray(x, dtype=np.float32)

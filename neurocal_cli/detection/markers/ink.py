"""Take the markers off an image of a board, so that plain squares are left to be measured.

A marker that is read is known to the last bit, and the fit of the board says where its cells lie, how blurred
they are and which levels they have. What they change in each pixel follows, and is taken off again around the
marker. Pixels within it are left out.

In the coordinates (a, b) of a cell of the board, the marker is a pattern of rectangles, and the light of a
blurred pattern is a sum over the corners of its outline,

    x = sum_ij W_ij P(a - a_i, b - b_j),   P(x, y) = Phi(x / s_a) Phi(y / s_b) + sum_n rho^n / n! phi_n phi_n

with Phi the normal distribution function, s_a and s_b the blur along the axes, rho its correlation, which
perspective makes, and phi_n the derivatives of Phi (Mehler's series). Edges are displaced by the shift that
the fit found for all edges, and the response F applies to the sum of pattern and squares.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.edge_profile import profile, response
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.local_inverse import LocalInverse

_REACH = 4.5  # sigma around a cell of the board
_SLACK = 1.3  # for the different sizes of a cell's parts
_FITTED, _FITTED_PX = 6.0, 2.0  # sigma and px from an edge, beyond which fits use no pixels
_SAMPLES = 6  # along its sides
_TERMS = ((0.02, 1), (0.1, 2), (0.3, 4), (0.5, 7), (1.0, 12))  # of the series up to a correlation
_MOST_RHO = 0.9


@frozen_dataclass(eq=False)
class Ink:
    """The inner pattern of N cells of a board."""

    cell: NDArray[np.int64]  # (N, 2) (c, r) of the cell's first vertex in the coordinates of the map
    lines: Array  # (n + 1,) places of the pattern's lines along a side of the cell, from 0 to 1
    light: Array  # (N, n, n) -1 or 1: colours of the pattern, [b, a]
    base: Array  # (N,) -1 or 1: colour of the cell without its pattern


@frozen_dataclass(eq=False)
class Appearance:
    """How a board looks in an image, for its ink."""

    map: SmoothMap
    # (N, 3) blur at each cell, the pixel included: along the normals of lines along b and along a [px], and
    # the correlation of both
    blur: Array
    shift: float  # [px] of edges towards the light side
    shading: Shading
    tails: Array  # (2,) of the profile of all edges, and ...
    nonlinearity: Array  # ... of the response; see `edge_profile`


def without_ink(image: NDArray[np.generic], ink: Ink, look: Appearance, most: float) -> NDArray[np.float32]:
    """The image (H, W) without patterns near the edges of their cells, and NaN within the patterns.

    `most` is the change of the light, in half contrasts, beyond which a pixel is left out.
    """
    result = image.astype(np.float32)
    nonlinear = bool(look.nonlinearity.any())
    for cell, light, base, blur in zip(ink.cell, ink.light, ink.base, look.blur, strict=True):
        inner = light - base
        inverse = _inverse(look.map, cell)
        pixels = None if inverse is None else _pixels_of(cell, look.map, blur, result.shape)
        if inverse is None or pixels is None or not inner.any():
            continue
        near, within = _selected(inverse, pixels, ink.lines, inner, float(blur[:2].max()))
        u, v = pixels[within].T.astype(np.intp)
        result[v, u] = np.nan
        if not near.any():
            continue
        some = pixels[near]
        a, b = inverse.at(some)
        pattern = _Blurred.of(inverse.slopes(some), blur, look.shift, look.tails)
        change = pattern.pattern(a, b, ink.lines, inner)
        _, contrast = look.shading.at(some)
        if nonlinear:
            plain = np.clip(pattern.squares(a, b, base), -1, 1)
            seen = np.clip(plain + change, -1, 1)
            change = response(seen, look.nonlinearity)[0] - response(plain, look.nonlinearity)[0]
        u, v = some.T.astype(np.intp)
        result[v, u] -= np.where(np.abs(change) > most, np.nan, contrast * change).astype(np.float32)
    return result


def _pixels_of(cell: NDArray[np.int64], at: SmoothMap, blur: Array, shape: tuple[int, ...]) -> Array | None:
    """Pixels (N, 2) of the image around a cell, as far as its blur reaches."""
    corners = at.at(cell + np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))
    room = _REACH * blur[:2].max()
    low = np.maximum(np.floor(corners.min(axis=0) - room), 0).astype(np.intp)
    high = np.minimum(np.ceil(corners.max(axis=0) + room) + 1, shape[::-1]).astype(np.intp)
    if (high <= low).any():
        return None
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].reshape(2, -1)
    return np.stack([u, v], axis=-1).astype(float)


def _selected(
    inverse: LocalInverse, pixels: Array, lines: Array, inner: Array, sigma: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the pixels near the edges of a cell that its pattern reaches, and of those within the pattern.

    The latter are too far from the edges for the fits.
    """
    a, b = inverse.at(pixels)
    au, av, bu, bv = (float(one[0]) for one in inverse.slopes(inverse.centre[None]))
    sides = 1 / np.hypot([au, bu], [av, bv])  # [px] of the cell, between opposite edges
    columns, rows = (np.flatnonzero(inner.any(axis=axis)) for axis in (0, 1))
    inward, outward = np.full(len(a), np.inf), np.full(len(a), -np.inf)
    for place, side, used in ((a, sides[0], columns), (b, sides[1], rows)):
        inward = np.minimum(inward, side * np.minimum(place, 1 - place))
        low, high = lines[used[0]], lines[used[-1] + 1]
        outward = np.maximum(outward, side * np.maximum(low - place, place - high))
    reached = outward < _SLACK * _REACH * sigma
    near = reached & (inward < _FITTED * sigma + _FITTED_PX)
    return near, reached & ~near


def _inverse(at: SmoothMap, cell: NDArray[np.int64]) -> LocalInverse | None:
    """Places in a cell of pixels; None if the camera does not see the cell."""
    ticks = np.linspace(0, 1, _SAMPLES)  # the next cells may be of another size
    samples = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    pixels = at.at(cell + samples)
    return LocalInverse.of(pixels, samples) if np.isfinite(pixels).all() else None


@frozen_dataclass(eq=False)
class _Blurred:
    """Blur at the pixels of a cell, in the coordinates of the cell."""

    a: Array  # (N,) standard deviation along a
    b: Array
    rho: float  # correlation
    shift_a: float  # displacement of edges towards the light side
    shift_b: float
    tails: Array  # (1, 2)

    @classmethod
    def of(
        cls, slopes: tuple[Array, Array, Array, Array], blur: Array, shift: float, tails: Array
    ) -> _Blurred:
        """From the derivatives of a and b by the pixel, and the blur of a cell as in `Appearance`."""
        au, av, bu, bv = slopes
        across_a, across_b = np.hypot(au, av), np.hypot(bu, bv)
        rho = float(np.clip(blur[2], -_MOST_RHO, _MOST_RHO))
        shifts = shift * float(across_a.mean()), shift * float(across_b.mean())
        return cls(blur[0] * across_a, blur[1] * across_b, rho, *shifts, tails[None])

    def pattern(self, a: Array, b: Array, lines: Array, cells: Array) -> Array:
        """Blurred light (N,) of cells ``[b, a]`` between lines along both axes, with 0 around them."""
        padded = np.pad(cells, 1)
        total = np.zeros(len(a))
        for (along_a, along_b), corners in _displaced(padded):
            shifted = lines + along_a * self.shift_a, lines + along_b * self.shift_b
            total += self._sum(a, b, *shifted, corners)
        return total

    def squares(self, a: Array, b: Array, base: float) -> Array:
        """Blurred light (N,) of the squares around the one from 0 to 1, which has the colour `base`."""
        ends = np.array([0.0, 1.0])
        (ea, _), (eb, _) = (
            self._profile((x[:, None] - ends) / s[:, None]) for x, s in ((a, self.a), (b, self.b))
        )
        corners = 4 * base * np.array([[1.0, -1.0], [-1.0, 1.0]])
        # Stripes along both axes, and what is different where they cross.
        stripes = base - base * (1 + ea) @ [1, -1] - base * (1 + eb) @ [1, -1]
        return np.asarray(stripes + self._sum(a, b, ends, ends, corners))

    def _profile(self, z: Array) -> tuple[Array, Array]:
        """Profile of an edge and the normal density at distances in sigma."""
        value, _, density = profile(z, self.tails)
        return np.asarray(value, dtype=float), np.asarray(density, dtype=float)

    def _sum(self, a: Array, b: Array, lines_a: Array, lines_b: Array, W: Array) -> Array:
        """Sum over corners ``W[j, i]`` at (lines_a[i], lines_b[j])."""
        used_a, used_b = np.flatnonzero(W.any(axis=0)), np.flatnonzero(W.any(axis=1))
        if not len(used_a):
            return np.zeros(len(a))
        W = W[np.ix_(used_b, used_a)]
        za = (a[:, None] - lines_a[used_a]) / self.a[:, None]
        zb = (b[:, None] - lines_b[used_b]) / self.b[:, None]
        (ea, pa), (eb, pb) = (self._profile(z) for z in (za, zb))
        total = ((0.5 * (1 + eb)) @ W * (0.5 * (1 + ea))).sum(axis=1)
        count = next(n for limit, n in _TERMS if abs(self.rho) <= limit)
        power = 1.0
        # Derivatives of Phi: (-1)^(n-1) He_(n-1) phi; the signs cancel in the products.
        before_a, now_a, before_b, now_b = np.zeros_like(za), pa, np.zeros_like(zb), pb
        for n in range(1, count + 1):
            power = power * self.rho / n
            total += power * ((now_b @ W) * now_a).sum(axis=1)
            before_a, now_a = now_a, za * now_a - (n - 1) * before_a
            before_b, now_b = now_b, zb * now_b - (n - 1) * before_b
        return total


def _displaced(cells: Array) -> list[tuple[tuple[int, int], Array]]:
    """Corners of a pattern ``[b, a]``, by the directions in which a shift towards the light displaces them.

    An edge moves with an axis if its light side is that of the growing axis. A corner is where an edge across
    a, on one side of it, meets an edge across b; where squares of one colour touch it is four of them.
    """
    corners = cells[1:, 1:] - cells[1:, :-1] - cells[:-1, 1:] + cells[:-1, :-1]
    across_a, across_b = np.sign(np.diff(cells, axis=1)), np.sign(np.diff(cells, axis=0))
    both_a, both_b = (across_a[:-1], across_a[1:]), (across_b[:, :-1], across_b[:, 1:])
    meeting = (np.abs(both_a[0]) + np.abs(both_a[1])) * (np.abs(both_b[0]) + np.abs(both_b[1]))
    share = np.divide(corners, meeting, out=np.zeros(corners.shape), where=meeting > 0)
    parts = []
    for along_a, along_b in product((-1, 1), (-1, 1)):
        met = sum(1.0 * ((x == along_a) & (y == along_b)) for x in both_a for y in both_b)
        if np.any(met):
            parts.append(((along_a, along_b), share * met))
    return parts

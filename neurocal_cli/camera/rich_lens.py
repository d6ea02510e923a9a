"""A smooth displacement of the image by splines, for lenses that no closed formula describes.

The displacement (dx', dy') of a distorted point is a function of its direction. In stereographic coordinates
s = (X, Y) / (d + Z), d = |(X, Y, Z)|, whose length is tan(theta / 2), it is

    s / |s| sum_i g_i (B(|s| / h - i) - B(|s| / h + i)) + sum_rc (fx_rc, fy_rc) B(sy / ly - r) B(sx / lx - c)

with the cubic B-spline B. The first term is a radial profile, odd and so smooth on the axis; the second is a
field on a grid around the axis. They cover |s| <= reach, |sx| <= reach_x and |sy| <= reach_y, and fall to 0
within two or three node spacings beyond. Schoeps et al. (2020) calibrate with such fields of directions,
mrcal with stereographic ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array

RADII, GRID = 16, 12  # nodes of the profile, and of the field in each direction
REACHES = ("reach", "reach_x", "reach_y")  # extents of the nodes; never estimated
NODES = (
    *(f"g{n:02d}" for n in range(1, RADII + 1)),
    *(f"f{axis}{row:02d}{column:02d}" for axis in "xy" for row in range(GRID) for column in range(GRID)),
)
NAMES = (*REACHES, *NODES)
FIRST_NODE = 7  # index of the first node among the coefficients, after k1 to k4 and the reaches
_PAD = 3  # rows of zero nodes around the grid, so that the field falls to 0
_LEAST_RADIUS = 1e-6  # |s| below which a direction is on the axis


class Displacement(NamedTuple):
    """A displacement with its derivatives by X, Y, Z and by each of `NAMES`, these only if requested."""

    x: Array
    y: Array
    by_x: tuple[Array, Array, Array]
    by_y: tuple[Array, Array, Array]
    by_coefficient: list[tuple[Array, Array]]


def displacement(k: Array, X: Array, Y: Array, Z: Array, by_coefficients: bool = True) -> Displacement:
    """The displacement with the coefficients `NAMES` in directions X, Y, Z, arrays of one shape in any unit.

    The derivatives by the coefficients, of which there are hundreds, are optional.
    """
    k, shape = np.asarray(k, dtype=float), X.shape
    X, Y, Z = X.ravel(), Y.ravel(), Z.ravel()
    d = np.sqrt(X * X + Y * Y + Z * Z)
    w = d + Z
    sx, sy = X / w, Y / w
    reach, reach_x, reach_y = np.maximum(k[:3], _LEAST_RADIUS).tolist()
    profile, nodes = k[3 : 3 + RADII], k[3 + RADII :].reshape(2, GRID, GRID)
    r = np.maximum(np.hypot(sx, sy), _LEAST_RADIUS)
    radial = _radial(profile, r, reach / (RADII - 1))
    scale = radial.value / r
    bend = (radial.slope - scale) / (r * r)
    field = _field(nodes, sx, sy, 2 * reach_x / (GRID - 3), 2 * reach_y / (GRID - 3))
    (fx, fy), (fx_x, fy_x), (fx_y, fy_y) = field.value, field.by_x, field.by_y
    cross = sx * sy * bend
    by_s = (scale + sx * sx * bend + fx_x, cross + fx_y), (cross + fy_x, scale + sy * sy * bend + fy_y)
    # ds = (dX, dY) / w - s (dX X / d + dY Y / d + dZ w / d) / w
    by = []
    for sx_, sy_ in by_s:
        along = (sx_ * sx + sy_ * sy) / d
        by.append(tuple(a.reshape(shape) for a in (sx_ / w - along * sx, sy_ / w - along * sy, -along)))
    columns: list[tuple[Array, Array]] = []
    if by_coefficients:
        none = np.zeros(len(r))
        ox, oy = sx / r, sy / r
        grows = -radial.slope * r / reach
        columns = [
            (ox * grows, oy * grows),
            (-fx_x * sx / reach_x, -fy_x * sx / reach_x),
            (-fx_y * sy / reach_y, -fy_y * sy / reach_y),
        ]
        columns += [(ox * b, oy * b) for b in radial.basis()]
        of_nodes = field.basis()
        columns += [(b, none) for b in of_nodes] + [(none, b) for b in of_nodes]
        columns = [(a.reshape(shape), b.reshape(shape)) for a, b in columns]
    return Displacement(
        (scale * sx + fx).reshape(shape), (scale * sy + fy).reshape(shape), by[0], by[1], columns
    )


class _Radial(NamedTuple):
    """The radial profile at some radii, with its slope."""

    value: Array
    slope: Array
    first: NDArray[np.intp]
    weights: Array

    def basis(self) -> Array:
        """(RADII, N) values of each node's function."""
        n = len(self.value)
        out, points = np.zeros((RADII + 5, n)), np.arange(n)
        for a, weight in enumerate(self.weights):
            out[self.first + a, points] = weight
        out[2] -= out[0]  # odd: the node at -1 is minus the one at 1, and none is at 0
        return out[2 : RADII + 2]


def _radial(g: Array, r: Array, h: float) -> _Radial:
    first, weights, slopes = _basis(r / h, 0, RADII + 1)
    nodes = np.concatenate([[-g[0], 0.0], g, np.zeros(_PAD)])  # from -1 on
    value = sum(weights[a] * nodes[first + a] for a in range(4))
    slope = sum(slopes[a] * nodes[first + a] for a in range(4)) / h
    return _Radial(np.asarray(value), np.asarray(slope), first, weights)


class _Field(NamedTuple):
    """The field at some places (2, N), with its derivatives."""

    value: Array
    by_x: Array
    by_y: Array
    place: NDArray[np.intp]
    weights_x: Array
    weights_y: Array

    def basis(self) -> Array:
        """(GRID^2, N) values of each node's function, by row."""
        width, n = GRID + 2 * _PAD, len(self.place)
        out, points = np.zeros((width * width, n)), np.arange(n)
        for b in range(4):
            for a in range(4):
                out[self.place + (b * width + a), points] = self.weights_y[b] * self.weights_x[a]
        inner = out.reshape(width, width, n)[_PAD:-_PAD, _PAD:-_PAD]
        return inner.reshape(GRID * GRID, n)


def _field(f: Array, sx: Array, sy: Array, lx: float, ly: float) -> _Field:
    width = GRID + 2 * _PAD
    square = np.zeros((2, width, width))
    square[:, _PAD:-_PAD, _PAD:-_PAD] = f
    nodes = square.reshape(2, -1)
    middle = 0.5 * (GRID - 1)
    column, wx, dx = _basis(sx / lx + middle, 1 - _PAD, GRID)
    row, wy, dy = _basis(sy / ly + middle, 1 - _PAD, GRID)
    # Nodes -3, -2, ... are numbered from 0; the four B-splines start at the node before the point's own.
    place = (row + (_PAD - 1)) * width + column + (_PAD - 1)
    value, by_x, by_y = (np.zeros((2, len(sx))) for _ in range(3))
    for b in range(4):
        of_row = [nodes[:, place + (b * width + a)] for a in range(4)]
        along = sum(wx[a] * of_row[a] for a in range(4))
        value += wy[b] * along
        by_y += dy[b] * along
        by_x += wy[b] * sum(dx[a] * of_row[a] for a in range(4))
    return _Field(value, by_x / lx, by_y / ly, place, wx, wy)


def _basis(t: Array, lowest: int, highest: int) -> tuple[NDArray[np.intp], Array, Array]:
    """The four nonzero cubic B-splines at positions t (N,), in units of the node spacing.

    Returns the node (N,) before t, clipped to the given limits, beyond which the values are those at the
    limit; and the weights and slopes (4, N) of the nodes node - 1 to node + 2.
    """
    t = np.clip(np.nan_to_num(t), lowest, highest + 1)
    node = np.minimum(np.floor(t), highest)
    u = t - node
    v = 1 - u
    weights = np.stack([v**3, (3 * u - 6) * u * u + 4, (3 * v - 6) * v * v + 4, u**3]) / 6
    slopes = np.stack([-v * v, (3 * u - 4) * u, -(3 * v - 4) * v, u * u]) / 2
    return node.astype(np.intp), weights, slopes

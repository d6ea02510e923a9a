"""Where a vertex should be, from its neighbours: a smooth map fitted around every place.

The map is a quadratic polynomial of the grid coordinates, fitted to the vertices at most three
squares away. Its second derivatives are held small, as they are for perspective and lens
distortion, so that few neighbours give a plane map and many a curved one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

__all__ = ["Expected", "expected"]

_REACH = 3  # squares
_WIDTH = 1.4  # squares; of the weights
_HELD_BACK = np.diag([1e-9, 1e-3, 1e-3, 0.15, 0.15, 0.15])

_c, _r = (x.ravel().astype(float) for x in np.meshgrid(*[np.arange(-_REACH, _REACH + 1)] * 2))
_BASIS = np.stack([np.ones_like(_c), _c, _r, 0.5 * _c**2, _c * _r, 0.5 * _r**2], axis=-1)
_WEIGHT = np.exp(-0.5 * (_c**2 + _r**2) / _WIDTH**2) * (_c**2 + _r**2 > 0)
# Products of the basis with itself and its weights, a row for each neighbour.
_PRODUCTS = (_WEIGHT[:, None, None] * _BASIS[:, :, None] * _BASIS[:, None, :]).reshape(len(_c), -1)
_RIGHT = _WEIGHT[:, None] * _BASIS


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected vertices.

    Attributes
    ----------
    points : (N, 2) array [px]
    c, r : (N, 2) array [px]
        The ways to the next vertex along a row and along a column.
    spread : (N,) array
        Standard deviation of the point per standard deviation of a vertex.
    """

    points: Array
    c: Array
    r: Array
    spread: Array

    def __getitem__(self, which: NDArray[np.generic]) -> Expected:
        """Some of them."""
        return Expected(self.points[which], self.c[which], self.r[which], self.spread[which])

    @property
    def area(self) -> Array:
        """(N,) of a square [px^2]; negative when mirrored."""
        return np.asarray(self.c[:, 0] * self.r[:, 1] - self.c[:, 1] * self.r[:, 0])

    @property
    def width(self) -> Array:
        """(N,) distance between opposite sides of a square, the smaller one [px]."""
        longest = np.maximum(np.hypot(*self.c.T), np.hypot(*self.r.T))
        return np.asarray(np.abs(self.area) / np.maximum(longest, 1e-9))

    def in_squares(self, away: Array) -> Array:
        """Pixel offsets (N, 2) as shares of `c` and `r`."""
        area = self.area
        area = np.where(np.abs(area) > 1e-9, area, 1e-9)
        along = (away[:, 0] * self.r[:, 1] - away[:, 1] * self.r[:, 0]) / area
        across = (self.c[:, 0] * away[:, 1] - self.c[:, 1] * away[:, 0]) / area
        return np.stack([along, across], axis=-1)


def expected(pixels: Array, row: NDArray[np.intp], col: NDArray[np.intp]) -> Expected:
    """Expect vertices where their neighbours put them, whether they are known or not.

    Parameters
    ----------
    pixels : (rows, cols, 2) array [px]
        nan where unknown.
    row, col : (N,) int arrays
    """
    rows, cols = pixels.shape[:2]
    framed = np.full((2, rows + 2 * _REACH, cols + 2 * _REACH), np.nan)
    framed[:, _REACH:-_REACH, _REACH:-_REACH] = pixels.transpose(2, 0, 1)
    size, width = np.arange(2 * _REACH + 1), framed.shape[2]
    window = (size[:, None] * width + size).ravel()
    near = framed.reshape(2, -1)[:, (row * width + col)[:, None] + window]
    seen = ~np.isnan(near[0])
    known = seen.astype(float)
    # About the mean of the neighbours, for the sake of rounding.
    near = np.where(seen, near, 0.0)
    origin = near.sum(axis=2) / np.maximum(known.sum(axis=1), 1.0)
    near -= origin[:, :, None] * known
    normal = (known @ _PRODUCTS).reshape(-1, 6, 6)
    normal += _HELD_BACK
    inverse = np.linalg.inv(normal)
    right = (near.reshape(-1, len(window)) @ _RIGHT).reshape(2, -1, 6)
    solution = inverse @ right.transpose(1, 2, 0)
    return Expected(solution[:, 0] + origin.T, solution[:, 1], solution[:, 2], np.sqrt(inverse[:, 0, 0]))

"""The grid of vertices of a board while it is being found, and their prediction from their neighbours.

The prediction is a local regression. The map is a quadratic polynomial of the grid coordinates, fitted to the
vertices at most three squares away by weighted ridge regression. The ridge keeps second derivatives small, as
they are under perspective and distortion, so few neighbours give a linear map.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.saddles import window
from neurocal_cli.detection.medians import median

Index = NDArray[np.intp]

LEAST_SIGMA = 0.75  # px; least smoothing of derivatives, for the narrowest squares

# _REACH and _RIDGE are insensitive; test_finding.py.
_REACH = 3  # squares
_WIDTH = 1.4  # squares; standard deviation of the Gaussian weights
_RIDGE = np.diag([1e-9, 1e-3, 1e-3, 0.15, 0.15, 0.15])

_c, _r = (x.ravel().astype(float) for x in np.meshgrid(*[np.arange(-_REACH, _REACH + 1)] * 2))
_BASIS = np.stack([np.ones_like(_c), _c, _r, 0.5 * _c**2, _c * _r, 0.5 * _r**2], axis=-1)
_WEIGHT = np.exp(-0.5 * (_c**2 + _r**2) / _WIDTH**2) * (_c**2 + _r**2 > 0)
# Weighted outer products of the basis, a row for each neighbour, and a column of ones that counts neighbours.
_PRODUCTS = np.column_stack(
    [
        (_WEIGHT[:, None, None] * _BASIS[:, :, None] * _BASIS[:, None, :]).reshape(len(_c), -1),
        np.ones(len(_c)),
    ]
)
_RIGHT = _WEIGHT[:, None] * _BASIS
_FIRST, _ONES = np.eye(6)[0], np.ones(len(_c))


@frozen_dataclass(eq=False)
class Lattice:
    """A grid that is being found."""

    pixels: Array  # (rows, cols, 2) [px of its level]; NaN where unknown
    contrast: Array  # (rows, cols) [DN]; NaN where unknown
    dark: int  # 0 or 1: the square between (c, r) and (c + 1, r + 1) is dark where c + r + dark is even

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(rows, cols) mask of the known vertices."""
        return np.isfinite(self.pixels[..., 0])

    @cached_property
    def predicted(self) -> tuple[Index, Index, PredictedVertices]:
        """Rows and columns (N,) of the known vertices, and their predictions from neighbours."""
        row, col = np.nonzero(self.seen)
        return row, col, predict_vertices(self.pixels, row, col)

    @property
    def width(self) -> float:
        """Median of the squares' widths, each the smaller distance of opposite sides [px]."""
        p = self.pixels
        c, r = p[:-1, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, :-1]
        area = np.abs(c[..., 0] * r[..., 1] - c[..., 1] * r[..., 0])
        longest = np.maximum(np.hypot(c[..., 0], c[..., 1]), np.hypot(r[..., 0], r[..., 1]))
        known = longest > 0
        return median(area[known] / longest[known]) if known.any() else 0.0

    @property
    def derivative_sigma(self) -> float:
        """Smoothing of derivatives for squares of this width [px], in steps of 0.25 px to reuse kernels."""
        return min(max(round(0.15 * self.width / 0.25) * 0.25, LEAST_SIGMA), 2.0)

    def padded(self) -> tuple[Lattice, tuple[int, int]]:
        """Add an empty row or column at each side without one; also returns the shift of the indices."""
        seen = self.seen
        top, bottom, left, right = (int(line.any()) for line in (seen[0], seen[-1], seen[:, 0], seen[:, -1]))
        if top + left + bottom + right == 0:
            return self, (0, 0)
        room, nan = (top, bottom, left, right, cv2.BORDER_CONSTANT), (np.nan, np.nan)
        pixels, contrast = (
            np.asarray(cv2.copyMakeBorder(x, *room, value=nan), dtype=float)
            for x in (self.pixels, self.contrast)
        )
        return Lattice(pixels, contrast, (self.dark + top + left) % 2), (top, left)

    def cropped(self) -> Lattice:
        """Remove outer rows and columns without vertices."""
        row, col = np.nonzero(self.seen)
        if not len(row):
            return self
        top, left, bottom, right = row.min(), col.min(), row.max() + 1, col.max() + 1
        if top == left == 0 and (bottom, right) == self.contrast.shape:
            return self
        part = slice(top, bottom), slice(left, right)
        dark = int(self.dark + top + left) % 2
        return Lattice(self.pixels[part], self.contrast[part], dark)

    def subset(self, kept: NDArray[np.bool_]) -> Lattice:
        """Keep the vertices of a (rows, cols) mask."""
        pixels = np.where(kept[..., None], self.pixels, np.nan)
        return replace(self, pixels=pixels, contrast=np.where(kept, self.contrast, np.nan)).cropped()

    def connected_parts(self) -> list[Lattice]:
        """Parts whose vertices are connected along rows and columns."""
        count, label = cv2.connectedComponents(self.seen.astype(np.uint8), connectivity=4)
        if count == 2:
            return [self.cropped()]
        return [self.subset(label == k) for k in range(1, count)]


def signs(row: Index, col: Index, dark: int) -> Array:
    """+1 if the square towards growing c and r is dark, else -1."""
    return np.where((row + col + dark) % 2 == 0, 1.0, -1.0)


def in_whole_square(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of the vertices of complete squares, given the (rows, cols) mask of known vertices."""
    corners, kernel = seen.view(np.uint8), np.ones((2, 2), np.uint8)
    whole = cv2.erode(corners, kernel, anchor=(1, 1), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(cv2.dilate(whole, kernel, anchor=(0, 0)) > 0)


@frozen_dataclass(eq=False)
class PredictedVertices:
    """N predicted vertices."""

    points: Array  # (N, 2) [px]
    steps: Array  # (N, 2, 2) [px] to the next vertex along the point's row, and along its column
    spread: Array  # (N,) standard deviation of the point for unit standard deviation of the vertices

    def __getitem__(self, which: NDArray[np.generic]) -> PredictedVertices:
        """Select some predictions."""
        return PredictedVertices(self.points[which], self.steps[which], self.spread[which])

    @property
    def c(self) -> Array:
        """(N, 2) steps along a row [px]."""
        return self.steps[:, 0]

    @property
    def r(self) -> Array:
        """(N, 2) steps along a column [px]."""
        return self.steps[:, 1]

    @cached_property
    def area(self) -> Array:
        """(N,) area of a square [px^2]; negative if mirrored."""
        return np.asarray(self.c[:, 0] * self.r[:, 1] - self.c[:, 1] * self.r[:, 0])

    @property
    def width(self) -> Array:
        """(N,) smaller distance between opposite sides of a square [px]."""
        length = np.hypot(self.steps[..., 0], self.steps[..., 1])
        longest = np.maximum(length[:, 0], length[:, 1])
        return np.asarray(np.abs(self.area) / np.maximum(longest, 1e-9))

    def around(self, shares: Array, points: Array) -> Array:
        """Places (N, K, 2) around points (N, 2), at offsets (K, 2) in units of `c` and `r`."""
        return np.asarray(points[:, None] + shares @ self.steps)

    def in_squares(self, away: Array) -> Array:
        """Convert pixel offsets (N, 2) to units of `c` and `r`."""
        area = self.area
        area = np.where(np.abs(area) > 1e-9, area, 1e-9)
        out = np.empty(away.shape)
        np.subtract(away[:, 0] * self.r[:, 1], away[:, 1] * self.r[:, 0], out=out[:, 0])
        np.subtract(self.c[:, 0] * away[:, 1], self.c[:, 1] * away[:, 0], out=out[:, 1])
        out /= area[:, None]
        return out


def predict_vertices(pixels: Array, row: NDArray[np.intp], col: NDArray[np.intp]) -> PredictedVertices:
    """Predict vertices at rows and columns (N,), known or not, of an array (rows, cols, 2) [px]."""
    rows, cols = pixels.shape[:2]
    padded = np.zeros((3, rows + 2 * _REACH, cols + 2 * _REACH))
    inner = padded[:, _REACH:-_REACH, _REACH:-_REACH]
    seen = ~np.isnan(pixels[..., 0])
    np.copyto(inner[:2], pixels.transpose(2, 0, 1), where=seen)
    inner[2] = seen
    width = padded.shape[2]
    place = (row + _REACH) * width + col + _REACH
    near = padded.reshape(3, -1).take(place[:, None] + window(_REACH, width), axis=1)
    known = near[2]
    sums = known @ _PRODUCTS
    normal = sums[:, :-1].reshape(-1, 6, 6) + _RIDGE
    # Subtract the mean of the neighbours, to reduce rounding errors.
    origin = near[:2] @ _ONES
    origin /= np.maximum(sums[:, -1], 1.0)
    offset = near[:2]
    offset -= origin[:, :, None] * known
    right = np.empty((len(row), 6, 3))
    right[:, :, :2] = (offset @ _RIGHT).transpose(1, 2, 0)
    right[:, :, 2] = _FIRST
    solution = np.linalg.solve(normal, right)
    return PredictedVertices(solution[:, 0, :2] + origin.T, solution[:, 1:3, :2], np.sqrt(solution[:, 0, 2]))

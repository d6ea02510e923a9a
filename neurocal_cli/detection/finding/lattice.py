"""The grid of vertices of a board while it is being found on a level of the pyramid."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.predict import PredictedVertices, predict_vertices
from neurocal_cli.detection.medians import median

Index = NDArray[np.intp]

LEAST_SIGMA = 0.75  # px; least smoothing of derivatives, for the narrowest squares


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

    def with_contrast(self, contrast: Array) -> Lattice:
        """Replace the contrasts (rows, cols), keeping the cached predictions."""
        result = replace(self, contrast=contrast)
        vars(result).update({name: x for name, x in vars(self).items() if name == "predicted"})
        return result

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

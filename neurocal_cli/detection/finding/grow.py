"""A grid grows from a block of vertices, layer by layer, as far as the board goes on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.finding.levels import Level, interpolate
from neurocal_cli.detection.finding.predict import PredictedVertices, predict_vertices
from neurocal_cli.detection.finding.subpixel import refine_saddles
from neurocal_cli.detection.finding.vertex_check import check_vertices
from neurocal_cli.detection.medians import median
from neurocal_cli.geometry import Array

__all__ = [
    "Lattice",
    "check_lattice",
    "cropped",
    "derivative_sigma",
    "frontier",
    "grow",
    "in_whole_square",
    "padded",
    "remove_outliers",
    "signs",
]

Index = NDArray[np.intp]

_SEARCHED = 0.24  # squares to either side of where a vertex is expected
_STEPS = 7
_MOST_SPREAD = 5.0  # of an expectation that is worth looking at
_OFF, _OFF_SPREAD, _OFF_PX = 0.045, 0.025, 0.45  # squares, squares per spread, px: see `_tolerance`
_WEAKEST = 0.55  # least contrast over the neighbours'
_EVEN_ALONE, _OFF_ALONE = 0.88, 0.3  # of a vertex that closes no square; the latter over the tolerance
_LAYERS = 200
_ROUNDS = 12  # of taking out wrong vertices, at most


@dataclass(frozen=True, eq=False)
class Lattice:
    """A grid while it grows.

    Attributes
    ----------
    pixels : (rows, cols, 2) array [px of its level]
        nan where unknown.
    contrast : (rows, cols) array [DN]
        Around each known vertex; nan elsewhere.
    dark : int
        0 or 1: the square between (c, r) and (c + 1, r + 1) is dark where ``c + r + dark`` is even.
    """

    pixels: Array
    contrast: Array
    dark: int

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(rows, cols) which vertices are known."""
        return np.isfinite(self.pixels[..., 0])

    @cached_property
    def known(self) -> tuple[Index, Index, PredictedVertices]:
        """Rows and columns (N,) of the known vertices, and where their neighbours put them."""
        row, col = np.nonzero(self.seen)
        return row, col, predict_vertices(self.pixels, row, col)

    def with_contrast(self, contrast: Array) -> Lattice:
        """The same vertices, with contrasts (rows, cols) that have been looked at again."""
        result = replace(self, contrast=contrast)
        vars(result).update({name: x for name, x in vars(self).items() if name == "known"})
        return result

    @property
    def width(self) -> float:
        """Median of the squares' narrower widths [px]."""
        p = self.pixels
        c, r = p[:-1, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, :-1]
        area = np.abs(c[..., 0] * r[..., 1] - c[..., 1] * r[..., 0])
        longest = np.maximum(np.hypot(c[..., 0], c[..., 1]), np.hypot(r[..., 0], r[..., 1]))
        known = longest > 0
        return median(area[known] / longest[known]) if known.any() else 0.0


def signs(row: Index, col: Index, dark: int) -> Array:
    """+1 where the square towards growing c and r is dark, else -1."""
    return np.where((row + col + dark) % 2 == 0, 1.0, -1.0)


def derivative_sigma(width: float) -> float:
    """Smoothing of derivatives for squares of a width, a few values only [px]."""
    return min(max(round(0.15 * width / 0.25) * 0.25, 0.75), 2.0)


def grow(level: Level, lattice: Lattice, outwards: bool = True, reach: int = 1) -> Lattice:
    """Add vertices between and, unless told otherwise, around the known ones until none fits any more.

    With a reach of 2, one vertex in a row may be hidden and the next still be found.
    """
    sigma, start = derivative_sigma(lattice.width), lattice
    tried: set[tuple[int, int, int]] = set()
    top, left = 0, 0  # how far its vertices have moved
    for _ in range(_LAYERS):
        if outwards:
            lattice, shift = padded(lattice)
            top, left = top + shift[0], left + shift[1]
        row, col, support = _frontier(lattice.seen, reach)
        # A place is looked at again only when it has more neighbours than before.
        keys = list(zip((row - top).tolist(), (col - left).tolist(), support.tolist(), strict=True))
        fresh = [k for k, key in enumerate(keys) if key not in tried]
        if not fresh:
            break
        tried.update(keys)
        if len(fresh) < len(keys):
            row, col = row[fresh], col[fresh]
        lattice = _grow_layer(level, lattice, row, col, sigma, reach)
    return cropped(lattice if lattice.seen.sum() > start.seen.sum() else start)


def padded(lattice: Lattice) -> tuple[Lattice, tuple[int, int]]:
    """Give a lattice room of one place on every side; how far its vertices moved."""
    rows, cols = lattice.contrast.shape
    seen = lattice.seen
    top, left = int(seen[0].any()), int(seen[:, 0].any())
    bottom, right = int(seen[-1].any()), int(seen[:, -1].any())
    if top + left + bottom + right == 0:
        return lattice, (0, 0)
    pixels = np.full((rows + top + bottom, cols + left + right, 2), np.nan)
    contrast = np.full(pixels.shape[:2], np.nan)
    pixels[top : top + rows, left : left + cols] = lattice.pixels
    contrast[top : top + rows, left : left + cols] = lattice.contrast
    return Lattice(pixels, contrast, (lattice.dark + top + left) % 2), (top, left)


def cropped(lattice: Lattice) -> Lattice:
    """Cut off rows and columns without any vertex."""
    row, col = np.nonzero(lattice.seen)
    if not len(row):
        return lattice
    top, left, bottom, right = row.min(), col.min(), row.max() + 1, col.max() + 1
    if top == left == 0 and (bottom, right) == lattice.contrast.shape:
        return lattice
    part = slice(top, bottom), slice(left, right)
    dark = int(lattice.dark + top + left) % 2
    return Lattice(lattice.pixels[part], lattice.contrast[part], dark)


def _around(values: NDArray[np.generic]) -> Array:
    """Sum over the 3 x 3 places around each."""
    whole = values.astype(float)
    return np.asarray(cv2.boxFilter(whole, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT))


def frontier(lattice: Lattice) -> tuple[Index, Index]:
    """Unknown places with a known neighbour along an edge and another one near."""
    return _frontier(lattice.seen, 1)[:2]


_BESIDE = 16  # what a neighbour along an edge counts more than one at a corner
_COUNTS = np.array(
    [[1, _BESIDE + 1, 1], [_BESIDE + 1, 1, _BESIDE + 1], [1, _BESIDE + 1, 1]], dtype=np.float32
)


def _frontier(seen: NDArray[np.bool_], reach: int) -> tuple[Index, Index, NDArray[np.generic]]:
    """See `frontier`; with the number of known places around each.

    With a reach of 2, all unknown places at most two from a known one.
    """
    counts = cv2.filter2D(seen.view(np.uint8), -1, _COUNTS, borderType=cv2.BORDER_CONSTANT)
    around = counts % _BESIDE
    near = (counts >= _BESIDE) & (around >= 2) if reach == 1 else _around(_around(seen)) > 0
    row, col = np.nonzero(near & ~seen)
    return row, col, around[row, col]


def _grow_layer(level: Level, lattice: Lattice, row: Index, col: Index, sigma: float, reach: int) -> Lattice:
    """Look for vertices at places of a lattice."""
    predicted = predict_vertices(lattice.pixels, row, col)
    worth = (
        (predicted.spread < _MOST_SPREAD * reach) & (predicted.area > 4) & _inside(level, predicted.points)
    )
    if not worth.all():
        row, col, predicted = row[worth], col[worth], predicted[worth]
    if not len(row):
        return lattice
    dark = signs(row, col, lattice.dark)
    points = refine_saddles(level.image, _steepest_nearby(level, predicted, dark), sigma)
    good = np.isfinite(points[:, 0])
    points = np.where(good[:, None], points, predicted.points)
    good &= _off(predicted, points) < _tolerance(predicted)
    check = check_vertices(level, points, predicted, dark)
    good &= check.is_vertex & (check.contrast > _WEAKEST * _usual_contrast(lattice)[row, col])
    row, col = row[good], col[good]
    pixels, contrast = lattice.pixels.copy(), lattice.contrast.copy()
    pixels[row, col], contrast[row, col] = points[good], check.contrast[good]
    return Lattice(pixels, contrast, lattice.dark)


def _usual_contrast(lattice: Lattice) -> Array:
    """(rows, cols) mean contrast of the known vertices at most two away, the nearer ones counting more."""
    seen = lattice.seen
    known = np.where(seen, lattice.contrast, 0.0)
    return np.asarray(_around(_around(known)) / np.maximum(_around(_around(seen)), 1))


def _off(predicted: PredictedVertices, points: Array) -> Array:
    """(N,) how far points are from where they are expected, along the farther way [squares]."""
    away = np.abs(predicted.in_squares(points - predicted.points))
    return np.maximum(away[:, 0], away[:, 1])


def _tolerance(predicted: PredictedVertices) -> Array:
    """How far a vertex may be from where it is expected; (N,) [squares]."""
    return np.asarray(_OFF + _OFF_SPREAD * predicted.spread + _OFF_PX / np.maximum(predicted.width, 1e-3))


def _inside(level: Level, points: Array) -> NDArray[np.bool_]:
    height, width = level.image.shape
    u, v = points.T
    return np.asarray((u > 1) & (v > 1) & (u < width - 2) & (v < height - 2))


_SHARES = np.stack(np.meshgrid(*[np.linspace(-_SEARCHED, _SEARCHED, _STEPS)] * 2), axis=-1).reshape(-1, 2)
_PRIOR = 1 - 0.4 * np.abs(_SHARES).max(axis=1) / _SEARCHED


def _steepest_nearby(level: Level, predicted: PredictedVertices, dark: Array) -> Array:
    """Places near the expected ones where a saddle of the right colours is steepest; (N, 2) [px]."""
    places = predicted.around(_SHARES, predicted.points)
    maps = places.astype(np.float32)
    uu, uv, vv = (interpolate(x, maps) for x in level.curvature)
    (c_u, c_v), (r_u, r_v) = -dark * predicted.c.T, predicted.r.T
    steepness = (c_u * r_u)[:, None] * uu
    steepness += (c_v * r_v)[:, None] * vv
    steepness += (c_u * r_v + c_v * r_u)[:, None] * uv
    steepness *= _PRIOR
    return np.asarray(places[np.arange(len(places)), steepness.argmax(axis=1)])


def check_lattice(level: Level, lattice: Lattice) -> tuple[Lattice, NDArray[np.bool_]]:
    """The lattice with its vertices' contrasts, and which of them look right and are where they should be."""
    row, col, predicted = lattice.known
    points = lattice.pixels[row, col]
    check = check_vertices(level, points, predicted, signs(row, col, lattice.dark))
    contrast = lattice.contrast.copy()
    contrast[row, col] = check.contrast
    result = lattice.with_contrast(contrast)
    right = (
        check.is_vertex
        & (_off(predicted, points) < _tolerance(predicted))
        & (predicted.area > 4)
        & (predicted.spread < 2 * _MOST_SPREAD)
    )
    right &= check.contrast > _WEAKEST * _usual_contrast(result)[row, col]
    good = np.zeros(contrast.shape, dtype=bool)
    good[row, col] = right
    return result, good


def remove_outliers(level: Level, lattice: Lattice) -> Lattice:
    """Take out vertices that look wrong or are not where their neighbours put them."""
    for _ in range(_ROUNDS):
        row, col, predicted = lattice.known
        if not len(row):
            break
        pixels, contrast, seen = lattice.pixels, lattice.contrast.copy(), lattice.seen
        points = pixels[row, col]
        off = _off(predicted, points) / _tolerance(predicted)
        off = np.where((predicted.area > 0) & (predicted.spread < 2 * _MOST_SPREAD), off, np.inf)
        check = check_vertices(level, points, predicted, signs(row, col, lattice.dark))
        # One that closes no square has little that speaks for it.
        closes = in_whole_square(seen)[row, col]
        plain = check.is_vertex & (closes | ((check.evenness > _EVEN_ALONE) & (off < _OFF_ALONE)))
        off = np.where(plain, off, np.inf)
        contrast[row, col] = check.contrast
        if not (off > 1).any():
            lattice = lattice.with_contrast(contrast)
            break
        # Next to a bad vertex good ones look bad too: only the worst of each place goes.
        worst = np.zeros(pixels.shape[:2])
        worst[row, col] = off
        bad = (worst > 1) & (worst >= _largest_around(worst))
        pixels = np.where(bad[..., None], np.nan, pixels)
        lattice = Lattice(pixels, np.where(bad, np.nan, contrast), lattice.dark)
    return cropped(lattice)


def in_whole_square(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which vertices are corners of a square with four known corners."""
    whole = seen[:-1, :-1] & seen[:-1, 1:] & seen[1:, :-1] & seen[1:, 1:]
    in_whole_square = np.zeros_like(seen)
    for part in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]):
        in_whole_square[part] |= whole
    return in_whole_square


def _largest_around(values: Array) -> Array:
    """Maximum over the 3 x 3 places around each."""
    padded = np.zeros((values.shape[0] + 2, values.shape[1] + 2))
    padded[1:-1, 1:-1] = values
    rows = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.asarray(np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]))

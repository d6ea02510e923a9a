"""A grid grows from a block of vertices, layer by layer, as far as the board goes on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.finding.levels import Level, sampled
from neurocal_cli.detection.finding.predict import Expected, expected
from neurocal_cli.detection.finding.refine import settle
from neurocal_cli.detection.finding.verify import look
from neurocal_cli.geometry import Array

__all__ = ["Lattice", "cleaned", "cropped", "framed", "frontier", "grown", "signs", "smoothing"]

Index = NDArray[np.intp]

_SEARCHED = 0.24  # squares to either side of where a vertex is expected
_STEPS = 7
_MOST_SPREAD = 5.0  # of an expectation that is worth looking at
_OFF, _OFF_SPREAD, _OFF_PX = 0.045, 0.025, 0.45  # squares, squares per spread, px: see `_tolerance`
_WEAKEST = 0.55  # least contrast over the neighbours'
_EVEN_ALONE, _OFF_ALONE = 0.88, 0.3  # of a vertex that closes no square; the latter over the tolerance
_LAYERS = 200


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
    def known(self) -> tuple[Index, Index, Expected]:
        """Rows and columns (N,) of the known vertices, and where their neighbours put them."""
        row, col = np.nonzero(self.seen)
        return row, col, expected(self.pixels, row, col)

    @property
    def width(self) -> float:
        """Median of the squares' narrower widths [px]."""
        p = self.pixels
        c, r = p[:-1, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, :-1]
        area = np.abs(c[..., 0] * r[..., 1] - c[..., 1] * r[..., 0])
        longest = np.sqrt(np.maximum((c**2).sum(axis=-1), (r**2).sum(axis=-1)))
        known = np.isfinite(area) & (longest > 0)
        return float(np.median(area[known] / longest[known])) if known.any() else 0.0


def signs(row: Index, col: Index, dark: int) -> Array:
    """+1 where the square towards growing c and r is dark, else -1."""
    return np.where((row + col + dark) % 2 == 0, 1.0, -1.0)


def smoothing(width: float) -> float:
    """Smoothing of derivatives for squares of a width, a few values only [px]."""
    return float(np.clip(np.round(0.15 * width / 0.25) * 0.25, 0.75, 2.0))


def grown(level: Level, lattice: Lattice, outwards: bool = True, reach: int = 1) -> Lattice:
    """Add vertices between and, unless told otherwise, around the known ones until none fits any more.

    With a reach of 2, one vertex in a row may be hidden and the next still be found.
    """
    sigma = smoothing(lattice.width)
    tried: set[tuple[int, int, int]] = set()
    origin = np.zeros(2, dtype=np.intp)
    for _ in range(_LAYERS):
        if outwards:
            lattice, shift = framed(lattice)
            origin = origin + shift
        row, col = frontier(lattice, reach)
        # A place is looked at again only when it has more neighbours than before.
        support = _around(lattice.seen)[row, col]
        keys = list(
            zip((row - origin[0]).tolist(), (col - origin[1]).tolist(), support.tolist(), strict=True)
        )
        fresh = np.array([key not in tried for key in keys], dtype=bool)
        tried.update(keys)
        row, col = row[fresh], col[fresh]
        if not len(row):
            break
        lattice, added = _layer(level, lattice, row, col, sigma, reach)
        if not added and not fresh.any():
            break
    return cropped(lattice)


def framed(lattice: Lattice) -> tuple[Lattice, Index]:
    """Give a lattice room of one place on every side; how far its vertices moved."""
    rows, cols = lattice.contrast.shape
    seen = lattice.seen
    top, left = int(seen[0].any()), int(seen[:, 0].any())
    bottom, right = int(seen[-1].any()), int(seen[:, -1].any())
    if top + left + bottom + right == 0:
        return lattice, np.zeros(2, dtype=np.intp)
    pixels = np.full((rows + top + bottom, cols + left + right, 2), np.nan)
    contrast = np.full(pixels.shape[:2], np.nan)
    pixels[top : top + rows, left : left + cols] = lattice.pixels
    contrast[top : top + rows, left : left + cols] = lattice.contrast
    return Lattice(pixels, contrast, (lattice.dark + top + left) % 2), np.array([top, left])


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
    framed = np.zeros((values.shape[0] + 2, values.shape[1] + 2))
    framed[1:-1, 1:-1] = values
    rows = framed[:-2] + framed[1:-1] + framed[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:])


def frontier(lattice: Lattice, reach: int = 1) -> tuple[Index, Index]:
    """Unknown places with a known neighbour along an edge and another one near."""
    seen = lattice.seen
    if reach > 1:
        row, col = np.nonzero(~seen & (_around(_around(seen)) > 0))
        return row, col
    beside = np.zeros_like(seen)
    beside[1:] |= seen[:-1]
    beside[:-1] |= seen[1:]
    beside[:, 1:] |= seen[:, :-1]
    beside[:, :-1] |= seen[:, 1:]
    row, col = np.nonzero(~seen & beside & (_around(seen) >= 2))
    return row, col


def _layer(
    level: Level, lattice: Lattice, row: Index, col: Index, sigma: float, reach: int
) -> tuple[Lattice, int]:
    """Look for vertices at places of a lattice."""
    at = expected(lattice.pixels, row, col)
    worth = (at.spread < _MOST_SPREAD * reach) & (at.area > 4) & _inside(level, at.points)
    row, col, at = row[worth], col[worth], at[worth]
    if not len(row):
        return lattice, 0
    dark = signs(row, col, lattice.dark)
    points = settle(level.image, _searched(level, at, dark), sigma)
    good = np.isfinite(points[:, 0])
    points = np.where(good[:, None], points, at.points)
    off = np.abs(at.in_squares(points - at.points)).max(axis=1)
    good &= off < _tolerance(at)
    sight = look(level, points, at, dark)
    known = np.where(lattice.seen, lattice.contrast, 0.0)
    weight = _around(_around(lattice.seen))[row, col]
    usual = _around(_around(known))[row, col] / np.maximum(weight, 1)
    good &= sight.like & (sight.contrast > _WEAKEST * usual)
    row, col = row[good], col[good]
    pixels, contrast = lattice.pixels.copy(), lattice.contrast.copy()
    pixels[row, col], contrast[row, col] = points[good], sight.contrast[good]
    return replace(lattice, pixels=pixels, contrast=contrast), len(row)


def _tolerance(at: Expected) -> Array:
    """How far a vertex may be from where it is expected; (N,) [squares]."""
    return np.asarray(_OFF + _OFF_SPREAD * at.spread + _OFF_PX / np.maximum(at.width, 1e-3))


def _inside(level: Level, points: Array) -> NDArray[np.bool_]:
    height, width = level.image.shape
    return np.asarray(((points > 1) & (points < np.array([width, height]) - 2)).all(axis=1))


_SHARES = np.stack(np.meshgrid(*[np.linspace(-_SEARCHED, _SEARCHED, _STEPS)] * 2), axis=-1).reshape(-1, 2)
_PRIOR = 1 - 0.4 * np.abs(_SHARES).max(axis=1) / _SEARCHED


def _searched(level: Level, at: Expected, dark: Array) -> Array:
    """Places near the expected ones where a saddle of the right colours is steepest; (N, 2) [px]."""
    places = at.points[:, None] + _SHARES[:, :1] * at.c[:, None] + _SHARES[:, 1:] * at.r[:, None]
    uu, uv, vv = (sampled(x, places) for x in level.curvature)
    c, r = at.c, at.r
    product = (c[:, 0] * r[:, 0])[:, None] * uu + (c[:, 1] * r[:, 1])[:, None] * vv
    product += (c[:, 0] * r[:, 1] + c[:, 1] * r[:, 0])[:, None] * uv
    steepness = -product * dark[:, None] * _PRIOR
    return np.asarray(places[np.arange(len(places)), steepness.argmax(axis=1)])


def cleaned(level: Level, lattice: Lattice) -> Lattice:
    """Take out vertices that look wrong or are not where their neighbours put them."""
    pixels = lattice.pixels.copy()
    contrast = lattice.contrast.copy()
    for _ in range(12):
        row, col = np.nonzero(np.isfinite(pixels[..., 0]))
        if not len(row):
            break
        points = pixels[row, col]
        at = expected(pixels, row, col)
        off = np.abs(at.in_squares(points - at.points)).max(axis=1) / _tolerance(at)
        off = np.where((at.area > 0) & (at.spread < 2 * _MOST_SPREAD), off, np.inf)
        sight = look(level, points, at, signs(row, col, lattice.dark))
        # One that closes no square has little that speaks for it.
        closes = _squared(np.isfinite(pixels[..., 0]))[row, col]
        plain = sight.like & (closes | ((sight.even > _EVEN_ALONE) & (off < _OFF_ALONE)))
        off = np.where(plain, off, np.inf)
        contrast[row, col] = sight.contrast
        if not (off > 1).any():
            break
        # Next to a bad vertex good ones look bad too: only the worst of each place goes.
        worst = np.zeros(pixels.shape[:2])
        worst[row, col] = off
        pixels[(worst > 1) & (worst >= _largest_around(worst))] = np.nan
    contrast[np.isnan(pixels[..., 0])] = np.nan
    return cropped(replace(lattice, pixels=pixels, contrast=contrast))


def _squared(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which vertices are corners of a square with four known corners."""
    whole = seen[:-1, :-1] & seen[:-1, 1:] & seen[1:, :-1] & seen[1:, 1:]
    squared = np.zeros_like(seen)
    for part in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]):
        squared[part] |= whole
    return squared


def _largest_around(values: Array) -> Array:
    """Maximum over the 3 x 3 places around each."""
    framed = np.zeros((values.shape[0] + 2, values.shape[1] + 2))
    framed[1:-1, 1:-1] = values
    rows = np.maximum(np.maximum(framed[:-2], framed[1:-1]), framed[2:])
    return np.asarray(np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]))

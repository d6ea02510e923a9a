"""Search a board in another view of it, in which its squares are more alike.

Near a wide lens, the squares of a board are bent, and change from one to the next by more than `grow` allows.
They are linked nevertheless, and an equidistant lens and a plane can be fitted to a group of linked saddles.
In a view perpendicular to that plane, lines are straight and squares are equal, so growth finds the missing
vertices (`find_bent`). The image of a very oblique board is stretched across its narrow squares (`stretch`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.lattice import Index, Lattice
from neurocal_cli.detection.finding.links import Links, linked_group, whole_blocks
from neurocal_cli.detection.finding.overlaps import distance
from neurocal_cli.detection.finding.saddles import Level, interpolate, refine_saddles
from neurocal_cli.detection.medians import median
from neurocal_cli.detection.wide_lens import WideFit, fit_wide_lens

# Saddles at a distance between these [squares] from a lattice may be its next line: nearer ones are its own.
_OWN, _BESIDE = 0.4, 2.0
_LIKE, _LINE = 0.5, 3  # least contrast relative to the lattice's, and least number of saddles, of such a line
_GROUPS = 3  # greatest number of linked groups that are tried
_OFF = 0.12  # squares; greatest rms distance of vertices from the fit of the lens ...
_OUTLIER = 0.3  # ... and least limit of the distance beyond which a vertex is an outlier
_ROUNDS = 3  # of removing such outliers
_MORE = 1.1  # a group is searched again if it has this many times the known vertices in it
_AROUND, _LEAST_AROUND = 0.75, 4.0  # margin of the view around the group: share of its extent, least squares
_SQUARE = 24.0  # px; side of a square in the view ...
_MOST_PIXELS = 1.4e6  # ... unless the view would be larger than this
_LARGEST = 1.5  # px; greatest shift of a vertex when it is refined in the image
_SIGMA = 0.15  # squares; smoothing of derivatives, in steps of 0.25 px
# For boards seen almost from the side, as in test_finding.py. The limits have not been varied on images
# that reach this step.
_FACTOR = 2.0  # of the stretch
_ANISOTROPY = 1.8  # least ratio of the rms gradients across and along the squares
_MARGIN = 12  # px; margin around the outermost saddles
_STRAY = 3.0  # median distances from the middle; farther saddles are ignored
_MOST_COVERED = 0.25  # greatest share of the image that the saddles may cover


def any_left(links: Links, known: list[Lattice]) -> bool:
    """Whether linked saddles outside all lattices form a block, or a line beside a lattice."""
    saddles = links.saddles
    linked = (links.to >= 0).any(axis=1)
    blocks = np.zeros(len(saddles), dtype=bool)
    blocks[whole_blocks(links)] = True
    beside = np.zeros(len(saddles), dtype=bool)
    for lattice in known:
        own = lattice.pixels[lattice.seen]
        away = distance(saddles.points, own) / lattice.width
        like = saddles.contrast > _LIKE * median(lattice.contrast)
        beside |= linked & like & (away > _OWN) & (away < _BESIDE)
        blocks &= away > _OWN
    return bool(blocks.any() or np.count_nonzero(beside) >= _LINE)


def find_bent(
    level: Level,
    links: Links,
    known: list[Lattice],
    search: Callable[[NDArray[np.float32]], list[Lattice]],
) -> list[Lattice]:
    """Search again around groups of linked saddles that exceed the lattices.

    The links are those of the whole level, including known lattices. `search` finds the lattices of an image.
    Each lattice found, in the level's pixels, has more vertices than the known ones at the same place.
    """
    found: list[Lattice] = []
    for places, members in _groups(links):
        pixels = links.saddles.points[members]
        if len(pixels) < _MORE * _most_shared([*known, *found], pixels):
            continue
        fit = _fitted(places.astype(float), pixels, level)
        if fit is None:
            continue
        view = PlaneView.of(fit, places.astype(float))
        for lattice in search(view.seen(level.image)):
            inside = _into_image(lattice, view, level)
            own = inside.pixels[inside.seen]
            if len(own) and len(own) > _most_shared([*known, *found], own):
                found.append(inside)
    return found


def _groups(links: Links) -> Iterator[tuple[Index, Index]]:
    """Places (N, 2) and saddles (N,) of linked groups of at least 9, each from a different middle saddle."""
    middles = whole_blocks(links)
    covered = np.zeros(len(links.to), dtype=bool)
    for _ in range(_GROUPS):
        free = middles[~covered[middles]]
        if not len(free):
            return
        # The vertex with the highest contrast is the least likely to be clutter.
        middle = int(free[np.argmax(links.saddles.contrast[free])])
        places, members = linked_group(links, middle)
        covered[members] = covered[middle] = True
        if len(members) >= 9:
            yield places, members


def _most_shared(lattices: list[Lattice], pixels: Array) -> int:
    """Greatest number of vertices that a lattice has among pixels (N, 2)."""
    shared = (distance(x.pixels[x.seen], pixels) < 0.25 * x.width for x in lattices)
    return max((int(near.sum()) for near in shared), default=0)


def _fitted(places: Array, pixels: Array, level: Level) -> WideFit | None:
    """Fit lens and plane robustly to the vertices of a group; None if they do not fit."""
    height, width = level.image.shape
    kept = np.ones(len(places), dtype=bool)
    for _ in range(_ROUNDS):
        fit = fit_wide_lens(places[kept], pixels[kept], (width, height))
        if not np.isfinite(fit.rms):
            return None
        off = np.hypot(*(fit.at(places) - pixels).T) / _widths(fit, places)
        good = off < max(_OUTLIER, 3 * median(off))
        if good.sum() < 9 or (good == kept).all():
            break
        kept = good
    return fit if np.sqrt((off[kept] ** 2).mean()) < _OFF and kept.mean() > 0.7 else None


def _widths(fit: WideFit, places: Array) -> Array:
    """(N,) geometric mean sides of the squares around places [px]."""
    corner = fit.at(places[:, None] + 0.5 * np.array([[0, 0], [1, 0], [0, 1]]))
    c, r = 2 * (corner[:, 1] - corner[:, 0]), 2 * (corner[:, 2] - corner[:, 0])
    return np.sqrt(np.maximum(np.abs(c[:, 0] * r[:, 1] - c[:, 1] * r[:, 0]), 1e-6))


@frozen_dataclass(eq=False)
class PlaneView:
    """A view perpendicular to a plane, sampled from the image through the fitted lens."""

    fit: WideFit
    square: float  # [px] side of a square in the view
    first: Array  # (2,) [squares] grid coordinates of the view's first pixel
    size: tuple[int, int]  # (width, height) [px]

    @classmethod
    def of(cls, fit: WideFit, places: Array) -> PlaneView:
        """Choose the view that shows places (N, 2) of the plane and their surroundings."""
        low, high = places.min(axis=0), places.max(axis=0)
        around = np.maximum(_AROUND * (high - low), _LEAST_AROUND)
        extent = high - low + 2 * around
        square = min(_SQUARE, float(np.sqrt(_MOST_PIXELS / extent.prod())))
        width, height = np.ceil(square * extent).astype(int).tolist()
        return cls(fit, square, low - around, (width, height))

    def back(self, points: Array) -> Array:
        """Map points (..., 2) of the view to the image [px]."""
        return self.fit.at(self.first + points / self.square)

    def seen(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Sample the view from the image."""
        width, height = self.size
        v, u = np.mgrid[0:height, 0:width].astype(float)
        return interpolate(image, self.back(np.stack([u, v], axis=-1))).astype(np.float32)


def _into_image(lattice: Lattice, view: PlaneView, level: Level) -> Lattice:
    """Map a lattice of the view to the level, without vertices outside the level."""
    pixels = view.back(lattice.pixels)
    room = np.array(level.image.shape[::-1]) - 2
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((pixels >= 1) & (pixels <= room)).all(axis=-1))
    kept = replace(lattice, pixels=pixels).subset(inside)
    return refined(level, kept, local_sigma(kept), _LARGEST)


def local_sigma(lattice: Lattice) -> Array:
    """(N,) smoothing of derivatives [px] by the local width of the squares."""
    return np.clip(np.round(_SIGMA * lattice.predicted[2].width / 0.25) * 0.25, 0.75, 2.0)


def refined(level: Level, lattice: Lattice, sigma: Array | float, most: float) -> Lattice:
    """Move vertices to saddle points within `most` px; derivatives are smoothed by `sigma` [px]."""
    row, col = np.nonzero(lattice.seen)
    sigma = np.broadcast_to(sigma, row.shape)
    pixels = lattice.pixels.copy()
    for value in np.unique(sigma):
        some = sigma == value
        start = pixels[row[some], col[some]]
        moved = refine_saddles(level.image, start, float(value))
        with np.errstate(invalid="ignore"):
            close = np.hypot(*(moved - start).T) < most
        pixels[row[some], col[some]] = np.where(close[:, None], moved, start)
    return replace(lattice, pixels=pixels)


def stretch(level: Level, saddles: Array) -> tuple[Level, Array] | None:
    """Stretch the surroundings of saddles (N, 2) [px] across the direction of most edges.

    Also returns the affine map (2, 3) from pixels of the stretched part to those of the level. None if the
    saddles cover too much of the image, or the edges have no main direction.
    """
    height, width = level.image.shape
    away = np.hypot(*(saddles - np.median(saddles, axis=0)).T)
    saddles = saddles[away <= _STRAY * np.median(away)]
    low = np.maximum(np.floor(saddles.min(axis=0)) - _MARGIN, 0).astype(int)
    high = np.minimum(np.ceil(saddles.max(axis=0)) + _MARGIN, [width, height]).astype(int)
    if np.prod(high - low) > _MOST_COVERED * level.image.size:
        return None
    crop = level.smooth[low[1] : high[1], low[0] : high[0]]
    gradient = np.stack([cv2.Sobel(crop, cv2.CV_32F, *order).ravel() for order in ((1, 0), (0, 1))])
    strength, direction = np.linalg.eigh(gradient.astype(float) @ gradient.T)
    if strength[1] < _ANISOTROPY**2 * strength[0]:
        return None
    along, across = direction.T
    across = across * np.sign(across[0] * along[1] - across[1] * along[0])  # not mirrored
    turn = np.stack([_FACTOR * across, along])
    corners = np.array([[u, v] for u in (low[0], high[0]) for v in (low[1], high[1])]) @ turn.T
    shift = -corners.min(axis=0)
    size = np.ceil(np.ptp(corners, axis=0)).astype(int).tolist()
    forth = np.concatenate([turn, shift[:, None]], axis=1)
    part = cv2.warpAffine(level.image, forth, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    back = np.asarray(cv2.invertAffineTransform(forth), dtype=float)
    return Level(np.asarray(part, dtype=np.float32), 1), back

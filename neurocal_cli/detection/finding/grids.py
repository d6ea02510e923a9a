"""Find all chessboards of an image, of any size: `find_grids` runs the steps of this package.

On a reduced image, saddle points of the brightness are linked along edges, and blocks of 3 x 3 linked
vertices grow into grids. Finer levels of the pyramid complete the grids and refine their vertices. If linked
saddles are left over, `straighten` searches again in a view without the distortion of a wide lens.

Lattices between other marks are left out: between staggered circles, the brightness has saddle points like
those at the vertices of squares, and they form a grid (`appearance`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.appearance import are_squares
from neurocal_cli.detection.finding.grow import grow, has_block, is_smooth, remove_outliers
from neurocal_cli.detection.finding.lattice import LEAST_SIGMA, Lattice
from neurocal_cli.detection.finding.links import Links, find_links, find_seeds, linked_lattice
from neurocal_cli.detection.finding.overlaps import (
    drop_duplicates,
    merge_lattices,
    split_at_folds,
    trim_overlaps,
)
from neurocal_cli.detection.finding.saddles import Level, dense_parts, grey_levels, pyramid
from neurocal_cli.detection.finding.straighten import any_left, find_bent, local_sigma, refined, stretch
from neurocal_cli.detection.grid import Grid, squares_of

Size = tuple[int, int]

# Grids are searched on levels of up to this number of pixels. Larger levels only refine them, unless nothing
# has been found yet: then they are searched where they may show small squares. Chosen for speed:
# test_detection_speed.py.
_SEARCHED = 1.4e6
# Larger levels are never searched, to save memory and time.
_MOST_SEARCHED = 30_000_000
# Insensitive. Number of seeds of a level that may fail; limits the time if there is no board
# (test_detection_speed.py, "clutter only").
_TRIES = 8
_BEHIND = 3.0  # ratio of the squares' sizes above which a second board is not searched


def find_grids(image: NDArray[np.generic], sizes: Collection[Size] = ()) -> list[Grid]:
    """Find every chessboard in a grey image (height, width) of 8 or 16 bits, or of real numbers of any range.

    `sizes` are the columns and rows, in either order, of the only board wanted. Once it is found whole,
    boards far behind it, with squares less than a third as large, are not searched.

    Returns the largest grid in the image first. Vertices are accurate to a few tenths of a pixel. Planes that
    meet at a fold are separate grids. A grid has at least 3 x 3 vertices, because smaller ones occur in
    clutter and no third vertex tests their lines.
    """
    wanted = frozenset((*sizes, *((rows, cols) for cols, rows in sizes)))
    levels = pyramid(grey_levels(image))
    lattices = [x for x in _find(levels, wanted) if are_squares(levels[0].image, x.pixels, x.dark)]
    return [Grid(x.pixels, x.dark) for x in sorted(lattices, key=lambda x: -_area(x.pixels))]


def _area(pixels: Array) -> float:
    """Area of all complete squares [px^2]."""
    p, q = pixels[1:, 1:] - pixels[:-1, :-1], pixels[1:, :-1] - pixels[:-1, 1:]
    return float(np.nansum(np.abs(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])) / 2)


def _find(levels: list[Level], wanted: frozenset[Size], straight: bool = False) -> list[Lattice]:
    """Lattices on the finest level of a pyramid; `straight` if the view has no lens distortion."""
    lattices: list[Lattice] = []
    bent: list[Lattice] = []
    links: Links | None = None
    small = [level for level in levels if level.image.size <= _SEARCHED] or levels[-1:]
    coarser = {level.scale: coarse for level, coarse in pairwise(levels)}
    for level in reversed(levels):
        # On the next finer level, pixels have twice the coordinates.
        lattices, bent = ([replace(x, pixels=2 * x.pixels) for x in part] for part in (lattices, bent))
        lattices = [refined(level, x, x.derivative_sigma, 2) for x in lattices]
        bent = [refined(level, x, local_sigma(x), 2) for x in bent]
        if level not in small and not lattices and not bent and level.image.size <= _MOST_SEARCHED:
            lattices = _split_planes(level, _find_small(level, coarser[level.scale], wanted))
        elif level in small:
            if level is small[0]:
                lattices = [y for x in lattices for y in _grown(level, x)]
            links = find_links(level, _mask(level, lattices) if lattices else None)
            masked = sum(int(x.seen.sum()) for x in lattices)
            if links is not None:
                lattices += _find_new(level, links, lattices, wanted)
            if level is small[0]:
                lattices = _split_planes(level, lattices)
                if not (straight or _nearest_whole(lattices, wanted)):
                    lattices, bent = _find_bent(level, links, masked, lattices, wanted)
    if links is not None and not lattices and not bent and levels[0] in small:
        lattices = _split_planes(levels[0], _find_slivers(levels[0], links))
    return lattices + bent


def _find_bent(
    level: Level, links: Links | None, masked: int, known: list[Lattice], wanted: frozenset[Size]
) -> tuple[list[Lattice], list[Lattice]]:
    """Known lattices that are no pieces of bent ones, and the bent ones.

    The links exclude saddles in lattices that had `masked` vertices in all.
    """
    lost = masked > sum(int(x.seen.sum()) for x in known)
    if not (lost or (links is not None and any_left(links, known))):
        return known, []
    if masked:
        links = find_links(level)
    if links is None:
        return known, []

    def search(view: NDArray[np.float32]) -> list[Lattice]:
        return _find(pyramid(view), wanted, straight=True)

    found = find_bent(level, links, known, search)
    left = drop_duplicates(found + known) if found else known
    return [x for x in left if x not in found], [x for x in left if x in found]


def _split_planes(level: Level, lattices: list[Lattice]) -> list[Lattice]:
    """Drop duplicates, split lattices at folds, and join the parts of occluded ones."""
    result = []
    several = drop_duplicates(lattices)
    if len(several) > 1:
        several = [part for x in trim_overlaps(several) for part in _boards(remove_outliers(level, x))]
    for lattice in several:
        planes = [part for part in split_at_folds(lattice) if has_block(part)]
        if len(planes) > 1 or (planes and planes[0].seen.sum() < lattice.seen.sum()):
            # A vertex removed near the fold may belong to one of the planes.
            planes = [remove_outliers(level, grow(level, x, outwards=False)) for x in planes]
        result += [x for x in planes if has_block(x) and is_smooth(level, x)]
    # Gaps are searched for missing vertices, including those behind a missing neighbour.
    filled = (
        x if x.seen.all() else remove_outliers(level, grow(level, x, outwards=False, reach=2))
        for x in merge_lattices(drop_duplicates(result))
    )
    return [x for x in filled if has_block(x)]


def _find_small(level: Level, coarse: Level, wanted: frozenset[Size]) -> list[Lattice]:
    """Find grids whose squares are too small for the next coarser level, where it has many saddle points."""
    found = []
    for rows, columns in dense_parts(coarse):
        part = Level(np.ascontiguousarray(level.image[rows, columns]), level.scale, level)
        links = find_links(part)
        new = [] if links is None else _find_new(part, links, [], wanted)
        found += [replace(x, pixels=x.pixels + np.array([columns.start, rows.start])) for x in new]
    return found


def _find_new(level: Level, links: Links, known: list[Lattice], wanted: frozenset[Size]) -> list[Lattice]:
    """Grow further grids in a level from seeds, until some of these have failed."""
    seeds, tries = find_seeds(links), _TRIES
    found: list[Lattice] = []
    saddles = links.saddles
    free = np.ones(len(saddles), dtype=bool)
    nearest = _nearest_whole(known, wanted)
    sides = _sides(saddles.points[seeds]) if wanted and len(seeds) else np.full(len(seeds), np.inf)
    for seed, side in zip(seeds, sides.tolist(), strict=True):
        if side * _BEHIND < nearest or not free[seed].all():
            continue
        free[seed] = False
        first = linked_lattice(links, int(seed[1, 1]))
        grown = _grown(level, refined(level, first, first.derivative_sigma, 1))
        boards = [x for x in grown if is_smooth(level, x)]
        if boards:
            found += boards
            nearest = max(nearest, _nearest_whole(boards, wanted))
            free &= _mask(level, boards)[tuple(np.rint(saddles.points.T[::-1]).astype(int))] == 0
        else:
            tries -= 1
        if tries <= 0:
            break
    return found


def _find_slivers(level: Level, links: Links) -> list[Lattice]:
    """Find grids whose squares are too narrow to measure the directions of their edges."""
    part, back = stretch(level, links.saddles.points) or (level, np.eye(2, 3))
    links_of_part = None if part is level else find_links(part)
    if links_of_part is None:
        return []
    found = []
    for lattice in _find_new(part, links_of_part, [], frozenset()):
        pixels = lattice.pixels @ back[:, :2].T + back[:, 2]
        found += _grown(level, refined(level, replace(lattice, pixels=pixels), LEAST_SIGMA, 1))
    return found


def _grown(level: Level, lattice: Lattice) -> list[Lattice]:
    """What a lattice grows into; each part grows again if it falls apart, as one over two boards does."""
    parts = _boards(remove_outliers(level, grow(level, lattice)))
    if len(parts) < 2:
        return parts
    return [y for x in parts for y in _boards(remove_outliers(level, grow(level, x)))]


def _boards(lattice: Lattice) -> list[Lattice]:
    """Connected parts of a lattice with a block of 3 x 3 vertices."""
    return [part for part in lattice.connected_parts() if has_block(part)]


def _nearest_whole(lattices: Iterable[Lattice], wanted: frozenset[Size]) -> float:
    """Largest width of the squares [px] among complete grids of a wanted size; 0 if there is none."""
    widths = (x.width for x in lattices if x.contrast.shape in wanted and x.seen.all())
    return max(widths, default=0.0)


def _sides(points: Array) -> Array:
    """(S,) longest sides of the squares in blocks of points (S, R, C, 2) [px]."""
    along, down = points[:, :, 1:] - points[:, :, :-1], points[:, 1:] - points[:, :-1]
    return np.maximum(*(np.hypot(x[..., 0], x[..., 1]).max(axis=(1, 2)) for x in (along, down)))


def _mask(level: Level, lattices: list[Lattice]) -> NDArray[np.uint8]:
    """Mask of the squares of grids, with a margin around them."""
    mask = np.zeros(level.image.shape, dtype=np.uint8)
    for lattice in lattices:
        quads = squares_of(lattice.pixels)[:, :, [0, 1, 3, 2]].reshape(-1, 4, 2)
        quads = quads[np.isfinite(quads).all(axis=(1, 2))]
        thickness = max(1, round(0.4 * lattice.width))
        whole = np.rint(quads).astype(np.int32)
        cv2.fillPoly(mask, list(whole), 255)
        cv2.polylines(mask, list(whole), True, 255, thickness)
    return mask

"""A shortcut for growth: build most of a grid at once, by following links from vertex to vertex.

The lattice is accepted only if every vertex passes the tests of `grow`. Growing layer by layer gives the same
result more slowly.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.folds import largest_second_difference, split_at_folds
from neurocal_cli.detection.finding.grow import check_lattice
from neurocal_cli.detection.finding.lattice import Index, Lattice, in_whole_square
from neurocal_cli.detection.finding.levels import Level
from neurocal_cli.detection.finding.links import STEPS, Links
from neurocal_cli.detection.finding.saddles import Saddles
from neurocal_cli.detection.finding.subpixel import refine_saddles

# Insensitive: a lattice rejected here is grown instead, which only costs time
# (tests/benchmarks/test_detection_speed.py).
_NEAR = 1.0  # px; greatest shift of a saddle when derivatives are smoothed more
_FEWEST = 12  # vertices; smaller lattices are grown from the seed
_ROUNDS, _WRONG = 3, 0.35  # rounds of removing outliers, and their greatest share
_MOST_CURVED = 0.16  # squares; a larger second difference may be a fold
_WHOLE = 0.5  # least share of linked vertices in an outer line; links beyond the board are wrong


def lattice_from_links(level: Level, links: Links, middle: int, taken: NDArray[np.bool_]) -> Lattice | None:
    """Follow the links that start at a vertex, whose port 0 points along c, and test the resulting lattice.

    `taken` (N,) marks saddles that belong to other grids. None if the vertices fail the tests.
    """
    place, member = _follow(links, middle, taken.tolist())
    if len(place) < _FEWEST:
        return None
    saddles = links.saddles
    lattice = _lattice(saddles, place, member)
    row, col = np.nonzero(lattice.seen)
    refined = refine_saddles(level.image, lattice.pixels[row, col], lattice.derivative_sigma)
    stays = np.abs(refined - lattice.pixels[row, col]).max(axis=1) < _NEAR
    lattice.pixels[row, col] = np.where(stays[:, None], refined, np.nan)
    # Links may cross folds.
    part = _with(split_at_folds(lattice), saddles.points[middle])
    for _ in range(_ROUNDS):
        count = 0 if part is None else np.count_nonzero(part.seen)
        if part is None or count < _FEWEST:
            break
        part, good = check_lattice(level, part)
        wrong = count - np.count_nonzero(good)
        if wrong == 0:
            # A gap may hide a fold.
            return part if largest_second_difference(part) < _MOST_CURVED else None
        if wrong > _WRONG * count:
            break
        # Vertices removed here can be found again when the grid grows.
        part = _with(part.subset(in_whole_square(good)).connected_parts(), saddles.points[middle])
    return None


def linked_group(links: Links, middle: int) -> tuple[Index, Index]:
    """Places (N, 2) and saddles (N,) reached by links from a saddle, as far as they form whole squares."""
    place, member = _follow(links, middle, [False] * len(links.to))
    place -= place.min(axis=0)
    seen = np.zeros(place.max(axis=0) + 1, dtype=bool)
    seen[tuple(place.T)] = True
    kept = in_whole_square(seen)[tuple(place.T)]
    return place[kept], member[kept]


def _with(parts: list[Lattice], point: Array) -> Lattice | None:
    """The lattice with a vertex at a point [px]."""
    near = (part for part in parts if (np.abs(part.pixels - point) < _NEAR).all(axis=-1).any())
    return next(near, None)


def _lattice(saddles: Saddles, place: Index, member: Index) -> Lattice:
    """Make a lattice of saddles by their places (c, r), without incomplete squares and sparse outer lines."""
    left, top = place.min(axis=0)
    cols, rows = place.max(axis=0) - (left, top) + 1
    index = np.full((rows, cols), -1, dtype=np.intp)
    index[place[:, 1] - top, place[:, 0] - left] = member
    seen = in_whole_square(index >= 0)
    for line in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        seen[line] &= seen[line].mean() > _WHOLE
    row, col = np.nonzero(seen)
    pixels, contrast = np.full((rows, cols, 2), np.nan), np.full((rows, cols), np.nan)
    pixels[row, col], contrast[row, col] = (x[index[row, col]] for x in (saddles.points, saddles.contrast))
    # The square between ports 0 and 1 of the middle vertex is dark.
    return Lattice(pixels, contrast, int(left + top) % 2).cropped()


def _follow(links: Links, middle: int, taken: list[bool]) -> tuple[Index, Index]:
    """Places (N, 2) relative to the middle saddle, and saddles (N,) there, by a breadth-first search."""
    to, entry = links.lists
    places, along = {(0, 0): middle}, {middle: 0}  # saddle by place, and its port along c
    waiting = deque(places)
    while waiting:
        c, r = waiting.popleft()
        saddle = places[c, r]
        for turn, (dc, dr) in enumerate(STEPS):
            port = (along[saddle] + turn) % 4
            neighbour, there = to[saddle][port], (c + dc, r + dr)
            if neighbour < 0 or taken[neighbour] or there in places or neighbour in along:
                continue
            places[there] = neighbour
            along[neighbour] = (entry[saddle][port] + 2 - turn) % 4
            waiting.append(there)
    return np.array(list(places)), np.array(list(places.values()))

"""The vertices of a board that are linked with one another: most of a grid, before it begins to grow.

Layer by layer a grid grows as surely, only more slowly: what links have put together counts only where every
vertex looks like one and is where its neighbours put it.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.finding.folds import (
    connected_parts,
    largest_second_difference,
    split_at_folds,
    subset,
)
from neurocal_cli.detection.finding.grow import (
    Lattice,
    check_lattice,
    cropped,
    derivative_sigma,
    in_whole_square,
)
from neurocal_cli.detection.finding.levels import Level
from neurocal_cli.detection.finding.saddles import Saddles
from neurocal_cli.detection.finding.seeds import Links
from neurocal_cli.detection.finding.subpixel import refine_saddles
from neurocal_cli.geometry import Array

__all__ = ["lattice_from_links"]

# (c, r) from a vertex to its neighbour at the port along c, and at the next ones.
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))
_NEAR = 1.0  # px; of a saddle from where it is with more smoothing
_FEWEST = 12  # vertices
_ROUNDS, _WRONG = 3, 0.35  # times that some are left out, and their share
_MOST_BENT = 0.16  # squares, of a row; more is seldom perspective, and may be a fold
_WHOLE = 0.5  # share of an outer line; links lead astray beyond the board, and growing tells the better


def lattice_from_links(
    level: Level, saddles: Saddles, links: Links, middle: int, taken: NDArray[np.bool_]
) -> Lattice | None:
    """Put together what is linked with a vertex.

    Parameters
    ----------
    level : Level
    saddles : Saddles
    links : Links
    middle : int
        The vertex; its port 0 leads along c.
    taken : (N,) bool array
        Saddles that belong to other grids.

    Returns
    -------
    lattice : Lattice or None
        None where what the links lead to is not all as a board's.
    """
    places = _follow(links, middle, taken.tolist())
    if len(places) < _FEWEST:
        return None
    lattice = _lattice(saddles, places)
    row, col = np.nonzero(lattice.seen)
    refined = refine_saddles(level.image, lattice.pixels[row, col], derivative_sigma(lattice.width))
    stays = np.abs(refined - lattice.pixels[row, col]).max(axis=1) < _NEAR
    lattice.pixels[row, col] = np.where(stays[:, None], refined, np.nan)
    # Over a fold vertices are linked as anywhere else; growing stops there.
    part = _with(split_at_folds(lattice), saddles.points[middle])
    for _ in range(_ROUNDS):
        count = 0 if part is None else np.count_nonzero(part.seen)
        if part is None or count < _FEWEST:
            break
        part, good = check_lattice(level, part)
        wrong = count - np.count_nonzero(good)
        if wrong == 0:
            # Holes may hide a fold.
            return part if largest_second_difference(part) < _MOST_BENT else None
        if wrong > _WRONG * count:
            break
        # What is left out has another chance when the grid grows.
        part = _with(connected_parts(subset(part, in_whole_square(good))), saddles.points[middle])
    return None


def _with(parts: list[Lattice], point: Array) -> Lattice | None:
    """The lattice that a point [px] is a vertex of."""
    near = (part for part in parts if (np.abs(part.pixels - point) < _NEAR).all(axis=-1).any())
    return next(near, None)


def _lattice(saddles: Saddles, places: dict[tuple[int, int], int]) -> Lattice:
    """Saddles at their places (c, r), without those that close no square, and without ragged outer lines."""
    place, index = np.array(list(places)), np.array(list(places.values()))
    left, top = place.min(axis=0)
    cols, rows = place.max(axis=0) - (left, top) + 1
    member = np.full((rows, cols), -1, dtype=np.intp)
    member[place[:, 1] - top, place[:, 0] - left] = index
    seen = in_whole_square(member >= 0)
    for line in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        seen[line] &= seen[line].mean() > _WHOLE
    row, col = np.nonzero(seen)
    pixels, contrast = np.full((rows, cols, 2), np.nan), np.full((rows, cols), np.nan)
    pixels[row, col], contrast[row, col] = (x[member[row, col]] for x in (saddles.points, saddles.contrast))
    # The square that begins at the middle one, between its ports 0 and 1, is dark.
    return cropped(Lattice(pixels, contrast, int(left + top) % 2))


def _follow(links: Links, middle: int, taken: list[bool]) -> dict[tuple[int, int], int]:
    """Saddles by their places (c, r) from the middle one, each at the first place that leads to it."""
    to, entry = links.lists
    places, along = {(0, 0): middle}, {middle: 0}  # the latter: each one's port along c
    waiting = deque(places)
    while waiting:
        c, r = waiting.popleft()
        saddle = places[c, r]
        for turn, (dc, dr) in enumerate(_STEPS):
            port = (along[saddle] + turn) % 4
            neighbour, there = to[saddle][port], (c + dc, r + dr)
            if neighbour < 0 or taken[neighbour] or there in places or neighbour in along:
                continue
            places[there] = neighbour
            along[neighbour] = (entry[saddle][port] + 2 - turn) % 4
            waiting.append(there)
    return places

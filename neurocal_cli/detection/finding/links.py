"""Link neighbouring saddles along the edges of the squares, and find the blocks of squares that they close.

The blocks are the seeds of grids. An edge that leaves a vertex at a port followed by a dark sector enters the
next vertex at a port preceded by a dark sector. So along a line of the board, each edge connects an even with
an odd port.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.lattice import Index, Lattice, in_whole_square
from neurocal_cli.detection.finding.overlaps import split_at_folds
from neurocal_cli.detection.finding.saddles import Level, Saddles, find_saddles, interpolate

# Steps (c, r) from a vertex to its neighbours, at the port along c and at the next ports.
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))

_FEWEST = 9  # saddles, for 3 x 3 vertices
# Insensitive; test_finding.py.
_WIDEST = 0.26  # rad; greatest angle between a port and the direction to the neighbour
_SHARE = 0.45  # the same angle as a share of the vertex's narrower angle
_ASIDE = 2.0  # px; a neighbour may be this far beside the port's line, within the latter angle
_IRREGULAR = 0.12  # squares; greatest variation of a seed's second differences ...
_SECOND = 0.4  # ... or greatest second difference times this weight


@frozen_dataclass(eq=False)
class Links:
    """Saddles and their neighbours along their edges."""

    saddles: Saddles
    to: Index  # (N, 4) the neighbour at each port; -1 if there is none
    port: Index  # (N, 4) the neighbour's port at the other end of the edge


def find_links(level: Level, covered: NDArray[np.uint8] | None = None) -> Links | None:
    """Find saddles, and link pairs that are each other's nearest suitable neighbour at their ports.

    Pixels where `covered` is not 0 are not searched. None if there are fewer saddles than vertices of the
    smallest board.
    """
    saddles = find_saddles(level, covered)
    count = len(saddles)
    if count < _FEWEST:
        return None
    reachable = _lead_to(saddles, 0) & _lead_to(saddles, 1).T
    np.fill_diagonal(reachable, False)
    # Each edge is known from its even end. Ports of all saddles are numbered in turn.
    first, second = np.nonzero(reachable)
    step = saddles.points[second] - saddles.points[first]
    even, odd = (
        4 * saddle + line + 2 * ((_direction(saddles.ports[saddle, line]) * away).sum(axis=1) < 0)
        for saddle, line, away in ((first, 0, step), (second, 1, -step))
    )
    length, shortest = np.hypot(*step.T), np.full(4 * count, np.inf)
    for end in (even, odd):
        np.minimum.at(shortest, end, length)
    linked = np.flatnonzero((length == shortest[even]) & (length == shortest[odd]))
    linked = linked[_edges_visible(level, saddles, first[linked], second[linked])]
    entered = np.full(4 * count, -4, dtype=np.intp)
    entered[even[linked]], entered[odd[linked]] = odd[linked], even[linked]
    to = entered.reshape(-1, 4) // 4
    return Links(saddles, to, np.where(to < 0, -1, entered.reshape(-1, 4) % 4))


def _lead_to(saddles: Saddles, line: int) -> NDArray[np.bool_]:
    """(N, N) whether the ports `line` and `line` + 2 of each saddle point along a line to each other one."""
    opening = saddles.ports[:, 1] - saddles.ports[:, 0]
    widest = _SHARE * np.minimum(opening, np.pi - opening)
    usual, most = (np.tan(x).astype(np.float32)[:, None] for x in (np.minimum(_WIDEST, widest), widest))
    place = (saddles.points - saddles.points.mean(axis=0)).astype(np.float32)
    along, across = (
        np.abs(n @ place.T - (n * place).sum(axis=1)[:, None])
        for n in (_direction(saddles.ports[:, line] + turn).astype(np.float32) for turn in (0, np.pi / 2))
    )
    # Directions are only accurate to a pixel or two at the end of a short edge.
    return np.asarray(across < np.maximum(usual * along, np.minimum(most * along, np.float32(_ASIDE))))


def _direction(angle: Array) -> Array:
    """Unit vectors (N, 2) of angles (N,)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _edges_visible(level: Level, saddles: Saddles, first: Index, second: Index) -> NDArray[np.bool_]:
    """(E,) mask of edges, from even ports, with dark and light on the right sides along their length."""
    start, step = saddles.points[first], saddles.points[second] - saddles.points[first]
    length = np.hypot(*step.T)
    # Of a drawn image, two saddle points may have one place.
    normal = np.stack([-step[:, 1], step[:, 0]], axis=-1) / np.maximum(length, 1e-9)[:, None]
    reach = np.clip(0.2 * length, 1.0, 2.5)
    share = np.array([0.3, 0.5, 0.7])
    middle = start[:, None] + share[:, None] * step[:, None]
    offset = (reach[:, None] * normal)[:, None]
    # The normal is the step turned from u towards v, so at an even port it points to the dark side.
    light, dark = (interpolate(level.smooth, middle + side * offset) for side in (-1, 1))
    contrast = np.minimum(saddles.contrast[first], saddles.contrast[second])
    return np.asarray((light - dark).min(axis=1) > 0.15 * contrast)


def find_seeds(links: Links) -> Index:
    """Find blocks of four closed squares around a vertex, the most regular first.

    Returns saddles (S, 3, 3); ``[.., r, c]`` with c along port 0 of the middle saddle and r along port 1.
    """
    centre = whole_blocks(links)
    block = np.empty((len(centre), 3, 3), dtype=np.intp)
    block[:, 1, 1] = centre
    for p, (c, r) in enumerate(_STEPS):
        block[:, 1 + r, 1 + c] = links.to[centre, p]
        # The vertex between ports p and p + 1: from the neighbour, through the port before the entry.
        corner = links.to[links.to[centre, p], (links.port[centre, p] - 1) % 4]
        block[:, 1 + r + c, 1 + c - r] = corner
    grid = links.saddles.points[block]
    irregularity = _irregularity(grid)
    order = np.argsort(irregularity, kind="stable")
    return block[order[irregularity[order] < _IRREGULAR]]


def _irregularity(grid: Array) -> Array:
    """(S,) deviation of (S, 3, 3, 2) blocks from a smooth map [squares].

    Perspective and distortion change the size of squares steadily, and alike in neighbouring rows.
    """
    if not len(grid):
        return np.zeros(0)
    c = 0.5 * (grid[:, 1, 2] - grid[:, 1, 0])
    r = 0.5 * (grid[:, 2, 1] - grid[:, 0, 1])
    area = c[:, 0] * r[:, 1] - c[:, 1] * r[:, 0]
    area = np.where(area > 1e-6, area, 1e-6)[:, None]
    along_c = grid[:, :, 0] + grid[:, :, 2] - 2 * grid[:, :, 1]
    along_r = grid[:, 0] + grid[:, 2] - 2 * grid[:, 1]
    worst = np.zeros(len(grid))
    for second in (along_c, along_r):
        for part, weight in ((second, _SECOND), (np.diff(second, axis=1), 1.0)):
            along = (part[..., 0] * r[:, None, 1] - part[..., 1] * r[:, None, 0]) / area
            across = (c[:, None, 0] * part[..., 1] - c[:, None, 1] * part[..., 0]) / area
            worst = np.maximum(worst, weight * np.maximum(np.abs(along), np.abs(across)).max(axis=1))
    return worst


def whole_blocks(links: Links) -> Index:
    """Saddles (S,) with four closed squares around them."""
    return np.flatnonzero(_closed(links).all(axis=1))


def _closed(links: Links) -> NDArray[np.bool_]:
    """(N, 4) whether four links, starting at port p, lead around a square and back to port p + 1."""
    count = len(links.to)
    at = np.repeat(np.arange(count)[:, None], 4, axis=1)
    port = np.repeat(np.arange(4)[None], count, axis=0)
    alive = np.ones((count, 4), dtype=bool)
    for _ in range(4):
        alive &= links.to[at, port] >= 0
        at, port = links.to[at, port], (links.port[at, port] - 1) % 4
    home = np.arange(count)[:, None]
    return alive & (at == home) & (port == np.arange(4)[None])


def linked_group(links: Links, middle: int) -> tuple[Index, Index]:
    """Places (N, 2) and saddles (N,) reached by links from a saddle, as far as they form whole squares.

    The search is breadth-first.
    """
    to, entry = links.to.tolist(), links.port.tolist()
    places, along = {(0, 0): middle}, {middle: 0}  # saddle by place, and its port along c
    waiting = deque(places)
    while waiting:
        c, r = waiting.popleft()
        saddle = places[c, r]
        for turn, (dc, dr) in enumerate(_STEPS):
            port = (along[saddle] + turn) % 4
            neighbour, there = to[saddle][port], (c + dc, r + dr)
            if neighbour < 0 or there in places or neighbour in along:
                continue
            places[there] = neighbour
            along[neighbour] = (entry[saddle][port] + 2 - turn) % 4
            waiting.append(there)
    place, member = np.array(list(places)), np.array(list(places.values()))
    place -= place.min(axis=0)
    seen = np.zeros(place.max(axis=0) + 1, dtype=bool)
    seen[tuple(place.T)] = True
    kept = in_whole_square(seen)[tuple(place.T)]
    return place[kept], member[kept]


def linked_lattice(links: Links, middle: int) -> Lattice:
    """The part without folds of the saddles reached by links from one with four closed squares around it."""
    place, member = linked_group(links, middle)
    c, r = place.T
    shape = r.max() + 1, c.max() + 1
    pixels, contrast = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
    pixels[r, c], contrast[r, c] = links.saddles.points[member], links.saddles.contrast[member]
    # The square between ports 0 and 1 of the middle vertex is dark.
    whole = Lattice(pixels, contrast, int(place[member == middle].sum()) % 2)
    own = links.saddles.points[middle]
    parts = (part for part in split_at_folds(whole) if (part.pixels == own).all(axis=2).any())
    return next(parts, whole)

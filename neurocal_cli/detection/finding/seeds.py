"""Find seeds of grids: blocks of 3 x 3 linked vertices, or of 2 x 3 if there are none.

In: linked saddles. Out: blocks of saddles, the most regular ones first, for `grids` to grow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.finding.lattice import Index
from neurocal_cli.detection.finding.links import Links
from neurocal_cli.geometry import Array

# Insensitive; tests/test_finding.py.
_IRREGULAR = 0.12  # squares; greatest variation of a seed's second differences ...
_SECOND = 0.4  # ... or greatest second difference times this weight


def find_seeds_3x3(links: Links) -> Index:
    """Find blocks of four closed squares around a vertex, the most regular first.

    Returns
    -------
    members : (S, 3, 3) int array
        Saddles of each block; ``[.., r, c]`` with c along port 0 of the middle saddle and r along port 1.
    """
    centre = whole_blocks(links)
    block = np.empty((len(centre), 3, 3), dtype=np.intp)
    block[:, 1, 1] = centre
    for p, (c, r) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        block[:, 1 + r, 1 + c] = links.to[centre, p]
        # The vertex between ports p and p + 1: from the neighbour, through the port before the entry.
        corner = links.to[links.to[centre, p], (links.port[centre, p] - 1) % 4]
        c2, r2 = ((1, 1), (-1, 1), (-1, -1), (1, -1))[p]
        block[:, 1 + r2, 1 + c2] = corner
    grid = links.saddles.points[block]
    irregularity = _irregularity(grid)
    order = np.argsort(irregularity, kind="stable")
    return block[order[irregularity[order] < _IRREGULAR]]


def whole_blocks(links: Links) -> Index:
    """Saddles (S,) with four closed squares around them."""
    return np.flatnonzero(_closed(links).all(axis=1))


def find_seeds_2x3(links: Links) -> tuple[Index, Index]:
    """Find blocks of two closed squares side by side.

    Returns
    -------
    members : (S, 2, 3) int array
        Saddles of each block, the most regular first.
    dark : (S,) int array
        As in `Lattice`.
    """
    closed = _closed(links)
    middle, p = np.nonzero(closed & np.roll(closed, -1, axis=1))
    right, down, left = (links.to[middle, (p + k) % 4] for k in range(3))
    # The outer vertices of the first and the second square.
    corner = links.to[right, (links.port[middle, p] - 1) % 4]
    other = links.to[down, (links.port[middle, (p + 1) % 4] - 1) % 4]
    block = np.stack([np.stack([left, middle, right], -1), np.stack([other, down, corner], -1)], axis=1)
    grid = links.saddles.points[block]
    c = 0.5 * (grid[:, 0, 2] - grid[:, 0, 0])
    second = np.abs(grid[:, :, 0] + grid[:, :, 2] - 2 * grid[:, :, 1]).max(axis=(1, 2))
    irregularity = second / np.maximum(np.hypot(*c.T), 1e-6)
    order = np.argsort(irregularity, kind="stable")
    return block[order], (p[order] + 1) % 2


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

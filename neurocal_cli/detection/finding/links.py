"""Link neighbouring saddles along the edges of the squares.

In: a level. Out: its saddles, and the neighbour of each at its four ports. An edge that leaves a vertex at a
port followed by a dark sector enters the next vertex at a port preceded by a dark sector. So along a line of
the board, each edge connects an even with an odd port.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.finding.lattice import Index
from neurocal_cli.detection.finding.levels import Level, interpolate
from neurocal_cli.detection.finding.saddles import Saddles, find_saddles
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

_FEWEST = 9  # saddles, for 3 x 3 vertices
# Insensitive; tests/test_finding.py.
_WIDEST = 0.26  # rad; greatest angle between a port and the direction to the neighbour
_SHARE = 0.45  # the same angle as a share of the vertex's narrower angle
_ASIDE = 2.0  # px; a neighbour may be this far beside the port's line, within the latter angle
_SIMILAR = 0.33  # least ratio of the contrasts of neighbours


@frozen_dataclass(eq=False)
class Links:
    """Saddles and their neighbours along their edges.

    Attributes
    ----------
    saddles : Saddles
    to : (N, 4) int array
        The neighbour at each port; -1 if there is none.
    port : (N, 4) int array
        The neighbour's port at the other end of the edge.
    """

    saddles: Saddles
    to: Index
    port: Index

    @cached_property
    def lists(self) -> tuple[list[list[int]], list[list[int]]]:
        """Both arrays as lists, which are faster to index one by one."""
        return self.to.tolist(), self.port.tolist()


def find_links(level: Level, covered: NDArray[np.uint8] | None = None) -> Links | None:
    """Find saddles, and link pairs that are each other's nearest suitable neighbour at their ports.

    Parameters
    ----------
    level : Level
    covered : (height, width) uint8 array, optional
        Non-zero pixels are not searched.

    Returns
    -------
    links : Links or None
        None if there are fewer saddles than vertices of the smallest board.
    """
    saddles = find_saddles(level, covered)
    count = len(saddles)
    if count < _FEWEST:
        return None
    place = saddles.points.astype(np.float32)
    du, dv = (place[None, :, k] - place[:, None, k] for k in (0, 1))
    distance = du * du + dv * dv
    np.fill_diagonal(distance, np.inf)
    port = _port_towards(du, dv, saddles.ports)
    contrast = saddles.contrast.astype(np.float32)
    fit = (port >= 0) & (port.T >= 0) & ((port ^ port.T) & 1 == 1)
    fit &= contrast[:, None] > _SIMILAR * contrast[None, :]
    fit &= contrast[None, :] > _SIMILAR * contrast[:, None]
    to = np.full((count, 4), -1, dtype=np.intp)
    entry = np.full((count, 4), -1, dtype=np.intp)
    rows = np.arange(count)
    for p in range(4):
        length = np.where(fit & (port == p), distance, np.inf)
        best = length.argmin(axis=1)
        found = np.isfinite(length[rows, best])
        to[found, p] = best[found]
        entry[found, p] = port[best, rows][found]
    mutual = (to >= 0) & (to[to, entry] == rows[:, None])
    to[~mutual], entry[~mutual] = -1, -1
    unseen = ~_edges_visible(level, saddles, to, entry)
    to[unseen], entry[unseen] = -1, -1
    return Links(saddles, to, entry)


def _port_towards(du: NDArray[np.float32], dv: NDArray[np.float32], ports: Array) -> NDArray[np.int8]:
    """(N, N) port of each saddle (row) that points to each other saddle (column), or -1."""
    port = np.full(du.shape, -1, dtype=np.int8)
    opening = ports[:, 1] - ports[:, 0]
    widest = _SHARE * np.minimum(opening, np.pi - opening)
    usual, most = (np.tan(x).astype(np.float32)[:, None] for x in (np.minimum(_WIDEST, widest), widest))
    for line in range(2):
        c, s = (f(ports[:, line]).astype(np.float32)[:, None] for f in (np.cos, np.sin))
        along, across = c * du + s * dv, np.abs(c * dv - s * du)
        reach = np.abs(along)
        # Directions are only accurate to a pixel or two at the end of a short edge.
        close = across < np.maximum(usual * reach, np.minimum(most * reach, _ASIDE))
        port[close & (along > 0)] = line
        port[close & (along < 0)] = line + 2
    return port


def _edges_visible(level: Level, saddles: Saddles, to: Index, entry: Index) -> NDArray[np.bool_]:
    """(N, 4) mask of links with dark and light on the right sides along their length."""
    seen = np.zeros(to.shape, dtype=bool)
    first, p = np.nonzero(to >= 0)
    if not len(first):
        return seen
    start, end = saddles.points[first], saddles.points[to[first, p]]
    step = end - start
    length = np.hypot(*step.T)
    normal = np.stack([-step[:, 1], step[:, 0]], axis=-1) / length[:, None]
    reach = np.clip(0.2 * length, 1.0, 2.5)
    share = np.array([0.3, 0.5, 0.7])
    middle = start[:, None] + share[:, None] * step[:, None]
    offset = (reach[:, None] * normal)[:, None]
    # The normal is the step turned from u towards v, so at an even port it points to the dark side.
    sides = interpolate(level.smooth, np.stack([middle - offset, middle + offset], axis=1))
    rise = (sides[:, 0] - sides[:, 1]) * np.where(p % 2 == 0, 1, -1)[:, None]
    contrast = np.minimum(saddles.contrast[first], saddles.contrast[to[first, p]])
    seen[first, p] = rise.min(axis=1) > 0.15 * contrast
    back = np.zeros_like(seen)
    back[first, p] = seen[to[first, p], entry[first, p]]
    return seen & back

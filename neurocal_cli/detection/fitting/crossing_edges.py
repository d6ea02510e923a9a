"""Measure where the outermost mid-points lie along their edges.

An edge measures its mid-point across itself only. But at the ends of the outermost edges, the last pieces of
two grid lines begin, which lead to the rim of the board. They are fitted as well, and have no mid-points of
their own: what they measure is the position along the outermost edges.

         |       |        the edges to the rim, measured across themselves
    -----+---x---+-----   x: a mid-point in the outermost row
         |       |

Such an edge departs from a map of the lens, which all edges of the board determine, by its own error alone.
This departure is added to the map at a mid-point beside it. So each edge to the rim serves one mid-point, and
the errors of all mid-points stay independent of each other.

The map must be accurate up to the rim. So it contains the lens, with tangential distortion and k3, and no
polynomial, which would extrapolate badly. If the edges do not agree with it within their noise, as on paper
boards, the mid-points stay as they are. So do those whose edges to the rim alone do not agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.edge_fit import OFFSET
from neurocal_cli.detection.fitting.grid_fit import GridEdges, GridFit, GridImage, fit_rim
from neurocal_cli.detection.fitting.map_fit import select_map
from neurocal_cli.detection.fitting.strips import grid_lines

# Ratio of the variance around the map to that of the fits, up to which the edges agree with the map. It is
# 0.7 to 1.6 in rendered images (tests/test_rendered_sets.py), and 9 to 300 in photographs of paper boards.
_AGREES = 2.0
_OUTLIER = 4.0  # standard deviations beyond which the departure of an edge to the rim is not used


@frozen_dataclass(eq=False)
class AlongEdges:
    """Positions of M mid-points along their edges: ``direction . p = value``."""

    rows: NDArray[np.intp]  # (M,) of the mid-points among the edges of the grid
    direction: Array  # (M, 2) unit normals of the grid lines that cross the edges
    value: Array  # (M,) [px]
    variance: Array  # (M,) [px^2]


def positions_along_edges(grid_image: GridImage, fitted: GridFit) -> AlongEdges | None:
    """Measure where the outermost mid-points lie along their edges; None if the map is not accurate."""
    if fitted.map.excess > _AGREES:
        return None
    rim, fit = fit_rim(grid_image, fitted)
    edges, n = grid_image.edges, len(grid_image.edges.index)
    serves = edges_served(grid_image.grid.shape, edges, rim, fitted.good)
    between, to_rim = (
        of.observations(x.lines, x.fit.values[:, OFFSET], x.offset_variance, x.shifts.terms(x.lines))
        for of, x in ((grid_image, fitted), (rim, fit))
    )
    lens = fitted.map.map.lens_models[fitted.map.map.radial :]
    mapped = select_map(fitted.map.map, between.joined_with(to_rim), fitted.map.shift, models=lens)
    if mapped.excess > _AGREES:
        return None
    variance = fit.fit.covariance[:, OFFSET, OFFSET] * fit.fit.variance_growth + fitted.unevenness
    variance *= max(mapped.excess, 1.0)
    departure = mapped.residual[-len(rim.index) :] * rim.light
    used = fit.good & (serves >= 0) & (departure**2 < _OUTLIER**2 * variance)
    if not used.any():
        return None
    weight, departure = 1 / variance[used], departure[used]
    total = np.bincount(serves[used], weight, n)
    mean = np.bincount(serves[used], weight * departure, n)
    rows = np.flatnonzero(total)
    crossing = grid_lines(mapped.map, edges.centre[rows], ~edges.vertical[rows], np.ones(len(rows)))
    direction = crossing.normal / np.hypot(*crossing.normal.T)[:, None]
    value = (crossing.middle * direction).sum(axis=1) + mean[rows] / total[rows]
    return AlongEdges(rows, direction, value, 1 / total[rows])


def edges_served(
    shape: tuple[int, int], edges: GridEdges, rim: GridEdges, good: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Find the edge whose mid-point each edge to the rim serves, among the `good` ones; -1 for none.

    Two edges between vertices cross the edge to the rim at its known vertex. The one towards the middle of
    the board, of (cols, rows) vertices, is preferred.
    """
    cols, rows = shape
    row_of = np.full((2, cols + 2, rows + 2), -1, dtype=np.intp)  # one longer on each side
    c, r = edges.index[good].T + 1
    row_of[edges.vertical[good].astype(int), c, r] = np.flatnonzero(good)
    along = np.where(rim.vertical[:, None], [0, 1], [1, 0])
    vertex = rim.index + along * rim.known[:, 1:]
    across = 1 - along
    before_middle = (vertex * across).sum(axis=1) < 0.5 * ((np.array(shape) - 1) * across).sum(axis=1)
    kind = 1 - rim.vertical.astype(int)
    begin, end = ((vertex + 1 - step * across).T for step in (0, 1))
    ahead, behind = row_of[kind, begin[0], begin[1]], row_of[kind, end[0], end[1]]
    first, second = np.where(before_middle, (ahead, behind), (behind, ahead))
    return np.where(first >= 0, first, second)

"""Results of finding and measuring: the vertices of a chessboard, and the mid-points of its edges.

Grid coordinates are whole numbers (c, r), c along a row of vertices and r along a column. Their handedness is
that of the image: the turn from growing c to growing r has the sense of that from u to v. The origin and the
direction of c are arbitrary here; `identity` finds those of the board.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.medians import median

# Kinds of points: the mid-point of the edge from (c, r) to (c + 1, r), from (c, r) to (c, r + 1),
# and the vertex (c, r) itself.
EDGE_H, EDGE_V, VERTEX = 0, 1, 2
# Rotations of grid coordinates by multiples of 90 degrees.
TURNS = (((1, 0), (0, 1)), ((0, -1), (1, 0)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0)))


@frozen_dataclass(eq=False)
class Grid:
    """Vertices found on one chessboard."""

    # (rows, cols, 2) [px] of vertex (c, r) at [r, c]; NaN where it was not found. The first and last row and
    # column each hold at least one vertex.
    pixels: Array
    dark: int  # 0 or 1: the square between (c, r) and (c + 1, r + 1) is dark where c + r + dark is even
    # Places of the lines -1 to cols and -1 to rows [any unit], if they are not at equal distances
    lines: tuple[Array, Array] | None = None
    # Whether only edges from line 2 k to 2 k + 1 are there, as on tags without squares at their corners.
    paired: bool = False

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(rows, cols) mask of the vertices that were found."""
        return np.isfinite(self.pixels[..., 0])

    @property
    def shape(self) -> tuple[int, int]:
        """(cols, rows), the order in which boards are named."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @property
    def square(self) -> float:
        """Typical side of a square [px]: the shorter one of its medians along rows and along columns."""
        p = self.pixels
        return min(
            median(np.hypot(step[..., 0], step[..., 1])) for step in (p[1:] - p[:-1], p[:, 1:] - p[:, :-1])
        )


def weights_within(places: Array) -> Array:
    """Weights (K, 4) of the vertices (0, 0), (1, 0), (0, 1) and (1, 1) for places (K, 2) in their square."""
    x, y = places.T
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)


def squares_of(pixels: Array) -> Array:
    """(rows - 1, cols - 1, 4, 2) the vertices of the squares of a grid (rows, cols, 2), ordered as above."""
    p = pixels
    return np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]], axis=2)


_OF_POINTS = ("kind", "index", "pixels", "covariance", "across")  # of `Measured`, a row per point


@frozen_dataclass(eq=False)
class Measured:
    """N points of one grid, measured in the image."""

    kind: NDArray[np.int64]  # (N,) `EDGE_H`, `EDGE_V` or `VERTEX`
    index: NDArray[np.int64]  # (N, 2) (c, r), in the grid's coordinates
    pixels: Array  # (N, 2) [px]
    covariance: Array  # (N, 3) [px^2] suu, suv, svv
    # (N, 2) unit normals of the edges of mid-points, the direction in which each is measured; 0 for
    # mid-points that are measured in both directions; None for vertices
    across: Array | None
    vertices: Array  # (rows, cols, 2) [px] after refinement; NaN where not found or not fitted
    rejected: int  # number of fits that were rejected
    # [px] displacement of the edges towards the dark side by gamma, ink spread and blooming; already removed
    polarity: float

    @classmethod
    def of_vertices(
        cls, index: NDArray[np.int64], pixels: Array, spread: Array, vertices: Array, polarity: float = 0.0
    ) -> Measured:
        """Points that are measured in both directions, with covariances `spread` (N, 2, 2) [px^2]."""
        kind, covariance = np.full(len(pixels), VERTEX, dtype=np.int64), spread.reshape(-1, 4)[:, [0, 1, 3]]
        return cls(kind, index, pixels, covariance, None, vertices, 0, polarity)

    def only(self, good: NDArray[np.bool_]) -> Measured:
        """Keep the points of a mask (N,); the others are counted as rejected."""
        known = {name: values for name in _OF_POINTS if (values := getattr(self, name)) is not None}
        kept = {name: values[good] for name, values in known.items()}
        return replace(self, **kept, rejected=self.rejected + int((~good).sum()))

    def joined_with(self, other: Measured) -> Measured:
        """Join mid-points from two sets of edges of the same grid."""
        both: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _OF_POINTS
        }
        return replace(self, **both, rejected=self.rejected + other.rejected)

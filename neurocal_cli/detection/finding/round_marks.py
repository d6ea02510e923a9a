"""Tell a lattice between round marks from a chessboard.

Between staggered circles the brightness has saddle points like those at the vertices of squares, and they
form a grid. But a circle reaches equally far in all directions, where a square reaches 1.4 times as far
towards its corners as towards its sides. Overexposed squares are smaller and blurred ones are rounder, but
not so much.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.lattice import Lattice
from neurocal_cli.detection.finding.saddles import Level, interpolate

# With these values test_finding.py tells photographs of circles from boards: the ratio is 0.71 to 0.74 on
# circles, and at least 0.84 on boards.
_ROUND = 0.79  # reach towards the corners over that towards the sides, both as shares of a square's own
_MOST = 60  # squares of a colour that are examined
_FEWEST = 4
_RAYS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]])  # last four: corners
_STEPS = np.linspace(0, 0.5, 21)  # of the square's side
_PLACES = 0.5 + _RAYS[:, None] * _STEPS[:, None]  # (8, 21, 2) in the unit square
_CORNERS = np.stack(
    [
        (1 - _PLACES[..., 0]) * (1 - _PLACES[..., 1]),
        _PLACES[..., 0] * (1 - _PLACES[..., 1]),
        (1 - _PLACES[..., 0]) * _PLACES[..., 1],
        _PLACES[..., 0] * _PLACES[..., 1],
    ],
    axis=-1,
).reshape(-1, 4)


def between_round_marks(level: Level, lattice: Lattice) -> bool:
    """Whether the squares of one colour are round, so that the lattice is no chessboard."""
    p = lattice.pixels
    quads = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]], axis=2)
    row, col = np.nonzero(np.isfinite(quads).all(axis=(2, 3)))
    dark = (row + col + lattice.dark) % 2 == 0
    groups = [_spread(np.flatnonzero(dark == colour)) for colour in (True, False)]
    if min(map(len, groups)) < _FEWEST:
        return False
    values = [interpolate(level.image, _CORNERS @ quads[row[some], col[some]]) for some in groups]
    middles = [float(np.median(value[:, 0])) for value in values]
    return any(
        _relative_reach(value, own, other) < _ROUND
        for value, own, other in zip(values, middles, reversed(middles), strict=True)
    )


def _spread(which: np.ndarray[tuple[int], np.dtype[np.intp]]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """At most `_MOST` of them, evenly spread."""
    return which[:: -(-len(which) // _MOST)] if len(which) else which


def _relative_reach(values: Array, own: float, other: float) -> float:
    """Median ratio of the reaches towards corners and sides, from brightness (N, rays * steps)."""
    if own == other:
        return 1.0
    beyond = (values.reshape(len(values), len(_RAYS), -1) - own) / (other - own) > 0.5
    reach = np.where(beyond.any(axis=-1), _STEPS[beyond.argmax(axis=-1)], _STEPS[-1])
    sides, corners = reach[:, :4].mean(axis=1), reach[:, 4:].mean(axis=1)
    return float(np.median(corners / np.maximum(sides, _STEPS[1])))

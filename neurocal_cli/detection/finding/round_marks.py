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
# circles, and at least 0.93 on boards.
_ROUND = 0.82  # reach towards the corners over that towards the sides, both as shares of a square's own
_APART = 0.8  # least level at the corners, from 0 of the square's own colour to 1 of the other
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
    known = np.isfinite(quads).all(axis=(2, 3))
    row, col = np.nonzero(known)
    centre, beside = np.zeros((2, known.shape[0] + 2, known.shape[1] + 2))
    beside[1:-1, 1:-1] = known
    centre[row + 1, col + 1] = interpolate(level.image, quads[row, col].mean(axis=1))
    # The light changes over the board, so a square is compared with its neighbours.
    total, count = (x[:-2, 1:-1] + x[2:, 1:-1] + x[1:-1, :-2] + x[1:-1, 2:] for x in (centre, beside))
    step = (total / np.maximum(count, 1) - centre[1:-1, 1:-1])[row, col]
    dark = (row + col + lattice.dark) % 2 == 0
    groups = [_spread(np.flatnonzero(dark == colour)) for colour in (True, False)]
    if min(map(len, groups)) < _FEWEST:
        return False
    return any(
        _relative_reach(interpolate(level.image, _CORNERS @ quads[row[some], col[some]]), step[some]) < _ROUND
        for some in groups
    )


def _spread(which: np.ndarray[tuple[int], np.dtype[np.intp]]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """At most `_MOST` of them, evenly spread."""
    return which[:: -(-len(which) // _MOST)] if len(which) else which


def _relative_reach(values: Array, step: Array) -> float:
    """Median ratio of the reaches towards corners and sides.

    `values` (N, rays * steps) [DN] is the brightness; `step` (N,) [DN] leads to that of the other colour.
    """
    away = values.reshape(len(values), len(_RAYS), -1) - values[:, :1, None]
    away /= np.where(step == 0, np.inf, step)[:, None, None]
    if np.median(away[:, 4:, -1]) < _APART:
        return 1.0  # squares touch at their corners
    beyond = away > 0.5
    reach = np.where(beyond.any(axis=-1), _STEPS[beyond.argmax(axis=-1)], _STEPS[-1])
    sides, corners = reach[:, :4].mean(axis=1), reach[:, 4:].mean(axis=1)
    return float(np.median(corners / np.maximum(sides, _STEPS[1])))

"""Join the parts of a board that an occluder divides.

In: the lattices of a level. Out: the same, with lattices joined that continue each other on one grid.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.finding.lattice import Index, Lattice
from neurocal_cli.geometry import Array

# tests/test_finding.py divides a board into two halves with these limits, and expects one grid.
_NEAR = 4.0  # squares; greatest distance of vertices from the other lattice to be compared
_WHOLE, _WHOLE_WORST = 0.12, 0.3  # squares; greatest median and maximum deviation from whole numbers
_LEAST = 4  # least number of vertices compared
_TURNS = ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0))


def merge_lattices(lattices: list[Lattice]) -> list[Lattice]:
    """Join lattices whose extrapolated grid coordinates agree at the vertices of the other."""
    result = sorted(lattices, key=lambda x: -int(x.seen.sum()))
    first = 0
    while first < len(result):
        for second in range(first + 1, len(result)):
            union = _union(result[first], result[second])
            if union is not None:
                result[first] = union
                del result[second]
                break
        else:
            first += 1
    return result


def _union(large: Lattice, small: Lattice) -> Lattice | None:
    motion = _motion(large, small)
    if motion is None or _motion(small, large) is None:
        return None
    turn, shift = motion
    row, col = np.nonzero(small.seen)
    place = np.stack([col, row], axis=-1) @ turn.T + shift
    low = np.minimum(place.min(axis=0), 0)
    high = np.maximum(place.max(axis=0) + 1, large.seen.shape[::-1])
    cols, rows = high - low
    pixels, contrast = np.full((rows, cols, 2), np.nan), np.full((rows, cols), np.nan)
    within = np.s_[-low[1] : -low[1] + large.seen.shape[0], -low[0] : -low[0] + large.seen.shape[1]]
    pixels[within], contrast[within] = large.pixels, large.contrast
    at = place[:, 1] - low[1], place[:, 0] - low[0]
    if np.isfinite(contrast[at]).any():
        return None
    pixels[at], contrast[at] = small.pixels[row, col], small.contrast[row, col]
    return Lattice(pixels, contrast, int(large.dark + low.sum()) % 2)


def _motion(base: Lattice, other: Lattice) -> tuple[Index, Index] | None:
    """Rotation (2, 2) and shift (2,) from the other lattice's (c, r) to the base's; None if they disagree."""
    row, col = np.nonzero(other.seen)
    grid = _continued(base, other)
    rows, cols = base.seen.shape
    beyond = np.maximum(np.maximum(-grid, grid - np.array([cols - 1, rows - 1])), 0).max(axis=1)
    near = np.isfinite(grid).all(axis=1) & (beyond <= _NEAR)
    if near.sum() < _LEAST:
        return None
    own = np.stack([col, row], axis=-1)[near]
    for numbers in _TURNS:
        turn = np.array(numbers, dtype=np.intp).reshape(2, 2)
        away = grid[near] - own @ turn.T
        shift = np.rint(np.median(away, axis=0)).astype(np.intp)
        off = np.abs(away - shift).max(axis=1)
        if np.median(off) < _WHOLE and off.max() < _WHOLE_WORST:
            # The same square must be dark in both.
            square = np.floor(np.array([0.5, 0.5]) @ turn.T + shift).astype(np.intp)
            same = (square.sum() + base.dark) % 2 == other.dark % 2
            return (turn, shift) if same else None
    return None


def _continued(base: Lattice, other: Lattice) -> Array:
    """Grid coordinates (N, 2) of the other lattice's vertices on the base, extrapolated by a homography."""
    row, col = np.nonzero(base.seen)
    p, q = base.pixels[row, col], other.pixels[other.seen]
    away = np.sqrt(((p[:, None] - q[None]) ** 2).sum(axis=-1).min(axis=1))
    # Lens distortion bends the plane, so the vertices near the other lattice have the largest weights.
    weight = np.exp(-(away - away.min()) / (_NEAR * max(base.width, 1e-3)))
    centre, scale = p.mean(axis=0), max(float(p.std()), 1e-6)
    x, y = ((p - centre) / scale).T
    c, r, one, zero = col.astype(float), row.astype(float), np.ones(len(col)), np.zeros(len(col))
    A = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -c * x, -c * y, -c], axis=-1) * weight[:, None],
            np.stack([zero, zero, zero, x, y, one, -r * x, -r * y, -r], axis=-1) * weight[:, None],
        ]
    )
    H = np.linalg.svd(A, full_matrices=False)[2][-1].reshape(3, 3)
    ahead = np.concatenate([(q - centre) / scale, np.ones((len(q), 1))], axis=1) @ H.T
    side = np.sign(np.median(np.stack([x, y, one], axis=-1) @ H[2]))
    depth = ahead[:, 2] * side
    depth = np.where(depth > 1e-9, depth, np.nan)
    return np.asarray(ahead[:, :2] * side / depth[:, None])

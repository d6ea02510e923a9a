"""Let each vertex belong to one lattice, and each board have one lattice.

Copies of a lattice and rows beyond a fold are removed; the parts of a board that an occluder divides are
joined.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.grow import frontier
from neurocal_cli.detection.finding.lattice import Index, Lattice
from neurocal_cli.detection.finding.predict import predict_vertices
from neurocal_cli.detection.grid import TURNS

# Insensitive; FOLDED and "two boards" in tests/test_finding.py repeat this.
_SAME = 0.25  # squares; greatest distance between vertices that are the same
_MEETS = 0.13  # squares; greatest distance of a vertex from another lattice or its next row ...
_MEETS_PARTLY = 0.22  # ... and the same for vertices of incomplete rows
_MOSTLY = 0.6  # share of such vertices above which a row is removed
_COPY = 0.5  # share of vertices in another lattice above which a lattice is its copy
_BESIDE = 2.0  # squares; lattices farther apart share no vertices
# tests/test_finding.py divides a board into two halves with these limits, and expects one grid.
_NEAR = 4.0  # squares; greatest distance of vertices from the other lattice to be compared
_WHOLE, _WHOLE_WORST = 0.12, 0.3  # squares; greatest median and maximum deviation from whole numbers
_LEAST = 4  # least number of vertices compared


def drop_duplicates(lattices: list[Lattice]) -> list[Lattice]:
    """Drop lattices if most of their vertices belong to a larger one."""
    kept: list[Lattice] = []
    for lattice in sorted(lattices, key=lambda x: -int(x.seen.sum())):
        points = lattice.pixels[lattice.seen]
        reach = _SAME * lattice.width
        if not any((distance(points, x.pixels[x.seen]) < reach).mean() > _COPY for x in kept):
            kept.append(lattice)
    return kept


def any_overlap(lattices: list[Lattice]) -> bool:
    """Whether any two lattices are near enough to share vertices."""
    boxes = []
    for lattice in lattices:
        points, room = lattice.pixels[lattice.seen], _BESIDE * _longest(lattice)
        boxes.append((points.min(axis=0) - room, points.max(axis=0) + room))
    return any(
        bool(((low <= other_high) & (other_low <= high)).all())
        for (low, high), (other_low, other_high) in combinations(boxes, 2)
    )


def _longest(lattice: Lattice) -> float:
    """Longest side of a square [px]."""
    p = lattice.pixels
    sides = np.concatenate([np.diff(p, axis=0).reshape(-1, 2), np.diff(p, axis=1).reshape(-1, 2)])
    return float(np.nanmax(np.hypot(*sides.T)))


def trim_overlaps(lattices: list[Lattice]) -> list[Lattice]:
    """Remove outermost rows of a lattice that lie on another lattice or on its next row.

    Such rows occur if a lattice has grown across a fold into the other plane.
    """
    result = list(lattices)
    for _ in range(2):
        places = [_vertices_and_next(x) for x in result]
        for i, lattice in enumerate(result):
            for j, place in enumerate(places):
                if i != j:
                    lattice = _trimmed(lattice, place)
            result[i] = lattice
    return result


def _vertices_and_next(lattice: Lattice) -> tuple[Array, float]:
    """Vertices of a lattice and predicted vertices of its next rows (N, 2), and the width of its squares."""
    wider, _ = lattice.padded()
    row, col, _ = frontier(wider.seen, 1)
    predicted = predict_vertices(wider.pixels, row, col)
    return np.concatenate([lattice.pixels[lattice.seen], predicted.points]), lattice.width


def _trimmed(lattice: Lattice, place: tuple[Array, float]) -> Lattice:
    points, width = place
    seen = lattice.seen
    away = np.full(seen.shape, np.inf)
    away[seen] = distance(lattice.pixels[seen], points) / min(width, lattice.width)
    drop = np.zeros_like(seen)
    for line, inner in _OUTERMOST:
        known = int(seen[line].sum())
        # An incomplete row is more likely to lie beyond the end of its plane.
        meets = _MEETS if known > 0.75 * seen[inner].sum() else _MEETS_PARTLY
        if known and (away[line][seen[line]] < meets).mean() >= _MOSTLY:
            drop[line] = seen[line]
    if not drop.any():
        return lattice
    return lattice.subset(seen & ~drop)


_OUTERMOST = (
    (np.s_[0, :], np.s_[1, :]),
    (np.s_[-1, :], np.s_[-2, :]),
    (np.s_[:, 0], np.s_[:, 1]),
    (np.s_[:, -1], np.s_[:, -2]),
)


def distance(points: Array, others: Array) -> Array:
    """(N,) distance of each point from the nearest of the others [px]."""
    if not len(points) or not len(others):
        return np.full(len(points), np.inf)
    away = points[:, None] - others[None]
    return np.asarray(np.sqrt((away**2).sum(axis=-1).min(axis=1)))


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
    for turn in np.array(TURNS):
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
    away = distance(p, q)
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

"""Remove vertices that belong to two lattices: copies of a lattice, and rows beyond a fold.

In: the lattices of a level. Out: lattices that share no vertices.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.finding.grow import frontier
from neurocal_cli.detection.finding.lattice import Lattice
from neurocal_cli.detection.finding.predict import predict_vertices
from neurocal_cli.geometry import Array

# Insensitive; FOLDED and "two boards" in tests/test_finding.py repeat this.
_SAME = 0.25  # squares; greatest distance between vertices that are the same
_MEETS = 0.13  # squares; greatest distance of a vertex from another lattice or its next row ...
_MEETS_PARTLY = 0.22  # ... and the same for vertices of incomplete rows
_MOSTLY = 0.6  # share of such vertices above which a row is removed
_COPY = 0.5  # share of vertices in another lattice above which a lattice is its copy
_BESIDE = 2.0  # squares; lattices farther apart share no vertices


def drop_duplicates(lattices: list[Lattice]) -> list[Lattice]:
    """Drop lattices if most of their vertices belong to a larger one."""
    kept: list[Lattice] = []
    for lattice in sorted(lattices, key=lambda x: -int(x.seen.sum())):
        points = lattice.pixels[lattice.seen]
        reach = _SAME * lattice.width
        if not any((_distance(points, x.pixels[x.seen]) < reach).mean() > _COPY for x in kept):
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
        for k, (low, high) in enumerate(boxes)
        for other_low, other_high in boxes[:k]
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
    if len(result) < 2:
        return result
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
    away[seen] = _distance(lattice.pixels[seen], points) / min(width, lattice.width)
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


def _distance(points: Array, others: Array) -> Array:
    """(N,) distance of each point from the nearest of the others [px]."""
    if not len(points) or not len(others):
        return np.full(len(points), np.inf)
    away = points[:, None] - others[None]
    return np.asarray(np.sqrt((away**2).sum(axis=-1).min(axis=1)))

"""Views that are no news: copies of each other, or in another unit."""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.median import median
from neurocal_cli.points import Correspondences

__all__ = ["repeated_views", "scaled_views"]

_SAME = 1e-3  # px
_SCALED = 1.2  # times the distance of neighbouring points in the other views
_MOST_POINTS = 400  # of a view that are looked at


def repeated_views(points: Correspondences) -> tuple[str, ...]:
    """Views with the very pixels of an earlier view, and views with rows given twice."""
    table = np.round(np.column_stack([points.pixels / _SAME, points.world]), 6)
    order = np.lexsort((*table.T, points.view_index))
    table, view = table[order], points.view_index[order]
    again = (table[1:] == table[:-1]).all(axis=1) & (view[1:] == view[:-1])
    doubled = np.bincount(view[1:][again], minlength=points.n_views) > 0
    found, known = [], set()
    for name, pixels, twice in zip(
        points.view_names, _by_view(points, np.round(table[:, :2])), doubled, strict=True
    ):
        key = pixels.tobytes()
        if key in known or twice:
            found.append(name)
        known.add(key)
    return tuple(found)


def scaled_views(points: Correspondences) -> tuple[str, ...]:
    """Views in which neighbouring points lie farther apart, or nearer, than in most views."""
    if points.n_views < 2:
        return ()
    order = np.argsort(points.view_index, kind="stable")
    steps: dict[bytes, float] = {}  # of the same target points, which most views share
    keys = []
    for world in _by_view(points, points.world[order]):
        world = world[:_MOST_POINTS]
        key = world.tobytes()
        if key not in steps:
            steps[key] = _step(world)
        keys.append(key)
    step = np.array([steps[key] for key in keys])
    ratio = step / median(step)
    off = (ratio > _SCALED) | (ratio < 1 / _SCALED)
    return tuple(np.array(points.view_names)[off].tolist())


def _step(world: Array) -> float:
    """Median distance of a point's nearest neighbour."""
    squares = ((world[:, None] - world[None]) ** 2).sum(axis=-1)
    squares[squares == 0] = np.inf
    return float(median(np.sqrt(squares.min(axis=1))))


def _by_view(points: Correspondences, rows: Array) -> list[Array]:
    """Rows that are sorted by view, one array for each view."""
    return np.split(rows, np.cumsum(np.bincount(points.view_index))[:-1])

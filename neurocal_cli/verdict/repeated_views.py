"""Views that are no news: copies of each other, or in another unit."""

from __future__ import annotations

import numpy as np

from neurocal_cli.points import Correspondences

__all__ = ["repeated_views", "scaled_views"]

_SAME = 1e-3  # px
_SCALED = 1.2  # times the distance of neighbouring points in the other views
_MOST_POINTS = 400  # of a view that are looked at


def repeated_views(points: Correspondences) -> tuple[str, ...]:
    """Views with the very pixels of an earlier view, and views with rows given twice."""
    order = np.argsort(points.view_index, kind="stable")
    counts = np.bincount(points.view_index)
    found, known = [], set()
    for name, rows in zip(points.view_names, np.split(order, np.cumsum(counts)[:-1]), strict=True):
        table = np.round(np.column_stack([points.pixels[rows] / _SAME, points.world[rows]]), 6)
        table = table[np.lexsort(table.T)]
        key = np.round(table[:, :2]).tobytes()
        if key in known or (len(table) > 1 and (np.diff(table, axis=0) == 0).all(axis=1).any()):
            found.append(name)
        known.add(key)
    return tuple(found)


def scaled_views(points: Correspondences) -> tuple[str, ...]:
    """Views in which neighbouring points lie farther apart, or nearer, than in most views."""
    if points.n_views < 2:
        return ()
    order = np.argsort(points.view_index, kind="stable")
    counts = np.bincount(points.view_index)
    steps = []
    for rows in np.split(order, np.cumsum(counts)[:-1]):
        world = points.world[rows[:_MOST_POINTS]]
        gap = np.linalg.norm(world[:, None] - world[None], axis=-1)
        gap[gap == 0] = np.inf
        steps.append(float(np.median(gap.min(axis=1))))
    ratio = np.array(steps) / np.median(steps)
    off = (ratio > _SCALED) | (ratio < 1 / _SCALED)
    return tuple(np.array(points.view_names)[off].tolist())

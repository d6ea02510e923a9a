"""Views that are copies of other views."""

from __future__ import annotations

import numpy as np

from neurocal_cli.points import Correspondences

_SAME = 1e-3  # px


def repeated_views(points: Correspondences) -> tuple[str, ...]:
    """Names of views with the same pixels as an earlier view, and of views with duplicated rows."""
    table = np.round(np.column_stack([points.pixels / _SAME, points.world]), 6)
    order = np.lexsort((*table.T, points.view_index))
    table, view = table[order], points.view_index[order]
    again = (table[1:] == table[:-1]).all(axis=1) & (view[1:] == view[:-1])
    doubled = np.bincount(view[1:][again], minlength=points.n_views) > 0
    of_views = np.split(np.round(table[:, :2]), np.cumsum(np.bincount(points.view_index))[:-1])
    found, known = [], set()
    for name, pixels, twice in zip(points.view_names, of_views, doubled, strict=True):
        key = pixels.tobytes()
        if key in known or twice:
            found.append(name)
        known.add(key)
    return tuple(found)

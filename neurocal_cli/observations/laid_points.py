"""Points of another kind on an estimated board, such as the vertices of one whose mid-points were estimated.

They move with the points around them: the offsets of these are continued by a thin-plate spline.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.board import is_flat, smooth_between
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target

_ON = 1e-6  # of the target's size; distance from a plane of points that are on it
_BESIDE = 1.0  # of the greatest distance of neighbours; distance from the target's points of those on it
_FEWEST = 12  # points that tell the shape of a plane


def laid(target: Target, points: Correspondences) -> Correspondences:
    """Points of a target moved to their estimated coordinates, and others on its planes with them."""
    known = target.places(points.world)
    found = target.applied(points)
    if (known >= 0).all():
        return found
    world = found.world.copy()
    for plane in range(int(target.plane.max(initial=-1)) + 1):
        mine = target.plane == plane
        given, offsets = target.given[mine], target.offsets[mine]
        if len(given) < _FEWEST or not offsets.any() or not is_flat(given):
            continue
        centre = given.mean(axis=0)
        axes = np.linalg.svd(given - centre, full_matrices=False)[2]
        places, at = ((x - centre) @ axes.T for x in (given, points.world))
        on = (known < 0) & (np.abs(at[:, 2]) < _ON * float(np.ptp(places)))
        on[on] = _apart(at[on], places, 0) <= _BESIDE * _apart(places, places, 1).max()
        if on.any():
            world[on] += smooth_between(places[:, :2], offsets, at[on, :2])
    return replace(found, world=world)


def _apart(at: Array, places: Array, others: int) -> Array:
    """Distance (N,) of points from the nearest place, after so many nearer ones."""
    from scipy.spatial import KDTree

    return np.asarray(KDTree(places).query(at, k=[others + 1])[0][:, 0])

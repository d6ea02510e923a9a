"""An estimated target on its board: the board as it was found, and points of another kind on it.

Points of another kind, such as the vertices of a board whose mid-points were estimated, move with the points
around them: the offsets of these are continued by a thin-plate spline.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane, is_flat, smooth_between
from neurocal_cli.observations.distances import Distance
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


_DETERMINED = 4  # points that determine a plane's bend


def with_found_points(board: Board, target: Target, unit: str, distances: tuple[Distance, ...] = ()) -> Board:
    """The board with the estimated positions of the points that the target has on it.

    Raises InputError if the units differ, or points of the target are not on the board.
    """
    if target.point is None:
        raise InputError(
            "the points have no ids of a board; calibrate from points found by `neurocal detect`"
        )
    if unit != board.unit:
        raise InputError(
            f"the target is in {unit} and the board in {board.unit}; give the board of the points"
        )
    found = dict(zip(map(str, target.point.tolist()), target.found, strict=True))
    planes = []
    for plane in board.planes:
        places = _places(plane)
        rows = tuple((*places[name], *found.pop(name).tolist()) for name in list(found) if name in places)
        planes.append(replace(plane, measured=rows) if len(rows) >= _DETERMINED else plane)
    if found:
        raise InputError(f"the point {next(iter(found))!r} is not on the board; give the board of the points")
    return Board(tuple(planes), board.unit, distances)


def _places(plane: Plane) -> dict[str, tuple[float, float]]:
    """Grid places of all points of a plane, and of those on its rim, by their ids."""
    c, r = np.meshgrid(np.arange(plane.cols, dtype=float), np.arange(plane.rows, dtype=float))
    vertices = zip(plane.vertex_ids(), np.column_stack([c.ravel(), r.ravel()]).tolist(), strict=True)
    middles = zip(plane.midpoint_ids(), plane.midpoint_grid().tolist(), strict=True)
    rim = [
        (plane.label(kind, col, row), (col + 0.5 * (kind == "h:"), row + 0.5 * (kind == "v:")))
        for kind, cols, rows in (
            ("h:", (-1, plane.cols - 1), range(plane.rows)),
            ("v:", range(plane.cols), (-1, plane.rows - 1)),
        )
        for col in cols
        for row in rows
    ]
    known = [(name, (place[0], place[1])) for name, place in (*vertices, *middles)]
    return {name: place for name, place in (*rim, *known) if name}

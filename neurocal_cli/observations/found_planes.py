"""A described board with the estimated positions of its points, for kinds that ids alone do not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.distances import Distance
from neurocal_cli.observations.target import Target

_FEWEST = 4  # points that determine a plane's bend


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
        planes.append(replace(plane, measured=rows) if len(rows) >= _FEWEST else plane)
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

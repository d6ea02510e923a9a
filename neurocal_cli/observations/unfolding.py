"""Several planes of a board side by side on one sheet, joined at the lines along which it is folded.

The printed side is the one that faces the other planes: the inside of a corner. The sheet's coordinates are x
to the right and y downwards, in the board's unit.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane

_SAME = 1e-6  # of a square: lengths below are rounding
_FARTHEST = 3.0  # squares from a board to a fold; beyond, the planes do not belong on one sheet
_REACH = 1.0  # squares of the pattern beyond the outer vertices, one whole


@frozen_dataclass(eq=False)
class Laid:
    """A plane on the sheet."""

    plane: Plane
    origin: Array  # (2,) vertex (0, 0)
    axes: Array  # (2, 2) rows: x_axis and y_axis on the sheet, unit vectors
    reach: Array  # (2, 2) [squares] of the pattern beyond the outer vertices, [axis, low or high]

    def at(self, grid: Array) -> Array:
        """Places on the sheet of grid coordinates (..., 2) [squares]."""
        return np.asarray(self.origin + self.plane.square * np.asarray(grid, dtype=float) @ self.axes)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Grid coordinates of two opposite corners of the pattern [squares]."""
        last = np.array([self.plane.cols - 1, self.plane.rows - 1], dtype=float)
        return -self.reach[:, 0], last + self.reach[:, 1]

    @property
    def outline(self) -> Array:
        """(4, 2) corners of the pattern on the sheet."""
        low, high = self.bounds
        return self.at(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))


@frozen_dataclass(eq=False)
class _Map:
    """Map from points of a plane to the sheet, ``B X + b``; B (2, 3), b (2,)."""

    B: Array
    b: Array

    def __call__(self, points: Array) -> Array:
        return np.asarray(points @ self.B.T + self.b)


def unfolded(board: Board) -> tuple[list[Laid], list[Array]]:
    """Lay the planes of a board flat: one, or several that meet in lines beside them.

    Returns them in the order of the planes, and the ends (2, 2) of the lines along which the sheet is folded,
    from end to end of the pattern. An InputError names planes that do not meet in such a line, or that would
    lie on each other on the sheet.
    """
    planes = board.planes
    maps, folds = [_first_map(planes)], []
    for k in range(1, len(planes)):
        new, fold = _joined(planes[k], planes[:k], maps)
        maps.append(new)
        folds.append(fold)
    laid = [_laid(plane, place, planes) for plane, place in zip(planes, maps, strict=True)]
    for first, second in combinations(laid, 2):
        a, b = first.outline, second.outline
        gap = np.maximum(b.min(axis=0) - a.max(axis=0), a.min(axis=0) - b.max(axis=0))
        if (gap < -_SAME * second.plane.square).all():
            raise InputError(
                f"the planes {first.plane.name!r} and {second.plane.name!r} would lie on each other on the "
                "sheet; print them one by one"
            )
    return laid, folds


def _first_map(planes: tuple[Plane, ...]) -> _Map:
    """The first plane's x_axis is to the right, as one sees it from the printed side."""
    plane = planes[0]
    down = np.array(plane.y_axis)
    if len(planes) > 1:
        others = np.mean([_middle(other) for other in planes[1:]], axis=0)
        if (others - _middle(plane)) @ plane.normal > 0:  # x, y and the way to the eye are right-handed
            down = -down
    B = np.array([plane.x_axis, down])
    return _Map(B, -B @ np.array(plane.origin))


def _joined(plane: Plane, before: tuple[Plane, ...], maps: list[_Map]) -> tuple[_Map, Array]:
    """A plane laid beside the first of those before it that it meets."""
    for other, place in zip(before, maps, strict=True):
        line = _meeting(plane, other)
        if line is None:
            continue
        point, along = line
        inward, opposite = (_across(p, point, along) for p in (plane, other))
        B = np.outer(place.B @ along, along) - np.outer(place.B @ opposite, inward)
        new = _Map(B, place(point) - B @ point)
        corners = [[[-1, -1], [p.cols, -1], [p.cols, p.rows], [-1, p.rows]] for p in (plane, other)]  # uncut
        marks = np.concatenate([plane.at(corners[0]), other.at(corners[1])])
        lengths = (marks - point) @ along
        return new, place(point + np.outer([lengths.min(), lengths.max()], along))
    raise InputError(
        f"the plane {plane.name!r} meets none of the planes before it in a line beside both; print it alone"
    )


def _middle(plane: Plane) -> Array:
    return plane.at(np.array([plane.cols - 1, plane.rows - 1]) / 2)


def _meeting(a: Plane, b: Plane) -> tuple[Array, Array] | None:
    """A point and the direction of the line where two planes meet, if it is beside both boards."""
    along = np.cross(a.normal, b.normal)
    length = float(np.linalg.norm(along))
    if length < _SAME:
        return None
    along = along / length
    heights = [a.normal @ np.array(a.origin), b.normal @ np.array(b.origin), along @ _middle(a)]
    point = np.linalg.solve(np.array([a.normal, b.normal, along]), np.array(heights))
    for plane in (a, b):
        across = (plane.vertices().reshape(-1, 3) - point) @ _across(plane, point, along)
        if not -_SAME * plane.square <= across.min() <= _FARTHEST * plane.square:
            return None
    return point, along


def _across(plane: Plane, point: Array, along: Array) -> Array:
    """The direction in a plane, perpendicular to a line in it, that leads to the middle of the board."""
    way = _middle(plane) - point
    way = way - (way @ along) * along
    length = float(np.linalg.norm(way))
    return np.asarray(way / length) if length > 0 else way


def _laid(plane: Plane, place: _Map, planes: tuple[Plane, ...]) -> Laid:
    """A plane on the sheet, its pattern cut off at the lines where other planes meet it."""
    reach = np.full((2, 2), _REACH)
    for other in planes:
        line = None if other is plane else _meeting(plane, other)
        if line is None:
            continue
        point, along = line
        inward = _across(plane, point, along)
        slopes = np.array([plane.x_axis, plane.y_axis]) @ inward
        axis = int(np.argmax(np.abs(slopes)))
        if abs(slopes[axis]) < 1 - _SAME:
            raise InputError(
                f"the fold at {plane.name!r} is not along its rows or columns; turn the plane's axes"
            )
        room = ((plane.vertices().reshape(-1, 3) - point) @ inward).min() / plane.square
        side = 0 if slopes[axis] > 0 else 1
        reach[axis, side] = min(reach[axis, side], room)
    axes = np.array([plane.x_axis, plane.y_axis]) @ place.B.T
    return Laid(plane, place(np.array(plane.origin)), axes, reach)

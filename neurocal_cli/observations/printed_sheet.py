"""A board on a sheet of paper: its pattern, folds, rulers and a line of text, in millimetres.

The square between vertices (0, 0) and (1, 1) is black. That is where detection, like OpenCV, begins to count.
Several planes of a board lie side by side on one sheet, joined at the lines along which it is folded. The
printed side is the one that faces the other planes: the inside of a corner. The sheet's coordinates are x to
the right and y downwards, in the board's unit until they are scaled to the paper.
"""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError, UsageError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane, circle_places, described
from neurocal_cli.observations.marked_cells import printed_rectangles

# Width and height [mm], upright.
PAPERS = {
    "A0": (841.0, 1189.0),
    "A1": (594.0, 841.0),
    "A2": (420.0, 594.0),
    "A3": (297.0, 420.0),
    "A4": (210.0, 297.0),
    "A5": (148.0, 210.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
_MILLIMETRES = {"mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "inch": 25.4, "in": 25.4}

_EDGE = 5.0  # that printers leave white [mm]
_QUIET = 5.0  # white around the pattern, to rulers and edge [mm]
_RULER = 9.0  # room for a ruler with its numbers [mm]
_TICK = 10.0  # between the marks of a ruler [mm]
_LONGEST = 200.0  # ruler [mm]
_COLS, _ROWS = 9, 6  # of the board that is made without being asked for: one count is odd, one even

_SAME = 1e-6  # of a square: lengths below are rounding
_FARTHEST = 3.0  # squares from a board to a fold; beyond, the planes do not belong on one sheet
_REACH = 1.0  # squares of the pattern beyond the outer vertices, one whole


@frozen_dataclass(eq=False)
class Line:
    """A thin line; ends (2,) in mm."""

    start: Array
    end: Array
    width: float = 0.2
    dashed: bool = False


@frozen_dataclass(eq=False)
class Text:
    """A text whose base line begins, or whose middle is, at a place (2,) in mm."""

    place: Array
    content: str
    size: float = 3.0
    middle: bool = False


@frozen_dataclass(eq=False)
class Laid:
    """A plane on the sheet."""

    plane: Plane
    origin: Array  # (2,) vertex (0, 0)
    axes: Array  # (2, 2) rows: x_axis and y_axis on the sheet, unit vectors
    reach: Array  # (2, 2) [squares] of the pattern beyond the outer vertices, [axis, low or high]

    def at(self, lengths: Array) -> Array:
        """Places on the sheet of lengths (..., 2) from vertex (0, 0) along the axes [squares]."""
        return np.asarray(self.origin + self.plane.square * np.asarray(lengths, dtype=float) @ self.axes)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Two opposite corners of the pattern, as lengths from vertex (0, 0) [squares]."""
        if isinstance(self.plane, CirclePlane):
            centres, radius = circle_places(self.plane)
            return centres.min(axis=0) - radius, centres.max(axis=0) + radius
        if isinstance(self.plane, TagPlane) and not self.plane.downwards:  # with the squares at its corners
            ends = np.array([[-1.0, -1.0], [self.plane.cols, self.plane.rows]])
            return tuple(self.plane.spread(ends))
        last = self.plane.spread(np.array([self.plane.cols - 1, self.plane.rows - 1], dtype=float))
        return -self.reach[:, 0], last + self.reach[:, 1]

    @property
    def outline(self) -> Array:
        """(4, 2) corners of the pattern on the sheet."""
        low, high = self.bounds
        return self.at(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))


@frozen_dataclass(eq=False)
class Sheet:
    """What is printed, in mm; the origin is the paper's top-left corner, y is downwards."""

    width: float
    height: float
    squares: Array  # (N, 4, 2) corners of the black squares and parts of squares
    discs: Array  # (N, 3) centres and radii of black circles
    lines: tuple[Line, ...]
    texts: tuple[Text, ...]
    laid: tuple[Laid, ...]  # the planes in the board's unit, before they were scaled and moved
    scale: float  # mm of a unit of the board
    origin: Array  # (2,) where the origin of `laid` is on the paper


def millimetres(unit: str) -> float:
    """Millimetres of one unit."""
    if unit not in _MILLIMETRES:
        raise InputError(f"the unit {unit[:20]!r} is no known length; use one of {', '.join(_MILLIMETRES)}")
    return _MILLIMETRES[unit]


def paper_size(name: str) -> tuple[float, float]:
    """Width and height of a paper by its name, or of ``420x297`` [mm]; UsageError if there is none."""
    for known, size in PAPERS.items():
        if name.lower() == known.lower():
            return size
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", name)
    if match and all(20 <= float(side) <= 5000 for side in match.groups()):
        return float(match[1]), float(match[2])
    raise UsageError(
        f"the paper {name[:20]!r} is not known; use {', '.join(PAPERS)}, or its size in mm such as 420x297, "
        "each from 20 to 5000"
    )


def default_board(paper: tuple[float, float], cols: int = 9, rows: int = 6) -> Board:
    """A board with the largest squares in whole mm; with the default numbers, it looks different turned."""
    rooms = _room(*paper), _room(*paper[::-1])
    square = float(np.floor(max(min(room[0] / (cols + 1), room[1] / (rows + 1)) for room in rooms)))
    if square < 5:
        raise InputError(
            f"the paper is too small for a board of {cols} x {rows} inner vertices; give a larger one"
        )
    return Board.single(cols, rows, square, "mm")


def on_paper(board: Board, paper: tuple[float, float]) -> Sheet:
    """Lay a board out on paper (width, height) [mm], upright or lying; an InputError if neither fits."""
    scale = millimetres(board.unit)
    laid, folds = unfolded(board)
    outlines = scale * np.concatenate([one.outline for one in laid])
    low, high = outlines.min(axis=0), outlines.max(axis=0)
    size = high - low
    for width, height in (paper, paper[::-1]):
        room = _room(width, height)
        if (size <= np.array(room) + 1e-6).all():
            break
    else:
        room = _room(max(paper), min(paper))
        raise InputError(
            f"the board is {max(size):.4g} x {min(size):.4g} mm with its border, and {room[0]:.4g} x "
            f"{room[1]:.4g} mm of the paper can be printed on; give a larger --paper or a smaller --square"
        )
    corner = np.array([_EDGE + _RULER + _QUIET, _EDGE + _QUIET]) + 0.5 * (np.array(room) - size)
    origin = corner - low
    lines = [line for fold in folds for line in _beside(*(scale * fold + origin))]
    rulers, numbers = _rulers(corner, size, height)
    squares = scale * np.concatenate([_black(one) for one in laid]) + origin
    discs = scale * np.concatenate([_discs(one) for one in laid]) + [*origin, 0.0]
    sizes = [
        f"{plane.name + ': ' if plane.name else ''}{described(plane, board.unit)}" for plane in board.planes
    ]
    caption = f"{', '.join(sizes)}. Print at 100 %, then measure the rulers."
    text = Text(np.array([_EDGE + _RULER + _QUIET, height - _EDGE]), caption, 2.8)
    return Sheet(
        width, height, squares, discs, (*lines, *rulers), (*numbers, text), tuple(laid), scale, origin
    )


def _room(width: float, height: float) -> tuple[float, float]:
    """Space for the pattern: without the edges, the quiet zone, the rulers, and the text at the bottom."""
    return width - 2 * (_EDGE + _QUIET) - _RULER, height - 2 * (_EDGE + _QUIET) - _RULER - 4.0


def _black(laid: Laid) -> Array:
    """(N, 4, 2) corners of the black squares of a plane, those at the border cut to its reach."""
    if isinstance(laid.plane, CirclePlane):
        return np.zeros((0, 4, 2))
    if laid.plane.markers is not None:
        x, y, dark = printed_rectangles(laid.plane)
        return laid.at(_merged(x, y, dark[1:-1, 1:-1]))
    low, high = laid.bounds
    c, r = np.meshgrid(np.arange(-1, laid.plane.cols), np.arange(-1, laid.plane.rows))
    black = (c + r) % 2 == 0
    first = np.column_stack([c[black], r[black]]).astype(float)
    start, end = np.maximum(first, low), np.minimum(first + 1, high)
    kept = ((end - start) > 1e-9).all(axis=1)
    (a, b), (x, y) = start[kept].T, end[kept].T
    return laid.at(np.column_stack([a, b, x, b, x, y, a, y]).reshape(-1, 4, 2))


def _merged(x: Array, y: Array, dark: NDArray[np.bool_]) -> Array:
    """(N, 4, 2) corners of rectangles for dark cells ``[y, x]`` between lines, equal pieces joined."""
    open_pieces: dict[tuple[int, int], int] = {}
    found = []
    for j in range(len(y)):
        row = dark[j] if j < len(dark) else np.zeros(len(x) - 1, dtype=bool)
        steps = np.flatnonzero(np.diff(np.pad(row.astype(int), 1)))
        pieces = set(zip(steps[::2].tolist(), steps[1::2].tolist(), strict=True))
        for piece in [piece for piece in open_pieces if piece not in pieces]:
            found.append((*piece, open_pieces.pop(piece), j))
        open_pieces |= {piece: j for piece in pieces if piece not in open_pieces}
    first, last, top, bottom = np.array(found).T
    low_x, high_x, low_y, high_y = x[first], x[last], y[top], y[bottom]
    corners = [low_x, low_y, high_x, low_y, high_x, high_y, low_x, high_y]
    return np.column_stack(corners).reshape(-1, 4, 2)


def _discs(laid: Laid) -> Array:
    """(N, 3) centres and radii of the circles of a plane on the sheet."""
    if not isinstance(laid.plane, CirclePlane):
        return np.zeros((0, 3))
    centres, radius = circle_places(laid.plane)
    return np.column_stack([laid.at(centres), np.full(len(centres), radius * laid.plane.square)])


def _beside(start: Array, end: Array) -> list[Line]:
    """Dashes of a fold: 4 mm at either end, beside the pattern, where they change none of its edges."""
    along = (end - start) / np.linalg.norm(end - start)
    return [
        Line(place + 0.7 * way, place + (_QUIET - 0.5) * way, dashed=True)
        for place, way in ((start, -along), (end, along))
    ]


def _rulers(corner: Array, size: Array, height: float) -> tuple[list[Line], list[Text]]:
    """A ruler below the pattern and one beside it, of whole centimetres, from 0."""
    lines, texts = [], []
    below = height - _EDGE - 4.0 - _RULER + 3.0
    beside = _EDGE + 2.0
    for axis, start in ((0, np.array([corner[0], below])), (1, np.array([beside, corner[1]]))):
        length = _TICK * np.floor(min(_LONGEST, float(size[axis])) / _TICK)
        along, across = np.eye(2)[axis], np.eye(2)[1 - axis]
        lines.append(Line(start, start + length * along))
        for mark in np.arange(0.0, length + 1, _TICK):
            tall = 2.5 if mark % (5 * _TICK) == 0 else 1.5
            place = start + mark * along
            lines.append(Line(place, place + tall * across))
            if mark % (5 * _TICK) == 0:
                shift = np.array([0.0, 5.5]) if axis == 0 else np.array([3.2, 0.9])
                last = axis == 0 and mark + 5 * _TICK > length
                shown = f"{mark:.0f}{' mm' if last else ''}"
                texts.append(Text(place + shift, shown, 2.5, middle=axis == 0))
    return lines, texts


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


@frozen_dataclass(eq=False)
class _Map:
    """Map from points of a plane to the sheet, ``B X + b``; B (2, 3), b (2,)."""

    B: Array
    b: Array

    def __call__(self, points: Array) -> Array:
        return np.asarray(points @ self.B.T + self.b)


def _first_map(planes: tuple[Plane, ...]) -> _Map:
    """The first plane's x_axis is to the right, as one sees it from the printed side."""
    plane = planes[0]
    down = np.array(plane.y_axis)
    if isinstance(plane, TagPlane) and not plane.downwards:
        down = -down
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
    """World coordinates (3,) of the middle of a board."""
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

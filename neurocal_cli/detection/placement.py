"""Placements of a grid on a plane of the board: rotated, mirrored if seen from behind, and shifted.

The board's ends exclude most of them. One more ring of squares surrounds the outer vertices. If the board
ends, the brightness beyond the ring is the same next to dark and light squares, and the change is where the
next vertices would be. An occluder, a shadow or the image border cuts the ring at another place, and an
occluder hides the margin that other sides show. A shadow may begin just at a line of the board. The pattern
may be seen in it faintly. If not, what lies beyond is dark at one side and light at the others, so that side
is not taken for an end. A window on a screen may cut squares beyond the ring: between what is left of them
and the ring is one more line of vertices, too near to the cut to be measured.

Before that, `trimmed` removes outer lines of a grid that are not lines of the board. False vertices occur
where a corner of the paper lies near the outer squares, and at corners of squares on a fold.

A grid that cannot be placed gives a `NoBoardError`, whose message says what the image shows instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.grid import TURNS, Grid
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.board import Board, Plane

# Sides of a grid, named by their outward directions (c, r).
DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))
# With these limits test_identity.py classifies ends of rendered boards, occluders and image borders.
_STEPS = np.arange(0.60, 1.71, 0.05)  # squares outwards from the outer vertices
_RING, _BEYOND = _STEPS < 0.76, (_STEPS > 1.19) & (_STEPS < 1.41)
_MARGIN = (_STEPS > 1.09) & (_STEPS < 1.16)  # of a board whose margin is narrow
_PAST = (_STEPS > 1.01) & (_STEPS < 1.19)  # at the beginning of the next squares
_NEXT = _STEPS > 1.29  # in the middle of the next squares
_FAR = int(np.count_nonzero(_STEPS < 1.41)) - 1
_ACROSS = np.array([0.3, 0.5, 0.7])  # samples along a side, in widths of a square
_SAME, _DIFFERENT = 0.35, 0.6  # differences of brightness, in contrasts of dark and light squares
_AT_THE_LINE = 0.12  # squares; greatest distance of the board's end from the next vertices
_SHARE = 0.75  # least share of the squares along a side that must agree
_FAINT, _FEWEST_FAINT = 0.004, 4  # least contrast of the pattern in a shadow, and number of neighbours
_OUTSIDE = 0.5  # share of the profiles that leave the image above which the side does
_FEWEST = 2  # least number of usable squares at a side


class End(Enum):
    """State of a side of a grid in the image."""

    BOARD = "the board ends there"
    STOPS = "the pattern stops there: the board ends, or something hides the rest of it"
    PATTERN = "the pattern goes on"
    CUT = "the pattern goes on, and ends within the next squares"
    OUTSIDE = "outside the image, or behind something before the board"
    UNKNOWN = "hidden or blurred"


def board_ends(grey: NDArray[np.generic], grid: Grid) -> dict[tuple[int, int], End]:
    """Classify the sides of a grid in a grey image, named by their directions."""
    with np.errstate(invalid="ignore"):  # unknown values are NaN
        sides = _opposite(grey, grid.pixels.transpose(1, 0, 2), grid.dark)
        sides += _opposite(grey, grid.pixels, grid.dark)
        found = [_classify(*side) for side in sides]
        # The margin of most sides; the light one if there are as many dark ones, which may be shadows.
        margins = sorted(margin for end, margin in found if end is End.BOARD)
        usual = margins[len(margins) // 2] if margins else np.nan
        ends = dict(zip(DIRECTIONS, (end for end, _ in found), strict=True))
        for direction, (light, profile, _), (end, margin) in zip(DIRECTIONS, sides, found, strict=True):
            if end in (End.BOARD, End.STOPS) and _is_covered(light, profile, usual):
                ends[direction] = End.OUTSIDE
            elif end is End.CUT and not _margin_follows(profile, usual):
                ends[direction] = End.PATTERN
            elif end is End.BOARD and abs(margin - usual) > _DIFFERENT:
                ends[direction] = End.STOPS  # before the dark: it may be a shadow
    return ends


def _is_covered(light: NDArray[np.bool_], profile: Array, margin: float) -> bool:
    """Whether something hides the rest: it cuts squares of the ring.

    The margin, which is known from other sides, is not seen.
    """
    beyond = profile[:, _BEYOND].mean(axis=1)
    before = _crossings(profile, light.astype(float), beyond) < 1 - _AT_THE_LINE
    cut = before & (np.abs(beyond - light) > _SAME)
    away = np.abs(beyond - margin) > _SAME
    return bool(away.mean() >= _SHARE and cut.any())


def _margin_follows(profile: Array, margin: float) -> bool:
    """Whether the margin that other sides show follows what is left of the next squares."""
    return bool(((np.abs(profile - margin) < _SAME).mean(axis=0) >= _SHARE)[_STEPS > 1].any())


def seen_size(grid: Grid, ends: Mapping[tuple[int, int], End]) -> tuple[int, int]:
    """Columns and rows of a grid with its lines beside squares that are cut."""
    cols, rows = (
        length + sum(end is End.CUT for side, end in ends.items() if side[axis])
        for axis, length in enumerate(grid.shape)
    )
    return cols, rows


def _classify(light: NDArray[np.bool_], profile: Array, outside: NDArray[np.bool_]) -> tuple[End, float]:
    """Classify a side by the colours (N,) of its ring squares and the profiles (N, steps) across the side.

    Also returns the brightness beyond the ring.
    """
    if outside.mean() > _OUTSIDE:
        return End.OUTSIDE, np.nan
    ring = profile[:, _RING].mean(axis=1)
    valid = np.abs(ring - light) < _SAME
    count = np.count_nonzero(valid)
    if count < max(_FEWEST, min(0.6 * len(valid), int(np.isfinite(ring).sum()))):
        return End.UNKNOWN, np.nan
    profile, ring, light = profile[valid], ring[valid], light[valid]
    if light.all() or not light.any():
        return End.UNKNOWN, np.nan
    state, margin = _beyond_ring(light, profile, ring, _BEYOND)
    if state is not End.PATTERN:
        for at in _STEPS[_PAST]:
            if _beyond_ring(light, profile, ring, at == _STEPS)[0] is End.PATTERN:
                return End.CUT, margin
    if state is End.BOARD and margin < _SAME and _goes_on_in_shadow(light, profile):
        return End.PATTERN, margin
    if state is End.STOPS:  # the margin may be narrow
        near, margin_near = _beyond_ring(light, profile, ring, _MARGIN)
        state, margin = (near, margin_near) if near is End.BOARD else (state, margin)
    return state, margin


def _goes_on_in_shadow(light: NDArray[np.bool_], profile: Array) -> bool:
    """Whether every square beyond a dark one of the ring is lighter than its neighbours, in the dark."""
    level = profile[:, _NEXT].mean(axis=1)
    rise = np.diff(level) * np.where(light[1:], -1, 1)
    alternating = light[1:] != light[:-1]
    if np.count_nonzero(alternating) < _FEWEST_FAINT or not alternating.all():
        return False
    return bool(rise.min() > _FAINT)


def _beyond_ring(
    light: NDArray[np.bool_], profile: Array, ring: Array, steps: NDArray[np.bool_]
) -> tuple[End, float]:
    """Classify a side by the brightness at some steps beyond the ring, and return this."""
    beyond = profile[:, steps].mean(axis=1)
    turns = np.abs(beyond - ring) > _SAME
    at_line = np.abs(_crossings(profile, ring, beyond) - 1) < _AT_THE_LINE
    agreeing, turning = np.count_nonzero(turns & at_line), np.count_nonzero(turns)
    next_to_dark, next_to_light = float(np.median(beyond[~light])), float(np.median(beyond[light]))
    step, margin = next_to_dark - next_to_light, 0.5 * (next_to_dark + next_to_light)
    if step > _DIFFERENT and agreeing >= _SHARE * len(light):
        return End.PATTERN, margin
    of_each = int(np.count_nonzero(light)), int(np.count_nonzero(~light))
    few = min(_FEWEST, *of_each)  # a short side may have only one
    if abs(step) < _SAME and turning >= few and agreeing >= _SHARE * turning:
        return End.BOARD, margin
    return (End.STOPS if -_DIFFERENT < step < _SAME else End.UNKNOWN), margin


def _crossings(profile: Array, ring: Array, beyond: Array) -> Array:
    """Position where each profile is halfway between its two ends [squares]; arbitrary if they are equal."""
    rise = np.where(beyond > ring, 1.0, -1.0)[:, None]
    height = rise * (profile - 0.5 * (ring + beyond)[:, None])
    k = np.argmax(height[:, 1:] > 0, axis=1)  # the last step before the half-way level
    rows = np.arange(len(k))
    low, high = height[rows, k], height[rows, k + 1]
    share = np.minimum(np.maximum(-low / np.where(high == low, 1.0, high - low), 0.0), 1.0)
    return _STEPS[k] + share * (_STEPS[k + 1] - _STEPS[k])


def _opposite(
    grey: NDArray[np.generic], rows: Array, dark: int
) -> list[tuple[NDArray[np.bool_], Array, NDArray[np.bool_]]]:
    """Colours of the ring squares at two opposite sides, True for light, and the profiles outwards from them.

    The third result says which profiles leave the image. A profile is 0 at the dark and 1 at the light level,
    and NaN outside the image and where vertices are missing. `rows` are the lines of vertices (rows, n, 2)
    [px] parallel to the two sides.
    """
    few = min(len(rows), 3)
    ends = np.stack([rows[:few], rows[: -few - 1 : -1]])  # (2, few, n, 2), the outermost first
    outer = np.array([[-1], [len(rows) - 1]])
    # The colour of a square follows from the indices of its first vertex.
    light = (np.arange(rows.shape[1] - 1) + outer + dark) % 2 == 1
    inner = _between(0.5 * (ends[:, 0] + ends[:, 1]), np.array([0.5]))  # centres of the squares inside
    places = _between(_beyond(ends), _ACROSS)  # (2, steps, n - 1, across, 2)
    values = _sample(grey, np.concatenate([inner.reshape(-1, 2), places.reshape(-1, 2)]))
    level, values = values[: light.size].reshape(light.shape), values[light.size :].reshape(places.shape[:-1])
    padded = np.full((2, light.shape[1] + 2), np.nan)
    padded[:, 1:-1] = level
    # The neighbours of the inner square have the colour of the ring square; one of them may be missing.
    before, after = padded[:, :-2], padded[:, 2:]
    same = 0.5 * (np.where(np.isnan(before), after, before) + np.where(np.isnan(after), before, after))
    contrast = np.where(light, same - level, level - same)
    darker = np.where(light, level, same)
    contrast[~(contrast > 0)] = np.nan
    profile = (values.mean(axis=-1).swapaxes(1, 2) - darker[..., None]) / contrast[..., None]
    outside = np.any(np.isnan(values[:, _FAR]) & np.isfinite(places[:, _FAR, ..., 0]), axis=-1)
    return [(light[k], profile[k], outside[k]) for k in (0, 1)]


def _beyond(ends: Array) -> Array:
    """Extrapolate rows (2, 2 or 3, n, 2) outwards to points (2, steps, n, 2), by parabolas or lines."""
    t = -_STEPS[:, None, None]
    first, second = ends[:, :1], ends[:, 1:2]
    line = first + t * (second - first)
    if ends.shape[1] < 3:
        return line
    change = ends[:, 2:] - 2 * second + first
    return line + 0.5 * t * (t - 1) * np.where(np.isnan(change), 0.0, change)


def _between(line: Array, shares: Array) -> Array:
    """Interpolate between neighbours on lines (..., n, 2); (..., n - 1, shares, 2) array."""
    return line[..., :-1, None, :] + shares[:, None] * (line[..., 1:, None, :] - line[..., :-1, None, :])


def _sample(grey: NDArray[np.generic], places: Array) -> Array:
    """Interpolate the image linearly at places (N, 2), in float64; NaN outside."""
    height, width = grey.shape
    if height < 2 or width < 2:
        return np.full(len(places), np.nan)
    u, v = places.T
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    i = np.minimum(u.astype(np.intp), width - 2)
    j = np.minimum(v.astype(np.intp), height - 2)
    a, b = u - i, v - j
    upper, lower = ((1 - a) * grey[j + k, i] + a * grey[j + k, i + 1] for k in (0, 1))
    return np.where(inside, (1 - b) * upper + b * lower, np.nan)


Matrix = tuple[tuple[int, int], tuple[int, int]]

_SIDES: tuple[tuple[slice | int, ...], ...] = (np.s_[:, 0], np.s_[:, -1], np.s_[0, :], np.s_[-1, :])
_MIRRORED: tuple[Matrix, ...] = tuple((second, first) for first, second in TURNS)

# With these limits test_identity.py removes false lines, and keeps those of larger boards.
_FEW = 0.34  # a line may be removed if at most this share of its vertices was found
_FEW_AT_FOLDS = 0.6  # the same for several planes, which are tested against a camera afterwards

# Least share of a grid's vertices that are found if it is a whole board. On photographs it is 0.89 and more
# for boards, and at most 0.77 for blinds, tiled floors and textures. It changes only a message.
_WHOLE = 0.8

ONE_BOARD = "show only one of them, or cut pictures that hold both images of a stereo camera apart"
NEARER = 1.5  # ratio of the sizes above which the larger of two equal boards is preferred

SYMMETRIC_BOARD = (
    "the board looks the same after a turn, so its first corner depends on its orientation in the image; to "
    "get the same point ids in all images, use a board with an even number of inner vertices on one side and "
    "an odd number on the other"
)


@frozen_dataclass
class Placement:
    """A grid's coordinates on a plane: ``matrix @ (c, r) + offset``."""

    plane: int  # position among the board's planes
    matrix: Matrix  # a rotation by a multiple of 90 degrees, with or without a reflection
    offset: tuple[int, int]

    def apply(self, grid: ArrayLike) -> Array:
        """Plane coordinates (..., 2) of grid coordinates."""
        return np.asarray(grid) @ np.array(self.matrix).T + np.array(self.offset)

    def first_square_is_dark(self, dark: int) -> bool:
        """Whether the square between the plane's vertices (0, 0) and (1, 1) is dark, by `Grid.dark`."""
        centre = (np.array([0.5, 0.5]) - np.array(self.offset)) @ np.array(self.matrix)  # matrix^-1
        return bool((np.floor(centre).sum() + dark) % 2 == 0)

    def axis(self, grid: Grid) -> Array:
        """Mean direction of the plane's x axis in the image of a grid; (2,) unit vector."""
        steps = (np.diff(grid.pixels, axis=1), np.diff(grid.pixels, axis=0))  # along c, along r
        along_c, along_r = (np.nanmean(step.reshape(-1, 2), axis=0) for step in steps)
        axis = self.matrix[0][0] * along_c + self.matrix[0][1] * along_r
        return np.asarray(axis / np.hypot(*axis))


def placements(
    grid: Grid, plane: Plane, index: int, ends: Mapping[tuple[int, int], End], *, mirrored: bool
) -> Iterator[Placement]:
    """Enumerate the placements of a grid on the plane of this index that agree with the board's ends.

    The ends are given by the directions of the grid's sides; absent sides are unknown. The plane may be seen
    from behind if `mirrored`.
    """
    last = plane.cols - 1, plane.rows - 1
    cols, rows = grid.shape
    for matrix in (*TURNS, *(_MIRRORED if mirrored else ())):
        corner = [a * (cols - 1) + b * (rows - 1) for a, b in matrix]  # the grid's, opposite to (0, 0)
        size = abs(corner[0]), abs(corner[1])
        for start in product(*(range(most - long + 1) for most, long in zip(last, size, strict=True))):
            stop = start[0] + size[0], start[1] + size[1]
            if _allowed(matrix, start, stop, last, ends):
                yield Placement(index, matrix, (start[0] - min(corner[0], 0), start[1] - min(corner[1], 0)))


def _allowed(
    matrix: Matrix,
    start: tuple[int, ...],
    stop: tuple[int, ...],
    last: tuple[int, int],
    ends: Mapping[tuple[int, int], End],
) -> bool:
    """Whether a grid's sides lie at the ends of the plane, 0 and `last`, exactly where the board ends."""
    for direction, end in ends.items():
        if end not in (End.BOARD, End.PATTERN, End.CUT):
            continue
        outwards = [a * direction[0] + b * direction[1] for a, b in matrix]
        axis = 0 if outwards[0] else 1
        at_end = start[axis] == 0 if outwards[axis] < 0 else stop[axis] == last[axis]
        if at_end != (end is End.BOARD):
            return False
    return True


def trimmed(grid: Grid, planes: Sequence[Plane]) -> Grid:
    """Remove outer lines with few vertices from a grid that is too large for every plane.

    The grid stays as it is if it fits, or if removing such lines does not make it fit.
    """
    left = grid
    few = _FEW if len(planes) == 1 else _FEW_AT_FOLDS
    while True:
        if any(fits(left.shape, (plane.cols, plane.rows)) for plane in planes):
            return left
        shares = [float(left.seen[side].mean()) for side in _SIDES]
        if min(shares) > few or min(left.shape) <= 3:
            return grid
        pixels = left.pixels.copy()
        pixels[_SIDES[shares.index(min(shares))]] = np.nan
        # This removes the line, and lines beside it that are empty now.
        seen = np.isfinite(pixels[..., 0])
        (top, bottom), (west, east) = (np.flatnonzero(seen.any(axis=k))[[0, -1]] for k in (1, 0))
        left = Grid(pixels[top : bottom + 1, west : east + 1], int(left.dark + top + west) % 2)


class NoBoardError(NeurocalError):
    """The image does not show the board, or not enough of it to locate its points.

    `shown` is the number (cols, rows) of inner vertices of the board that the image shows instead.
    """

    def __init__(self, message: str, shown: tuple[int, int] | None = None) -> None:
        super().__init__(message)
        self.shown = shown


def wrong_size(board: Board, grid: Grid, ends: Mapping[tuple[int, int], End]) -> NoBoardError:
    """Make the error about a grid that does not fit on the board."""
    wanted = _sizes(board)
    shape = _in_order(seen_size(grid, ends), board)
    if len(board.planes) == 1:
        plane = board.planes[0]
        if sorted(shape) == sorted((plane.cols, plane.rows)) and End.PATTERN in ends.values():
            return NoBoardError(
                f"the pattern continues beyond {wanted} inner vertices; give the size of the whole board"
            )
    if grid.seen.mean() < _WHOLE:
        return NoBoardError(
            f"detected no board of {wanted} inner vertices, only parts of a pattern of {size_names([shape])}"
            "; show the whole board, sharp and evenly lit",
            shape,
        )
    may_be_a_part = len(board.planes) == 1 and fits(shape, (board.planes[0].cols, board.planes[0].rows))
    have = "board has" if len(board.planes) == 1 else "planes of the board have"
    return NoBoardError(
        f"detected {size_names([shape])} inner vertices, but the {have} {wanted}; give the size of the board "
        f"in the image{', or show all of it' if may_be_a_part else ''}",
        shape,
    )


def ambiguous(board: Board, grids: Sequence[Grid], rms: float) -> NoBoardError:
    """Make the error about grids with several possible arrangements, the best with an rms error [px]."""
    sizes = [sorted((plane.cols, plane.rows)) for plane in board.planes]
    part = next((grid for grid in grids if sorted(grid.shape) not in sizes), None)
    if part is not None:
        shape = _in_order(part.shape, board)
        return NoBoardError(
            f"detected {size_names([shape])} of {_sizes(board)} inner vertices, but it is ambiguous "
            "which ones; show its outer border on more sides, or correct the size if this is all of it",
            shape,
        )
    if len(grids) < len(board.planes):
        return NoBoardError(
            f"only {len(grids)} of the {len(board.planes)} planes detected, so their position is ambiguous; "
            "show more of them"
        )
    return NoBoardError(
        f"the planes fit the board in more than one way, to {rms:.2g} px; check the board's origins and "
        "axes, or take the image from nearer"
    )


def fits(shape: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether a grid of this shape may be a part of a board of a size."""
    (short, long), (narrow, wide) = sorted(shape), sorted(size)
    return short <= narrow and long <= wide


def _in_order(shape: tuple[int, int], board: Board) -> tuple[int, int]:
    """Columns and rows of a grid in the order of a board of one plane."""
    if len(board.planes) == 1 and (shape[0] < shape[1]) != (board.planes[0].cols < board.planes[0].rows):
        return shape[1], shape[0]
    return shape


def _sizes(board: Board) -> str:
    return size_names((plane.cols, plane.rows) for plane in board.planes)


def size_names(sizes: Iterable[tuple[int, int]]) -> str:
    """Columns and rows of boards, such as 9 x 6 and 8 x 6."""
    *names, last = (f"{cols} x {rows}" for cols, rows in sizes)
    return f"{', '.join(names)} and {last}" if names else last

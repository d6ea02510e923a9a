"""Whether the board ends at a side of a grid, or its pattern goes on.

Beyond the outer vertices lies one more ring of squares. Where the board ends, what lies beyond the
ring is the same behind its dark squares as behind its light ones, and it begins where the next
vertices would be: something in front of the board or the image's border cut it elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.grid import Grid
from neurocal_cli.geometry import Array

__all__ = ["DIRECTIONS", "End", "board_ends"]

# Sides of a grid by the direction (c, r) that leads out of it.
DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))

_STEPS = np.arange(0.60, 1.41, 0.05)  # squares outwards from the outer vertices
_RING, _BEYOND = _STEPS < 0.76, _STEPS > 1.19
_ACROSS = np.array([0.3, 0.5, 0.7])  # of a square's width
_SAME, _DIFFERENT = 0.35, 0.6  # of the contrast between a dark and a light square
_AT_THE_LINE = 0.12  # squares; a cut this near the outer line of the pattern is its end
_SHARE = 0.75  # of the squares along a side that must agree
_FEWEST = 2  # squares of a side that can be judged


class End(Enum):
    """What is known of a side of a grid."""

    BOARD = "the board ends there"
    PATTERN = "the pattern goes on"
    UNKNOWN = "hidden, blurred or outside the image"


@dataclass(frozen=True, eq=False)
class _Side:
    """Profiles across the end of a grid, one for each square along it; 0 is dark and 1 light.

    Attributes
    ----------
    light : (N,) bool array
        Whether the ring's square is light.
    profile : (N, steps) array
        NaN where it leaves the image or the vertices are missing.
    """

    light: NDArray[np.bool_]
    profile: Array


def board_ends(grey: NDArray[np.generic], grid: Grid) -> dict[tuple[int, int], End]:
    """Tell for each side of a grid, named by its direction, whether the board ends there.

    Parameters
    ----------
    grey : (height, width) array
    grid : Grid
    """
    return {direction: _judge(_side(grey, grid, direction)) for direction in DIRECTIONS}


def _judge(side: _Side) -> End:
    ring = side.profile[:, _RING].mean(axis=1)
    beyond = side.profile[:, _BEYOND].mean(axis=1)
    with np.errstate(invalid="ignore"):
        valid = np.abs(ring - side.light) < _SAME
    if valid.sum() < max(_FEWEST, 0.6 * len(valid)):
        return End.UNKNOWN
    ring, beyond, light = ring[valid], beyond[valid], side.light[valid]
    if light.all() or not light.any():
        return End.UNKNOWN
    turns = np.abs(beyond - ring) > _SAME
    at_line = np.abs(_crossings(side.profile[valid], ring, beyond) - 1) < _AT_THE_LINE
    step = float(np.median(beyond[~light]) - np.median(beyond[light]))
    if step > _DIFFERENT and (turns & at_line).mean() >= _SHARE:
        return End.PATTERN
    if abs(step) < _SAME and turns.sum() >= _FEWEST and at_line[turns].mean() >= _SHARE:
        return End.BOARD
    return End.UNKNOWN


def _crossings(profile: Array, ring: Array, beyond: Array) -> Array:
    """Where each profile is halfway between its ends [squares]; meaningless where those are equal."""
    rise = np.where(beyond > ring, 1.0, -1.0)[:, None]
    height = rise * (profile - 0.5 * (ring + beyond)[:, None])
    above = height[:, 1:] > 0
    k = np.argmax(above, axis=1)  # the first step that is past the middle
    rows = np.arange(len(k))
    low, high = height[rows, k], height[rows, k + 1]
    share = np.clip(-low / np.where(high == low, 1.0, high - low), 0.0, 1.0)
    return _STEPS[k] + share * (_STEPS[k + 1] - _STEPS[k])


def _side(grey: NDArray[np.generic], grid: Grid, direction: tuple[int, int]) -> _Side:
    """Profiles across one side, from the ring's squares outwards."""
    # Rows of vertices parallel to the side, the outermost first; vertices along it in image order.
    rows = grid.pixels.transpose(1, 0, 2) if direction[0] else grid.pixels
    rows = rows[::-1] if max(direction) > 0 else rows
    along = np.arange(rows.shape[1] - 1)
    outer = -1 if min(direction) < 0 else (grid.shape[0] if direction[0] else grid.shape[1]) - 1
    light = (along + outer + grid.dark) % 2 == 1  # a square's colour is that of its first vertex
    inner = _between(rows[0] + 0.5 * (rows[1] - rows[0]), np.array([0.5]))  # centres of the squares inside
    level = _sample(grey, inner)[:, 0]
    padded = np.concatenate([[np.nan], level, [np.nan]])
    neighbours = np.stack([padded[:-2], padded[2:]])
    known = np.isfinite(neighbours)
    with np.errstate(invalid="ignore"):
        same = np.where(known, neighbours, 0).sum(axis=0) / known.sum(axis=0)  # of the ring's colour
        contrast = np.where(light, same - level, level - same)
        dark = np.where(light, level, same)
        contrast = np.where(contrast > 0, contrast, np.nan)
    outwards = _beyond(rows)
    places = np.stack([_between(line, _ACROSS) for line in outwards], axis=1)  # (N, steps, across, 2)
    values = _sample(grey, places).mean(axis=-1)
    return _Side(light, (values - dark[:, None]) / contrast[:, None])


def _beyond(rows: Array) -> Array:
    """Points beyond the outer row at ``_STEPS``, by a parabola through three rows or a line through two."""
    t = -_STEPS[:, None, None]
    line = rows[0] + t * (rows[1] - rows[0])
    if len(rows) < 3:
        return line
    bend = 0.5 * t * (t - 1) * (rows[2] - 2 * rows[1] + rows[0])
    return line + np.where(np.isfinite(bend), bend, 0.0)


def _between(line: Array, shares: Array) -> Array:
    """Points between neighbours on a line; (N - 1, shares, 2) array."""
    return line[:-1, None] + shares[:, None] * (line[1:, None] - line[:-1, None])


def _sample(grey: NDArray[np.generic], places: Array) -> Array:
    """Image between its pixels, linearly; NaN outside."""
    height, width = grey.shape
    if height < 2 or width < 2:
        return np.full(places.shape[:-1], np.nan)
    u, v = places[..., 0], places[..., 1]
    with np.errstate(invalid="ignore"):
        inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    i = np.minimum(u.astype(np.intp), width - 2)
    j = np.minimum(v.astype(np.intp), height - 2)
    a, b = u - i, v - j
    corners = [grey[j + dj, i + di].astype(float) for dj in (0, 1) for di in (0, 1)]
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    return np.where(inside, sum(w * c for w, c in zip(weights, corners, strict=True)), np.nan)

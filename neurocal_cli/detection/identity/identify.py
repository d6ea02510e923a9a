"""Which point of which board each vertex of a grid is.

The rules, in this order:

1. A grid lies on a plane of its size; one that is partly hidden lies where the ends of the board
   that can be seen leave it one place only.
2. Planes that are not in one plane must fit one camera, and that tells how each of them lies. A
   board in one plane is seen from the side on which its axes turn as u and v do.
3. What geometry leaves open, colours decide: the square at vertex (0, 0) is dark, on the first
   plane that tells; for one board that is the corner where OpenCV's `findChessboardCorners` begins.
4. What looks the same in colours too is settled by the image: of two ways, the one whose x axis
   leads right or down; of four, the one whose x axis leads right. That turns when the board does,
   so the user is warned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.board import Board, Plane
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.identity.ends import End, board_ends
from neurocal_cli.detection.identity.fit import fit_camera, is_flat, motion
from neurocal_cli.detection.identity.placement import Placement, placements
from neurocal_cli.detection.identity.trim import trimmed
from neurocal_cli.detection.identity.words import LOOKS_THE_SAME, NoBoardError, another_size, several_ways
from neurocal_cli.detection.medians import median
from neurocal_cli.geometry import Array

__all__ = ["Identified", "Located", "NoBoardError", "identify"]

_CLEARLY = 3.0  # how many times worse than the best an arrangement must fit to be ruled out
_NOISE = 0.05  # px; errors below this do not rule anything out
_MISFIT = 0.25  # squares by which planes may miss where the board says they are: distortion, a bent board
_SAMPLES = 25  # vertices of a grid that are enough to tell how it lies
_NEARER = 1.5  # how many times larger the squares of the board before the others of its size must look
_MOST_WAYS = 5000  # arrangements that are tried; small pieces of large planes have more
_KEPT = 200  # arrangements that are followed up when a further grid joins


@dataclass(frozen=True, eq=False)
class Located:
    """A grid and where it lies on the board.

    Attributes
    ----------
    grid : Grid
    plane : Plane
    placement : Placement
    """

    grid: Grid
    plane: Plane
    placement: Placement


@dataclass(frozen=True, eq=False)
class Identified:
    """The grids of an image that belong to the board.

    Attributes
    ----------
    located : tuple of Located
        In the order of the board's planes.
    warnings : tuple of str
        The same texts in all images of a board that they concern.
    """

    located: tuple[Located, ...]
    warnings: tuple[str, ...] = ()


def identify(board: Board, grids: Sequence[Grid], grey: NDArray[np.generic]) -> Identified:
    """Find out where on the board the grids of one image lie.

    Parameters
    ----------
    board : Board
    grids : sequence of Grid
        What was found in the image, also what does not belong to the board.
    grey : (height, width) array
        The image: it tells whether the board ends where a grid does.

    Raises
    ------
    NoBoardError
        With the reason: no board, a board of another size, several ways to lay it that cannot be
        told apart.
    """
    if not grids:
        raise NoBoardError("no board detected; show the whole board, sharp and evenly lit")
    chosen = _candidates(board, grids, grey)
    whole = [candidate for candidate in chosen if candidate.whole]
    try:
        kept, warnings = _settled(board, chosen, _consistent(board, chosen))
    except NoBoardError:
        if len(whole) in (0, len(chosen)):
            raise
        chosen = whole  # the others are no part of the board, or too small a part of it
        kept, warnings = _settled(board, chosen, _consistent(board, chosen))
    located = [Located(c.grid, board.planes[p.plane], p) for c, p in zip(chosen, kept, strict=True)]
    return Identified(tuple(sorted(located, key=lambda one: one.placement.plane)), warnings)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A grid and all the ways it may lie on the board."""

    grid: Grid
    ways: tuple[Placement, ...]
    whole: bool  # whether it has the full size of a plane
    ends: Mapping[tuple[int, int], End]


@dataclass(frozen=True)
class _Way:
    """One way for all grids to lie on the board, and how badly one camera sees them so [px]."""

    placements: tuple[Placement, ...]
    rms: float = 0.0


def _candidates(board: Board, grids: Sequence[Grid], grey: NDArray[np.generic]) -> list[_Candidate]:
    """Grids that can lie on the board, whole planes first; at most one for each plane."""
    every = [_candidate(board, trimmed(grid, board.planes), grey) for grid in grids]
    usable = sorted((c for c in every if c.ways), key=lambda c: (-c.whole, -int(c.grid.seen.sum())))
    largest = max(every, key=lambda c: int(c.grid.seen.sum()))
    if len(board.planes) == 1:
        others = [c for c in every if not c.ways]
        usable = [c for c in usable if not any(_may_be_a_piece(c, other) for other in others)]
    if not usable:
        raise NoBoardError(another_size(board, largest.grid, list(largest.ends.values())))
    return (_foremost(board, usable) + [c for c in usable if not c.whole])[: len(board.planes)]


def _may_be_a_piece(candidate: _Candidate, other: _Candidate) -> bool:
    """Whether a grid may be a piece of a board of another size that a larger grid shows."""
    ends_seen = candidate.whole and set(candidate.ends.values()) == {End.BOARD}
    smaller = candidate.grid.seen.sum() < other.grid.seen.sum()
    behind = _square(candidate.grid) >= _NEARER * _square(other.grid)
    return bool(smaller and not ends_seen and not behind)


def _foremost(board: Board, candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Whole planes, of each size as many as the board has: the nearest, where there is no doubt.

    A board on a screen behind, or mirrored in a window, looks much smaller than the one that is held
    before the camera.
    """
    kept: list[_Candidate] = []
    for size in sorted({tuple(sorted((plane.cols, plane.rows))) for plane in board.planes}):
        room = sum(tuple(sorted((plane.cols, plane.rows))) == size for plane in board.planes)
        alike = [c for c in candidates if c.whole and tuple(sorted(c.grid.shape)) == size]
        if len(alike) > 1:
            alike.sort(key=lambda c: -_square(c.grid))
        if len(alike) > room and _square(alike[room - 1].grid) < _NEARER * _square(alike[room].grid):
            raise NoBoardError(
                f"{len(alike)} boards of {size[1]} x {size[0]} inner vertices are detected; show only one of "
                "them"
            )
        kept += alike[:room]
    return sorted(kept, key=lambda c: -int(c.grid.seen.sum()))


def _candidate(board: Board, grid: Grid, grey: NDArray[np.generic]) -> _Candidate:
    alone = len(board.planes) == 1
    whole = any(sorted(grid.shape) == sorted((plane.cols, plane.rows)) for plane in board.planes)
    ends = board_ends(grey, grid) if alone or not whole else {}
    if not alone:  # across a fold lies another plane's pattern
        ends = {direction: end for direction, end in ends.items() if end is End.BOARD}
    ways = [
        way
        for index, plane in enumerate(board.planes)
        if not whole or sorted(grid.shape) == sorted((plane.cols, plane.rows))
        for way in placements(grid, plane, index, ends, mirrored=not alone)
    ]
    if alone and (board.planes[0].cols + board.planes[0].rows) % 2 == 1:
        ways = [way for way in ways if way.first_square_is_dark(grid.dark)]
    return _Candidate(grid, tuple(ways), whole, ends)


def _consistent(board: Board, chosen: Sequence[_Candidate]) -> list[_Way]:
    """Ways for all grids together that one camera can see, the best one first."""
    if len(board.planes) == 1:
        return [_Way((placement,)) for placement in chosen[0].ways]
    flat = is_flat(np.concatenate([_corners(plane) for plane in board.planes]))
    front = board.planes[0].normal if flat else None
    ways, before = [_Way(())], 0.0
    for count, candidate in enumerate(chosen, start=1):
        longer = [
            (*way.placements, placement)
            for way in ways
            for placement in candidate.ways
            if placement.plane not in {p.plane for p in way.placements}
        ]
        if len(longer) > _MOST_WAYS:
            raise NoBoardError(several_ways(board, [c.grid for c in chosen], 0.0))
        ways = [_scored(board, chosen[:count], placements, front) for placements in longer]
        ways = sorted((way for way in ways if np.isfinite(way.rms)), key=lambda way: way.rms)
        if not ways:
            raise NoBoardError(
                "the detected grids do not match the planes of the board; check the board file"
            )
        if not candidate.whole and count > 2 and ways[0].rms > _CLEARLY * max(before, _NOISE):
            raise NoBoardError("a detected grid matches no plane of the board; hide other patterns")
        before = ways[0].rms
        # What is bad with two planes may become the best with three, but not what is hopeless.
        limit = (_CLEARLY if count == len(chosen) else _CLEARLY**2) * max(ways[0].rms, _NOISE)
        ways = [way for way in ways if way.rms <= limit][: None if count == len(chosen) else _KEPT]
    if len(chosen) > 1 and ways[0].rms > _MISFIT * min(_square(c.grid) for c in chosen):
        raise NoBoardError(
            f"the planes are {ways[0].rms:.3g} px off their places on the board; check its origins and axes"
        )
    return ways


def _scored(
    board: Board, chosen: Sequence[_Candidate], way: tuple[Placement, ...], front: Array | None
) -> _Way:
    world, pixels = [], []
    for candidate, placement in zip(chosen, way, strict=True):
        rows, columns = np.nonzero(candidate.grid.seen)
        some = np.unique(np.linspace(0, len(rows) - 1, _SAMPLES).astype(np.intp))
        index = np.stack([columns[some], rows[some]], axis=-1)
        world.append(board.planes[placement.plane].at(placement.apply(index)))
        pixels.append(candidate.grid.pixels[rows[some], columns[some]])
    fit = fit_camera(np.concatenate(world), np.concatenate(pixels), front)
    if fit.handed < 0:
        return _Way(way, np.inf)
    return _Way(way, fit.rms if len(chosen) > 1 else 0.0)  # a plane alone fits however it is bent


def _settled(
    board: Board, chosen: Sequence[_Candidate], ways: Sequence[_Way]
) -> tuple[tuple[Placement, ...], tuple[str, ...]]:
    """Choose among ways that geometry cannot tell apart: by colours, then by the image."""
    grids = [candidate.grid for candidate in chosen]
    if not all(_same_board(board, grids, ways[0], way) for way in ways[1:]):
        raise NoBoardError(several_ways(board, grids, ways[0].rms))
    colours = [_colours(grids, way) for way in ways]
    left = [way for way, colour in zip(ways, colours, strict=True) if colour == max(colours)]
    if len(left) == 1:
        return left[0].placements, ()
    # A tie lies at 45 degrees to an axis of the board, where boards are seldom held.
    towards = np.array([1.0, 1.0]) if len(left) == 2 else np.array([1.0, 0.0])

    def leading(way: _Way) -> tuple[float, float]:
        first, grid = min(zip(way.placements, grids, strict=True), key=lambda pair: pair[0].plane)
        return round(float(first.axis(grid) @ towards), 6), -float(np.nanmean(grid.pixels))

    return max(left, key=leading).placements, (LOOKS_THE_SAME,)


def _colours(grids: Sequence[Grid], way: _Way) -> tuple[bool, ...]:
    """Whether the square at vertex (0, 0) is dark, plane by plane in the board's order."""
    pairs = sorted(zip(way.placements, grids, strict=True), key=lambda pair: pair[0].plane)
    return tuple(placement.first_square_is_dark(grid.dark) for placement, grid in pairs)


def _same_board(board: Board, grids: Sequence[Grid], first: _Way, second: _Way) -> bool:
    """Whether two ways differ by a motion that takes the whole board onto itself."""
    world: list[list[Array]] = [[], []]
    for points, way in zip(world, (first, second), strict=True):
        for grid, placement in zip(grids, way.placements, strict=True):
            c, r = grid.shape[0] - 1, grid.shape[1] - 1
            box = placement.apply([[0, 0], [c, 0], [0, r], [c, r]])
            points.append(board.planes[placement.plane].at(box))
    moved = motion(np.concatenate(world[0]), np.concatenate(world[1]))
    if moved is None:
        return False
    R, t = moved
    boxes = [_corners(plane) for plane in board.planes]
    near = 1e-3 * min(plane.square for plane in board.planes)

    def covers(box: Array, other: Array) -> bool:
        distances = np.linalg.norm((box @ R.T + t)[:, None] - other, axis=2)
        return bool((distances.min(axis=1) < near).all())

    return all(any(covers(box, other) for other in boxes) for box in boxes)


def _corners(plane: Plane) -> Array:
    c, r = plane.cols - 1, plane.rows - 1
    return plane.at([[0, 0], [c, 0], [0, r], [c, r]])


def _square(grid: Grid) -> float:
    """Typical side of a square [px]."""
    p = grid.pixels
    return min(median(np.hypot(way[..., 0], way[..., 1])) for way in (p[1:] - p[:-1], p[:, 1:] - p[:, :-1]))

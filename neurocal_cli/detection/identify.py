"""Identify the vertices of grids with those of the board.

The criteria, in this order:

1. A grid is placed on a plane of its size. A partly hidden grid must show enough ends of the board that only
   one place is left.
2. Planes at an angle must fit one camera, which determines the orientation of each. A board in one plane is
   seen from the side from which its axes have the handedness of u and v.
3. Among the remaining arrangements, the square at vertex (0, 0) is dark on the first plane where they
   differ. For a single board, this is the corner at which OpenCV's `findChessboardCorners` begins.
4. Arrangements with equal colours are distinguished by the image: of two, the one whose x axis points
   right or down; of four, the one whose x axis points right. The choice changes if the board is turned, so
   the user is warned.

The camera is projective, and fitted by the direct linear transform (`fit_camera`). Distortion is not
modelled: its few pixels are small compared with the errors of wrong arrangements, which are whole squares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_similarity, similarity
from neurocal_cli.detection.circles.lattice import PlacedCircles
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.markers.ink import Ink
from neurocal_cli.detection.placement import (
    NEARER,
    ONE_BOARD,
    SYMMETRIC_BOARD,
    End,
    NoBoardError,
    Placement,
    ambiguous,
    board_ends,
    placements,
    trimmed,
    wrong_size,
)
from neurocal_cli.observations.board import Board, Plane, is_flat

_ROUNDING = 1e-6  # greatest error of a motion that maps the board onto itself, relative to its extent
_WEAK = 3.0  # perspective counts as visible if an affine camera fits worse by this factor

# test_identity.py accepts and refuses rendered boards with these limits.
_CLEARLY = 3.0  # ratio to the best rms error above which an arrangement is excluded
_NOISE = 0.05  # px; least rms error in this ratio
_MISFIT = 0.25  # squares; greatest rms error of the best arrangement, for distortion and uneven boards
_SAMPLES = 25  # vertices of a grid used in these tests
_MOST_TRIED = 5000  # limits the time; small pieces of large planes have more arrangements
_KEPT = 200  # best arrangements that are extended by a further grid; limits the time


@frozen_dataclass(eq=False)
class Located:
    """A grid and its place on the board."""

    grid: Grid
    plane: Plane
    placement: Placement
    ink: Ink | None = None  # the markers on it
    circles: PlacedCircles | None = None  # if it is a grid of these


@frozen_dataclass(eq=False)
class Identified:
    """The grids of an image that belong to the board, in the order of its planes."""

    located: tuple[Located, ...]
    warnings: tuple[str, ...] = ()  # their texts do not depend on the image
    notes: tuple[str, ...] = ()  # what the image told of the board; the same


def identify(board: Board, grids: Sequence[Grid], grey: NDArray[np.generic]) -> Identified:
    """Locate the grids of one grey image on the board.

    The grids are all that were found, including those that do not belong to the board. Raises NoBoardError if
    there is no board, a board of another size, or more than one possible arrangement; the message says which.
    """
    if not grids:
        if all(min(plane.cols, plane.rows) < 3 for plane in board.planes):
            raise NoBoardError("boards of fewer than 3 x 3 inner vertices are not detected; use a larger one")
        raise NoBoardError("no board detected; show the whole board, sharp and evenly lit")
    chosen = _candidates(board, grids, grey)
    whole = [candidate for candidate in chosen if candidate.whole]
    try:
        kept, warnings = _resolve_symmetry(board, chosen, _consistent(board, chosen))
    except NoBoardError:
        if len(whole) in (0, len(chosen)):
            raise
        chosen = whole  # the others do not belong to the board, or are too small a part of it
        kept, warnings = _resolve_symmetry(board, chosen, _consistent(board, chosen))
    located = [Located(c.grid, board.planes[p.plane], p) for c, p in zip(chosen, kept, strict=True)]
    return Identified(tuple(sorted(located, key=lambda one: one.placement.plane)), warnings)


@frozen_dataclass(eq=False)
class _Candidate:
    """A grid and all its possible placements on the board."""

    grid: Grid
    placements: tuple[Placement, ...]
    whole: bool  # whether it has the full size of a plane
    ends: Mapping[tuple[int, int], End]


@frozen_dataclass
class _Arrangement:
    """One placement for each grid, and the rms error of a common camera [px]."""

    placements: tuple[Placement, ...]
    rms: float = 0.0


def _candidates(board: Board, grids: Sequence[Grid], grey: NDArray[np.generic]) -> list[_Candidate]:
    """Grids with possible placements, whole planes first; at most as many as the board has planes."""
    every = [_candidate(board, trimmed(grid, board.planes), grey) for grid in grids]
    usable = sorted((c for c in every if c.placements), key=lambda c: (-c.whole, -int(c.grid.seen.sum())))
    largest = max(every, key=lambda c: int(c.grid.seen.sum()))
    if len(board.planes) == 1:
        others = [c for c in every if not c.placements]
        usable = [c for c in usable if not any(_may_be_a_piece(c, other) for other in others)]
    if not usable:
        raise wrong_size(board, largest.grid, largest.ends)
    return (_foremost(board, usable) + [c for c in usable if not c.whole])[: len(board.planes)]


def _candidate(board: Board, grid: Grid, grey: NDArray[np.generic]) -> _Candidate:
    """Find the placements of a grid that its size, the board's ends and its colours allow."""
    alone = len(board.planes) == 1
    alike = [
        k for k, plane in enumerate(board.planes) if sorted(grid.shape) == sorted((plane.cols, plane.rows))
    ]
    ends = board_ends(grey, grid) if alone or not alike else {}
    if not alone:  # the pattern of another plane continues beyond a fold
        ends = {direction: end for direction, end in ends.items() if end is End.BOARD}
    elif not alike and set(ends.values()) <= {End.BOARD, End.STOPS}:
        return _Candidate(grid, (), False, ends)  # this is all of another board, or a lit part of the board
    possible = [
        placement
        for k in alike or range(len(board.planes))
        for placement in placements(grid, board.planes[k], k, ends, mirrored=not alone)
    ]
    if alone and (board.planes[0].cols + board.planes[0].rows) % 2 == 1:
        possible = [placement for placement in possible if placement.first_square_is_dark(grid.dark)]
    return _Candidate(grid, tuple(possible), bool(alike), ends)


def _may_be_a_piece(candidate: _Candidate, other: _Candidate) -> bool:
    """Whether a grid may be a piece of a larger grid's board, which has another size."""
    ends_seen = candidate.whole and set(candidate.ends.values()) == {End.BOARD}
    smaller = candidate.grid.seen.sum() < other.grid.seen.sum()
    behind = candidate.grid.square >= NEARER * other.grid.square
    return bool(smaller and not ends_seen and not behind)


def _foremost(board: Board, candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Choose whole planes: of each size as many as the board has, the nearest if they are clearly nearer.

    A board on a screen in the background, or mirrored in a window, appears much smaller than the board in
    front of the camera.
    """
    kept: list[_Candidate] = []
    sizes = [tuple(sorted((plane.cols, plane.rows))) for plane in board.planes]
    for size in sorted(set(sizes)):
        room = sizes.count(size)
        alike = [c for c in candidates if c.whole and tuple(sorted(c.grid.shape)) == size]
        alike.sort(key=lambda c: -c.grid.square)
        if len(alike) > room and alike[room - 1].grid.square < NEARER * alike[room].grid.square:
            raise NoBoardError(
                f"{len(alike)} boards of {size[1]} x {size[0]} inner vertices are detected; {ONE_BOARD}"
            )
        kept += alike[:room]
    return sorted(kept, key=lambda c: -int(c.grid.seen.sum()))


def _consistent(board: Board, chosen: Sequence[_Candidate]) -> list[_Arrangement]:
    """Arrangements of all grids that fit one camera, the best first."""
    if len(board.planes) == 1:
        return [_Arrangement((placement,)) for placement in chosen[0].placements]
    flat = is_flat(np.concatenate([_corners(plane) for plane in board.planes]))
    front = board.planes[0].normal if flat else None
    found, before = [_Arrangement(())], 0.0
    for count, candidate in enumerate(chosen, start=1):
        longer = [
            (*one.placements, placement)
            for one in found
            for placement in candidate.placements
            if placement.plane not in {p.plane for p in one.placements}
        ]
        if len(longer) > _MOST_TRIED:
            raise ambiguous(board, [c.grid for c in chosen], 0.0)
        found = [_scored(board, chosen[:count], placements, front) for placements in longer]
        found = sorted((one for one in found if np.isfinite(one.rms)), key=lambda one: one.rms)
        if not found:
            raise NoBoardError(
                "the detected grids do not match the planes of the board; check the board file"
            )
        if not candidate.whole and count > 2 and found[0].rms > _CLEARLY * max(before, _NOISE):
            raise NoBoardError("a detected grid matches no plane of the board; hide other patterns")
        before = found[0].rms
        # An arrangement that is poor with two planes may be the best with three.
        limit = (_CLEARLY if count == len(chosen) else _CLEARLY**2) * max(found[0].rms, _NOISE)
        found = [one for one in found if one.rms <= limit][: None if count == len(chosen) else _KEPT]
    if len(chosen) > 1 and found[0].rms > _MISFIT * min(c.grid.square for c in chosen):
        raise NoBoardError(
            f"the planes are {found[0].rms:.3g} px off their places on the board; check its origins and axes"
        )
    return found


def _scored(
    board: Board, chosen: Sequence[_Candidate], arrangement: tuple[Placement, ...], front: Array | None
) -> _Arrangement:
    """Fit a camera to some vertices of all grids; the error is infinite for a mirror image."""
    world, pixels = [], []
    for candidate, placement in zip(chosen, arrangement, strict=True):
        rows, columns = np.nonzero(candidate.grid.seen)
        some = np.unique(np.linspace(0, len(rows) - 1, _SAMPLES).astype(np.intp))
        index = np.stack([columns[some], rows[some]], axis=-1)
        world.append(board.planes[placement.plane].at(placement.apply(index)))
        pixels.append(candidate.grid.pixels[rows[some], columns[some]])
    fit = fit_camera(np.concatenate(world), np.concatenate(pixels), front)
    if fit.handed < 0:
        return _Arrangement(arrangement, np.inf)
    return _Arrangement(arrangement, fit.rms if len(chosen) > 1 else 0.0)  # a single plane fits any curvature


def _resolve_symmetry(
    board: Board, chosen: Sequence[_Candidate], arrangements: Sequence[_Arrangement]
) -> tuple[tuple[Placement, ...], tuple[str, ...]]:
    """Choose among arrangements with equal geometry: by colours, then by the image."""
    grids = [candidate.grid for candidate in chosen]
    if not all(_same_board(board, grids, arrangements[0], one) for one in arrangements[1:]):
        raise ambiguous(board, grids, arrangements[0].rms)
    colours = [_colours(grids, one) for one in arrangements]
    left = [one for one, colour in zip(arrangements, colours, strict=True) if colour == max(colours)]
    if len(left) == 1:
        return left[0].placements, ()
    # Ties occur at 45 degrees to the axes of the image, an unusual pose.
    towards = np.array([1.0, 1.0]) if len(left) == 2 else np.array([1.0, 0.0])

    def leading(arrangement: _Arrangement) -> tuple[float, float]:
        first, grid = min(zip(arrangement.placements, grids, strict=True), key=lambda pair: pair[0].plane)
        return round(float(first.axis(grid) @ towards), 6), -float(np.nanmean(grid.pixels))

    return max(left, key=leading).placements, (SYMMETRIC_BOARD,)


def _colours(grids: Sequence[Grid], arrangement: _Arrangement) -> tuple[bool, ...]:
    """Whether the square at vertex (0, 0) is dark, for each plane in the board's order."""
    pairs = sorted(zip(arrangement.placements, grids, strict=True), key=lambda pair: pair[0].plane)
    return tuple(placement.first_square_is_dark(grid.dark) for placement, grid in pairs)


def _same_board(board: Board, grids: Sequence[Grid], first: _Arrangement, second: _Arrangement) -> bool:
    """Whether two arrangements differ by a motion that maps the whole board onto itself."""

    def outline(arrangement: _Arrangement) -> Array:
        pairs = zip(grids, arrangement.placements, strict=True)
        return np.concatenate([board.planes[p.plane].at(p.apply(_box(*grid.shape))) for grid, p in pairs])

    moved = rigid_motion(outline(first), outline(second))
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
    return plane.at(_box(plane.cols, plane.rows))


def _box(cols: int, rows: int) -> list[list[int]]:
    """The four outermost vertices (c, r)."""
    return [[c, r] for r in (0, rows - 1) for c in (0, cols - 1)]


def rigid_motion(first: Array, second: Array) -> tuple[Array, Array] | None:
    """R and t with ``second = first R^T + t`` for points (N, 3), R a rotation; None if no motion fits."""
    _, R, t = nearest_similarity(first, second)
    misses = np.abs(first @ R.T + t - second).max()
    return (R, t) if misses <= _ROUNDING * max(float(np.ptp(first)), 1e-300) else None


@frozen_dataclass
class CameraFit:
    """A projective camera fitted to points."""

    rms: float  # [px]
    # 1 for a camera, -1 for a mirror image, 0 if undetermined because of too little perspective or because
    # all points lie in one plane
    handed: int


def fit_camera(world: Array, pixels: Array, front: Array | None = None) -> CameraFit:
    """Fit a camera to world points (N, 3) and pixels (N, 2) by the direct linear transform.

    `front` (3,) is, for points in one plane, its normal that must point away from the camera.
    """
    flat = is_flat(world)
    points = _plane_coordinates(world, front) if flat else world
    P, rms = _linear_camera(points, pixels)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    depth = homogeneous @ P[2]
    if not np.isfinite(rms) or depth.min() < 0 < depth.max():
        return CameraFit(np.inf, 0)
    if flat:
        undetermined = front is None
    else:
        affine = homogeneous @ np.linalg.lstsq(homogeneous, pixels, rcond=None)[0]
        undetermined = _rms(affine - pixels) < _WEAK * rms
    if undetermined:
        return CameraFit(rms, 0)
    return CameraFit(rms, int(np.sign(depth[0]) * np.sign(np.linalg.det(P[:, :3]))))


def _plane_coordinates(world: Array, front: Array | None) -> Array:
    """Coordinates within the points' plane; with `front`, their axes and `front` are right-handed."""
    centred = world - world.mean(axis=0)
    x, y, normal = np.linalg.svd(centred, full_matrices=False)[2]
    if front is not None and normal @ front * np.linalg.det([x, y, normal]) < 0:
        y = -y
    return centred @ np.array([x, y]).T


def _linear_camera(points: Array, pixels: Array) -> tuple[Array, float]:
    """Projection matrix (3, d + 1) from points (N, d) to pixels, and its rms error [px]."""
    (middle, size), (centre, scale) = similarity(points), similarity(pixels)
    x = np.column_stack([(points - middle) / size, np.ones(len(points))])
    d = (pixels - centre) / scale
    zeros = np.zeros_like(x)
    rows = np.concatenate([np.hstack([x, zeros, -d[:, :1] * x]), np.hstack([zeros, x, -d[:, 1:] * x])])
    P = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, -1)
    P[:2] = scale * P[:2] + centre[:, None] * P[2]
    P[:, :-1] /= size
    P[:, -1] -= P[:, :-1] @ middle
    seen = np.column_stack([points, np.ones(len(points))]) @ P.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error = seen[:, :2] / seen[:, 2:] - pixels
    return P, _rms(error)


def _rms(error: Array) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))

"""Place the markers of an image on the board, and find the vertices around them.

A marker counts if another one agrees with it: one homography takes the corners of both from the board to the
image. So a marker that is read wrongly, or is not on the board, is left out. Of the ways in which a board may
be printed (`Print`), the one with the most such markers is taken.

Vertices are predicted by homographies of the markers around them, and refined to the saddle points of the
brightness. From there, further vertices are predicted by those already found. The image of a wide lens is
mapped to a plane for the homographies.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.finding.saddles import Image, interpolate, refine_saddles
from neurocal_cli.detection.grid import TURNS, Grid, squares_of
from neurocal_cli.detection.markers.reading import Marks
from neurocal_cli.detection.placement import placements
from neurocal_cli.detection.wide_lens import Flattening
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import TagPlane
from neurocal_cli.observations.marked_cells import Cells, Print, marked_cells, pattern_lines, patterns, prints

_NEAR = 4.5  # squares between markers that are compared
_AGREE, _AGREE_PX = 0.03, 0.6  # squares and px; rms error of two markers in one homography
_WITHIN = 0.3  # squares from the middle of a marker; half of the shortest side
_MISPLACED = 0.3  # markers at the places of others, over those at their own
_AROUND = 2.3  # squares; markers that predict a vertex
_REACH = 1.6  # squares between a vertex and the nearest marker or vertex that predicts it
_MOVED, _MOVED_PX = 0.12, 1.2  # squares and px; greatest distance between prediction and saddle point
# Of a cell, and px: where the four colours around a vertex are looked at. Far from it, they may be those of a
# vertex some pixels away.
_BESIDE, _BESIDE_PX = 0.25, 5.0
_UNLIKE = 1.4  # greatest difference of opposite colours over the contrast; 2 at the corner of a lone tag
_LEAST_CONTRAST = 0.3  # relative to that of most vertices
_FEWEST = 4  # vertices
# Vertices that are enough to find one that does not fit those around it, and its distance: squares and px.
_FEWEST_AROUND, _STRAY, _STRAY_PX = 8, 0.04, 0.7
_SAME = 1e-6  # squares
# Of codes that are read together: standard deviations by which their mean correlation is no chance, and the
# least median one, which those of another board do not have. It is 0.8 with cells of 1.5 px.
_SURE, LEAST_AGREEMENT = 6.0, 0.35
_OF_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])  # as in `squares_of`


@frozen_dataclass(eq=False)
class Placed:
    """Markers with their places on the board."""

    marks: Marks
    how: Print
    cells: Cells
    at: NDArray[np.intp]  # (N,) their positions among the cells
    ground: Array  # (N, 4, 2) [squares] their corners on the board
    read: Marks  # also those that do not agree
    unsure: bool = False  # whether as many markers agree in another print


def place(plane: Plane, marks: Marks) -> Placed | None:
    """The markers that agree with others, in the print with the most of them; None if there are not two."""
    best: Placed | None = None
    for how in prints(plane):
        cells = marked_cells(plane, how)
        known = np.isin(marks.number, cells.number)
        some = marks.only(known)
        at = cells.of(some.number)
        ground = plane.spread(cells.corners[at])
        kept = _agreeing(ground, some.corners)
        if len(kept) < 2:
            continue
        if best is None or len(kept) > len(best.at):
            # Of a blurred marker, two outlines may be read.
            best = Placed(some.only(kept), how, cells, at[kept], ground[kept], some)
        elif len(kept) == len(best.at):
            best = replace(best, unsure=True)
        if 2 * len(kept) > len(some) and isinstance(plane, TagPlane):
            break  # a tag agrees with others in one turn only
    return best


def are_misplaced(plane: Plane, placed: Placed, size: tuple[int, int]) -> bool:
    """Whether many markers were read where the board has others, as if its rows had another length.

    Their middles tell that, even where a quadrangle reaches beyond a corner.
    """
    known, pixels = placed.ground.reshape(-1, 2), placed.marks.corners.reshape(-1, 2)
    middle = plane.spread(placed.cells.corners).mean(axis=1)
    start, step = predicted(middle, known, pixels, flattening_of(known, pixels, size))
    off = np.linalg.norm(placed.read.corners.mean(axis=1)[:, None] - start, axis=2)
    nearest = np.nan_to_num(off, nan=np.inf).argmin(axis=1)
    own = nearest == placed.cells.of(placed.read.number)
    side = np.sqrt(np.abs(np.linalg.det(step[nearest])))
    others = ~own & (np.take_along_axis(off, nearest[:, None], axis=1)[:, 0] < _WITHIN * side)
    return bool(others.sum() > _MISPLACED * own.sum())


def read_together(plane: Plane, dictionary: str, grid: Grid, image: Image) -> Marks | None:
    """The markers in the light squares of a grid, by all their codes together; None if these tell no place.

    The light in the cells of the codes is compared with the codes that each place of the grid on the board
    puts there. Small or blurred codes, of which none tells its own number, tell the place of all.
    """
    best: Marks | None = None
    most = 0.0
    for how in prints(plane):
        cells = marked_cells(plane, how)
        light = ~patterns(plane, cells, dictionary, how)[:, 1:-1, 1:-1]
        lines = pattern_lines(plane, dictionary)[1:-1]
        for placement in placements(grid, plane, 0, {}, mirrored=False):
            turn = np.array(placement.matrix)
            middle = (cells.cell + 0.5 - placement.offset) @ turn
            cell = np.floor(middle).astype(np.int64)
            if ((cell.sum(axis=1) + grid.dark) % 2 == 0).any():
                continue
            codes = np.rot90(light, TURNS.index(placement.matrix), axes=(1, 2))
            which, H, agree = agreement(grid, cell, lines, codes, image)
            usual = agree.mean() * np.sqrt(agree.size * light[0].size) if len(agree) else 0.0
            if usual > max(most, _SURE) and np.median(agree) > LEAST_AGREEMENT:
                corners = (cells.corners[which] - 0.5 - cells.cell[which, None]) @ turn + 0.5
                best, most = Marks(cells.number[which], homography_at(H, corners), dictionary), usual
    return best


def agreement(
    grid: Grid, cell: NDArray[np.int64], lines: Array, light: NDArray[Any], image: Image
) -> tuple[NDArray[np.intp], Array, Array]:
    """How far the light in the cells of a grid is that of codes.

    Returns which M of the cells have all their vertices, their homographies, and the correlation (M,) of
    their light with codes (N, n, n), which are in cells (N, 2) between lines (n + 1,) along their sides.
    """
    squares = squares_of(grid.pixels)
    c, r = cell.T
    inside = (cell >= 0).all(axis=1) & (c < squares.shape[1]) & (r < squares.shape[0])
    which = np.flatnonzero(inside)
    which = which[np.isfinite(squares[r[which], c[which]]).all(axis=(1, 2))]
    at = squares[r[which], c[which]]
    H = homographies(_OF_SQUARE[None], at)
    middle = 0.5 * (lines[1:] + lines[:-1])
    places = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    seen = interpolate(image, homography_at(H, places[None]))
    codes = light[which].reshape(len(which), len(places))
    return which, H, (_standard(seen) * _standard(codes)).sum(axis=1)


def _standard(values: NDArray[Any]) -> Array:
    """Rows (N, K) without their means, and of length 1."""
    centred = values - values.mean(axis=1, keepdims=True)
    return np.asarray(centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-9))


def _agreeing(ground: Array, pixels: Array) -> NDArray[np.intp]:
    """Indices of the largest set of markers (N, 4, 2) that is connected by pairs that agree."""
    n = len(ground)
    if n < 2:
        return np.zeros(0, dtype=np.intp)
    middle = ground.mean(axis=1)
    first, second = np.triu_indices(n, 1)
    near = _apart(middle, middle)[first, second] < _NEAR
    first, second = first[near], second[near]
    both = np.concatenate([ground[first], ground[second]], axis=1)
    seen = np.concatenate([pixels[first], pixels[second]], axis=1)
    error = np.sqrt(((homography_at(homographies(both, seen), both) - seen) ** 2).sum(axis=2).mean(axis=1))
    side = np.sqrt(np.minimum(*(_area(pixels[k]) / _area(ground[k]) for k in (first, second))))
    agree = error < _AGREE * side + _AGREE_PX
    label = np.arange(n)
    while True:
        before = label.copy()
        for a, b in zip(first[agree].tolist(), second[agree].tolist(), strict=True):
            label[a] = label[b] = min(label[a], label[b])
        if (label == before).all():
            break
    return np.flatnonzero(label == np.bincount(label).argmax())


def _apart(places: Array, others: Array) -> Array:
    """Distances (N, M) of places (N, 2) from others (M, 2) along the axis along which they are farther."""
    x, y = (np.abs(one[:, None] - other) for one, other in zip(places.T, others.T, strict=True))
    return np.asarray(np.maximum(x, y))


def _area(corners: Array) -> Array:
    """Areas (N,) of quadrangles (N, 4, 2)."""
    one, two = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return np.maximum(0.5 * np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]), 1e-9)


def find_vertices(plane: Plane, placed: Placed, image: Image) -> tuple[Grid, tuple[int, int]] | None:
    """The vertices of a board around its markers, as a grid, and the vertex (c, r) of its first place.

    `image` has the grey levels of 8 bits. The grid's columns are the plane's; so are its rows, or reversed if
    the plane's axes have the other handedness.
    """
    grid = np.stack(np.meshgrid(np.arange(plane.cols), np.arange(plane.rows)), axis=-1).astype(float)
    ground = plane.spread(grid)
    found = np.full(grid.shape, np.nan)
    contrast = np.full(grid.shape[:2], np.nan)
    corners, pixels = placed.ground.reshape(-1, 2), placed.marks.corners.reshape(-1, 2)
    dark = int(placed.how.legacy)  # the cell at (c, r) is dark where c + r plus this is even
    count = 0
    while True:
        # The few markers that are read before a fisheye may flatten the others wrongly; vertices do better.
        flattening = flattening_of(corners, pixels, (image.shape[1], image.shape[0]))
        missing = np.isnan(contrast)
        at = np.argwhere(missing)
        start, cell = predicted(ground[missing], corners, pixels, flattening)
        near = np.isfinite(start[:, 0])
        at, start, cell = at[near], start[near], cell[near]
        new, size = _refined(plane, image, grid[tuple(at.T)], start, cell, dark)
        every = np.concatenate([contrast.ravel(), size])
        usual = float(np.nanmedian(every)) if np.isfinite(every).any() else np.inf
        good = size > _LEAST_CONTRAST * max(usual, 0.0)
        found[tuple(at[good].T)], contrast[tuple(at[good].T)] = new[good], size[good]
        leave_out_strays(ground, found, contrast, flattening)
        seen = np.isfinite(contrast)
        if seen.sum() < _FEWEST or seen.sum() <= count or seen.all():
            break
        count = int(seen.sum())
        # Vertices that were too far from the markers may be near the new ones.
        corners, pixels = ground[seen], found[seen]
    seen = np.isfinite(found[..., 0])
    if seen.sum() < _FEWEST or not tell_a_plane(ground[seen]):
        return None
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    first = int(cols[0]), int(rows[0])
    part = found[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    dark = (dark + sum(first)) % 2
    if isinstance(plane, TagPlane):
        part, dark = part[::-1], (dark + len(part)) % 2
    return Grid(np.ascontiguousarray(part), dark), first


def tell_a_plane(places: Array) -> bool:
    """Whether at least four places (N, 2) tell how a board lies: not if all but one are on a line."""
    # Two of any three are on it.
    for first, second in ((0, 1), (0, 2), (1, 2)):
        along, away = places[second] - places[first], places - places[first]
        if np.count_nonzero(np.abs(along[0] * away[:, 1] - along[1] * away[:, 0]) > _SAME) < 2:
            return False
    return True


def flattening_of(ground: Array, pixels: Array, size: tuple[int, int]) -> Flattening:
    """The map that flattens the image of a board with places (N, 2) at pixels."""
    left = homography_at(homographies(ground[None], pixels[None]), ground[None])[0] - pixels
    return Flattening.of(ground, pixels, float(np.sqrt((left**2).sum(axis=1).mean())), size)


def corners_of_tags(plane: TagPlane, placed: Placed) -> tuple[Grid, tuple[int, int]]:
    """The corners of tags as they were read, as `find_vertices` gives those with squares at them."""
    found = np.full((plane.rows, plane.cols, 2), np.nan)
    c, r = np.moveaxis(np.rint(placed.cells.corners[placed.at]).astype(np.int64), 2, 0)
    found[r, c] = placed.marks.corners
    low, high = (c.min(), r.min()), (c.max() + 1, r.max() + 1)
    part = found[low[1] : high[1], low[0] : high[0]]
    part = part if plane.downwards else part[::-1]
    return Grid(np.ascontiguousarray(part), 0, paired=True), (int(low[0]), int(low[1]))


def leave_out_strays(ground: Array, found: Array, contrast: Array, flattening: Flattening) -> None:
    """Make places (..., 2) found at pixels (..., 2) that those around them predict elsewhere NaN, in place.

    `contrast` (...,) is NaN for those that are not found.
    """
    while (seen := np.isfinite(contrast)).sum() > _FEWEST_AROUND:
        places, pixels = ground[seen], found[seen]
        start, cell = predicted(places, places, pixels, flattening, itself=False)
        # No others tell where one that is alone should be.
        off = np.nan_to_num(np.hypot(*(pixels - start).T), nan=np.inf)
        side = np.sqrt(np.abs(np.linalg.det(cell)))
        near = _apart(places, places) < _AROUND
        stray = (off > _STRAY * side + _STRAY_PX) & (off >= np.where(near, off, 0.0).max(axis=1))
        if not stray.any():
            return
        at = np.argwhere(seen)[stray]
        found[tuple(at.T)], contrast[tuple(at.T)] = np.nan, np.nan


def predicted(
    ground: Array, known: Array, pixels: Array, flattening: Flattening, itself: bool = True
) -> tuple[Array, Array]:
    """Pixels (N, 2) of places (N, 2) by homographies of the known places around each; NaN far from these.

    Also (N, 2, 2) the steps of a square along both axes [px]. If not `itself`, a known place says nothing of
    the same place, and one whose ray does not meet the flattening's plane of no place.
    """
    flat = flattening.flat(pixels)
    known, flat = known[ahead := np.isfinite(flat).all(axis=1)], flat[ahead]
    away = _apart(ground, known)
    if not itself:
        away[away < _SAME] = np.inf
    count = min(24, len(known))
    order = np.argsort(away, axis=1)[:, :count]
    near = np.take_along_axis(away, order, axis=1)
    weight = np.where(near < np.maximum(_AROUND, near[:, min(7, count - 1), None] + 1e-9), 1.0, 0.0)
    H = homographies(known[order], flat[order], weight)
    step = 0.05
    around = np.array([[0, 0], [step, 0], [-step, 0], [0, step], [0, -step]])
    places = flattening.pixels(homography_at(H, ground[:, None] + around))
    start = np.where((near[:, 0] < _REACH)[:, None], places[:, 0], np.nan)
    along = np.stack([places[:, 1] - places[:, 2], places[:, 3] - places[:, 4]], axis=1) / (2 * step)
    return start, along


def _refined(
    plane: Plane, image: Image, grid: Array, start: Array, cell: Array, dark: int
) -> tuple[Array, Array]:
    """Saddle points (N, 2) near predicted vertices, NaN for none, and the contrast (N,) around them."""
    # The cells on both sides may have different sizes.
    steps = [plane.spread(grid + shift) - plane.spread(grid) for shift in np.array([[1, 1], [-1, -1]])]
    least = np.abs(np.stack(steps)).min(axis=0)  # (N, 2) [squares]
    sides = np.hypot(cell[..., 0], cell[..., 1]) * least  # (N, 2) [px]
    twist = np.abs(cell[:, 0, 0] * cell[:, 1, 1] - cell[:, 0, 1] * cell[:, 1, 0])
    narrow = np.minimum(sides.min(axis=1), twist * least.prod(axis=1) / np.maximum(sides.max(axis=1), 1e-9))
    most = np.maximum(_MOVED * sides.min(axis=1), _MOVED_PX)
    new = np.full(start.shape, np.nan)
    for sigma in (1.0, 1.5, 2.5):
        mine = (sigma <= np.maximum(narrow / 6, 1.0)) & np.isfinite(start).all(axis=1)
        if mine.any():
            refined = refine_saddles(image, start[mine], sigma, rounds=5)
            # Wide windows reach beyond the image earlier, and to the ink of markers.
            near = np.hypot(*(refined - start[mine]).T) < most[mine]
            new[mine] = np.where(near[:, None], refined, new[mine])
    quadrant = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    # Between the vertex and the markers of a ChArUco board.
    tags = isinstance(plane, TagPlane) or plane.markers is None
    room = 1.0 if tags else 2 * (1 - plane.markers.side / plane.square)  # type: ignore[union-attr]
    offsets = (_BESIDE * min(room, 1.0) * quadrant * least[:, None]) @ cell
    nearer = np.minimum(_BESIDE_PX / np.hypot(*np.moveaxis(offsets, 2, 0)), 1.0)[..., None] * offsets
    levels = interpolate(image, np.nan_to_num(new)[:, None, None] + np.stack([offsets, nearer], axis=1))
    sign = np.where((grid.sum(axis=1) + dark) % 2 == 0, -1.0, 1.0)
    first, second, third, last = np.moveaxis(levels, 2, 0)
    size = 0.5 * (sign[:, None] * (first + third - second - last)).min(axis=1)
    # Opposite quadrants are alike; at a tag's corner without a square beyond it, they are dark and light.
    unlike = np.maximum(np.abs(first - third), np.abs(second - last)).max(axis=1)
    new[~(unlike < _UNLIKE * np.abs(size))] = np.nan
    return new, np.where(np.isfinite(new[:, 0]), size, np.nan)

"""Find dark ellipses in an image, and which circle of the board each of them is.

The ellipses are the outlines of adaptive thresholds. The centres of both kinds of grids form a lattice; those
of an asymmetric one stand on their corners. From a start in the middle, neighbours are added where those
around them predict them. The lattice then is compared with the board in all ways that keep its handedness.
Perspective may make other vectors shorter than those of the rows, so the basis may be sheared.

If only a part of the board is seen, paper beside its circles tells where the board ends.

A round thing beside the board may look like one of its circles, and change which part of the board seems to
be seen. So marks that are not where those around them predict them are left out, and one that is on no place
of the board.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.appearance import departure_from_circles
from neurocal_cli.detection.finding.grow import frontier
from neurocal_cli.detection.finding.lattice import predict_vertices
from neurocal_cli.detection.finding.saddles import Image, Level, dense_parts, grey_levels, interpolate
from neurocal_cli.detection.markers.lattice import flattening_of, leave_out_strays
from neurocal_cli.detection.placement import NEARER, ONE_BOARD, NoBoardError
from neurocal_cli.observations.board_kinds import CirclePlane

_WINDOWS = (0.02, 0.06, 0.18)  # of the threshold, over the image's longer side
_STEPS = (4, 12)  # DN below the mean of the window
_SHORTEST = 12  # px, least outline
_WHOLE = 1.4e6  # pixels; larger images are halved first
_NEIGHBOURS = 8  # saddle points near each other where small circles are looked for, as in `dense_parts`
_ROUND, _ROUND_PX = 0.04, 0.5  # deviation from an ellipse over its radius, and px of it
_THIN = 0.1  # least ratio of the axes
_COMPACT = 0.02  # least area over the squared length of an outline; 0.02 of the thinnest ellipse
_INSIDE, _OUTSIDE = 0.8, 1.25  # radii, where it is dark, and lighter
_SAME = 0.5  # radii of the smaller one between centres of the same blob


@frozen_dataclass(eq=False)
class Blobs:
    """N ellipses."""

    centre: Array  # (N, 2) [px]
    area: Array  # (N,) [px^2]

    def __len__(self) -> int:
        """Number of ellipses."""
        return len(self.area)


def find_blobs(grey: NDArray[np.uint8]) -> Iterator[tuple[bool, Blobs]]:
    """Find dark ellipses, and then light ones, in one or more looks at an image; whether they are light.

    A large image is looked at as a whole at a smaller scale, and then where it may show smaller details. Each
    look adds to those before it.
    """
    scaled = [grey]
    while scaled[-1].size > _WHOLE:
        scaled.append(np.asarray(cv2.pyrDown(scaled[-1]), dtype=np.uint8))
    found: tuple[list[Array], list[Array]] = ([], [])  # of both, the last look first
    parts = [(slice(0, None), slice(0, None))]
    while scaled:
        look = scaled.pop()
        scale = 2 ** len(scaled)
        for light, every in enumerate(found):
            every.insert(0, _all_ellipses(255 - look if light else look, parts) * [scale**2, scale, scale])
            yield bool(light), _distinct(every)
        parts = dense_parts(Level(grey_levels(look), 2), _NEIGHBOURS) if scaled else []


def _all_ellipses(grey: NDArray[np.uint8], parts: list[tuple[slice, slice]]) -> Array:
    """Areas and centres (N, 3) of dark ellipses in parts of an image, some of them several times."""
    smooth = np.asarray(cv2.GaussianBlur(grey, (3, 3), 0), dtype=np.uint8)
    outlines: list[NDArray[Any]] = []
    for v, u in parts:
        part = np.ascontiguousarray(smooth[v, u])
        for share in _WINDOWS:
            window = 2 * round(0.5 * share * max(grey.shape)) + 3
            mean = cv2.blur(part, (window, window))
            for step in _STEPS:
                level = np.maximum(mean, step) - np.uint8(step)
                outlines += _outlines(part < level, (u.start, v.start))
    return _ellipses(outlines, smooth)


def _distinct(looks: list[Array]) -> Blobs:
    """Each ellipse once, by areas and centres (N, 3): of the first look, the largest with the same centre.

    A window smaller than a disc finds a ring along its edge, with an inner outline as well.
    """
    every = np.concatenate([one[np.lexsort(one.T[::-1])[::-1]] for one in looks])
    reach = _SAME * np.sqrt(every[:, 0] / np.pi)
    by_u = np.argsort(every[:, 1])
    u = every[by_u, 1]
    first, last = np.searchsorted(u, every[:, 1] - reach), np.searchsorted(u, every[:, 1] + reach)
    kept: list[int] = []
    taken = np.zeros(len(every), dtype=bool)
    for k in range(len(every)):
        if not taken[k]:
            kept.append(k)
            near = by_u[first[k] : last[k]]
            away = np.hypot(*(every[near, 1:3] - every[k, 1:3]).T)
            taken[near] |= away < np.minimum(reach[near], reach[k])
    return Blobs(every[kept, 1:3], every[kept, 0])


def _outlines(dark: NDArray[np.bool_], origin: tuple[int, int] = (0, 0)) -> list[NDArray[Any]]:
    """Outlines (P, 2) of what may be ellipses in a mask, whose first pixel is at `origin`.

    They enclose as much as that of a thin ellipse; the others are long, and many.
    """
    every, _ = cv2.findContours(dark.view(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE, offset=origin)
    return [
        np.asarray(x)[:, 0]
        for x, n in zip(every, map(len, every), strict=True)
        if n >= _SHORTEST and cv2.contourArea(x) + n / 2 >= _COMPACT * n**2
    ]


def _ellipses(outlines: list[NDArray[Any]], image: NDArray[np.uint8]) -> Array:
    """Areas and centres (N, 3) of the outlines that are ellipses darker than what is around them.

    The ellipses have the moments of what the outlines enclose.
    """
    if not outlines:
        return np.zeros((0, 3))
    of, points = _joined(outlines)
    count = np.bincount(of)
    middle = np.stack([np.bincount(of, x) / count for x in points.T], axis=1)
    (u, v), last = (points - middle[of]).T, np.cumsum(count) - 1
    u_next, v_next = np.roll(u, -1), np.roll(v, -1)
    u_next[last], v_next[last] = u[last - count + 1], v[last - count + 1]
    turn = u * v_next - u_next * v  # twice the area of the triangle with the middle

    def moment(of_edges: Array) -> Array:
        return np.bincount(of, of_edges * turn).astype(float)

    with np.errstate(divide="ignore", invalid="ignore"):
        enclosed = 0.5 * moment(np.ones(len(u)))
        mean_u, mean_v = moment(u + u_next) / (6 * enclosed), moment(v + v_next) / (6 * enclosed)
        uu = moment(u * u + u * u_next + u_next * u_next) / (12 * enclosed) - mean_u**2
        vv = moment(v * v + v * v_next + v_next * v_next) / (12 * enclosed) - mean_v**2
        uv = moment((u + u_next) * (v + v_next) + u * v + u_next * v_next) / (24 * enclosed) - mean_u * mean_v
        u, v = u - mean_u[of], v - mean_v[of]
        square = (vv[of] * u * u - 2 * uv[of] * u * v + uu[of] * v * v) / (uu * vv - uv * uv)[of]
        radius = 0.5 * np.sqrt(np.maximum(square, 0))
        mean = np.bincount(of, radius) / count
        spread = np.sqrt(np.bincount(of, (radius - mean[of]) ** 2) / count)
        half, differ = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
        low, high = 4 * np.sqrt(half - differ), 4 * np.sqrt(half + differ)
        good = (low > _THIN * high) & (np.maximum(np.abs(mean - 1), spread) <= _ROUND + _ROUND_PX / low)
        area = np.pi * (low + 1) * (high + 1) / 4  # the outline runs through the outermost dark pixels
        # An arc does not enclose what its ellipse does.
        share = (np.abs(enclosed) + count / 2) / area
    good &= (share > 0.7) & (share < 1.3)
    centre, round_ones = middle + np.stack([mean_u, mean_v], axis=1), np.flatnonzero(good)
    kept = round_ones[_darker([outlines[k] for k in round_ones], centre[round_ones], image)]
    return np.column_stack([area, centre])[kept]


def _joined(outlines: list[NDArray[Any]]) -> tuple[NDArray[np.intp], Array]:
    """The outline (P,) of each of all points, and the points (P, 2)."""
    of = np.repeat(np.arange(len(outlines)), list(map(len, outlines)))
    return of, np.concatenate(outlines).astype(float)


def _darker(outlines: list[NDArray[Any]], centre: Array, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether ellipses (n,) are darker within their outlines than around them; a ring is light in its middle.

    Windows find the surroundings of discs, too, whose outer outlines are no edges.
    """
    if not outlines:
        return np.zeros(0, dtype=np.bool_)
    of, points = _joined(outlines)
    count = np.bincount(of)
    first = np.cumsum(count) - count

    def level(radii: float) -> Array:
        """Medians along the outlines, enlarged by a factor."""
        places = np.rint(centre[of] + radii * (points - centre[of])).astype(int)
        u, v = np.clip(places, 0, np.array(image.shape[::-1]) - 1).T
        levels = np.sort(256 * of + image[v, u]) % 256  # of each outline
        return np.asarray(0.5 * (levels[first + (count - 1) // 2] + levels[first + count // 2]))

    return np.asarray(level(_INSIDE) < level(_OUTSIDE) - _STEPS[0])


_ALIKE = 2.2  # greatest ratio of the areas of circles on the board
_NEAR = 0.3  # of the shorter step; distance between prediction and circle
_SLANT = 0.35  # least sine of the angle between the steps at the start
_STARTS = 30  # blobs that are tried as a start
_FEWEST = 9  # circles
_LEAST_SHARE = 0.35  # of the circles of a board
# Greatest departure of circles that are described, which may be blurred by a hand as far as they are wide. Of
# 354 all but one have 17 at most, and of 90 other lattices, one has 35 and the others 60 and more
# (test_circles.py).
_DEPARTURE = 45.0
_MOST_AROUND = 5  # circles around a place beside those that are seen; there are more around one between them
_WITHIN = 0.6  # of the radius: from the middle of a place beside them, up to which paper has to go on ...
_SAMPLES = 6  # ... in as many samples
_BARE = 0.75  # of the light from ink to paper, above which there is paper
_MOST_WRONG = 0.1  # of the places beside a part of the board
_SYMMETRIC = (
    "the grid of circles looks the same after a turn, so its first circle depends on its orientation in the "
    "image; to get the same point ids in all images, use an asymmetric grid with an odd number of rows"
)
# Bases of the lattice: matrices of determinant 1 with small entries.
BASES = tuple(
    np.array(entries).reshape(2, 2)
    for entries in product((-2, -1, 0, 1, 2), repeat=4)
    if entries[0] * entries[3] - entries[1] * entries[2] == 1 and sum(map(abs, entries)) <= 4
)


@frozen_dataclass(eq=False)
class PlacedCircles:
    """N circles of a board in an image."""

    place: NDArray[np.int64]  # (N, 2) (c, r)
    centre: Array  # (N, 2) [px] of the ellipse
    area: Array  # (N,) [px^2]
    warnings: tuple[str, ...] = ()
    light: bool = False  # whether they are light on dark


def place_circles(plane: CirclePlane, blobs: Blobs, grey: NDArray[np.uint8]) -> PlacedCircles | None:
    """The largest lattice of dark ellipses in an image, placed on the board; None if there is none.

    Raises NoBoardError if a part of the board is seen that may be several parts, or marks that are not round.
    """
    count = plane.cols * plane.rows
    best, *others = lattices(blobs, count)
    least = max(min(_FEWEST, count), _LEAST_SHARE * count)
    if len(best) < least:
        return None
    at = np.array(list(best.values()), dtype=np.int64)
    index = np.array(list(best.keys()), dtype=np.int64)
    found, area = blobs.centre[at], blobs.area[at].astype(float)
    alike = [list(one.values()) for one in others if len(one) == count]
    if any(NEARER**2 * np.median(blobs.area[one]) > np.median(area) for one in alike):
        raise NoBoardError(f"two grids of {plane.cols} x {plane.rows} circles are detected; {ONE_BOARD}")
    size = grey.shape[1], grey.shape[0]
    leave_out_strays(index.astype(float), found, area, flattening_of(index.astype(float), found, size))
    kept = np.isfinite(area)
    if kept.sum() < least:
        return None
    light = grey.astype(np.float32)
    placed = _placed(plane, blobs, index[kept], at[kept], light)
    places = plane.spread(placed.place.astype(float))
    departure, _ = departure_from_circles(light, places, placed.centre, placed.area, described=True)
    if departure > _DEPARTURE:
        raise NoBoardError(
            "the image shows marks in rows and columns, but no circles of one colour on blank paper; if "
            "they are the board, avoid reflections and shadows on it"
        )
    return placed


def lattices(blobs: Blobs, enough: int) -> list[dict[tuple[int, int], int]]:
    """The lattices that grow from starts, until too few blobs are left for one of `enough` places.

    The blob of each place; the largest first. No two have the same blobs. There is one, which may be empty.
    """
    found: list[dict[tuple[int, int], int]] = []
    centre = blobs.centre
    # Starts far from each other: every n-th blob along the image.
    order = np.lexsort((centre[:, 0], np.round(centre[:, 1] / 50)))
    step = max(1, len(order) // _STARTS)
    tried: set[int] = set()
    for start in order[::step].tolist():
        if start in tried or len(blobs) < 4:
            continue
        found.append(_grown(blobs, start))
        tried.update(found[-1].values())
        if len(found[-1]) >= enough and len(blobs) < len(tried) + enough:
            break
    kept: list[dict[tuple[int, int], int]] = []
    # Of equal ones the nearest.
    for one in sorted(found, key=lambda one: (len(one), blobs.area[[*one.values()]].sum()), reverse=True):
        if one and not any(set(one.values()) & set(other.values()) for other in kept):
            kept.append(one)
    return kept or [{}]


def _grown(blobs: Blobs, start: int) -> dict[tuple[int, int], int]:
    """The lattice around a blob, layer by layer, where those around a place predict a circle of its size."""
    steps = _steps(blobs, start)
    if steps is None:
        return {}
    centre, size = blobs.centre, blobs.area[start] / abs(float(np.linalg.det(steps)))
    at = np.full((3, 3), -1)
    at[1, 1] = start
    for place, step in zip(((1, 2), (1, 0), (2, 1), (0, 1)), np.repeat(steps, 2, axis=0), strict=True):
        way = 1 if max(place) == 2 else -1
        at[place] = np.hypot(*(centre - centre[start] - way * step).T).argmin()
    while True:
        at = np.pad(at, 1, constant_values=-1)
        row, col, _ = frontier(at >= 0, 1)
        predicted = predict_vertices(np.where(at[..., None] >= 0, centre[at], np.nan), row, col)
        off = np.hypot(*(centre[:, None] - predicted.points).transpose(2, 0, 1))
        near = off.argmin(axis=0)
        room = _NEAR * np.hypot(predicted.steps[..., 0], predicted.steps[..., 1]).min(axis=1)
        ratio = blobs.area[near] / np.maximum(size * np.abs(predicted.area), 1e-9)
        good = (off.min(axis=0) < room) & (ratio < _ALIKE) & (ratio > 1 / _ALIKE)
        good &= ~np.isin(near, at)
        # Of two places with the same blob, the nearer one has it.
        order = np.flatnonzero(good)[np.argsort(off.min(axis=0)[good])]
        new = order[np.unique(near[order], return_index=True)[1]]
        if not len(new):
            return {(c, r): int(at[r, c]) for r, c in np.argwhere(at >= 0).tolist()}
        at[row[new], col[new]] = near[new]


def _steps(blobs: Blobs, start: int) -> Array | None:
    """The steps (2, 2) from a blob to two neighbours, of which the opposite ones are there too."""
    near = np.argsort(np.hypot(*(blobs.centre - blobs.centre[start]).T))[:13]
    near = near[near != start][:12]
    ratio = blobs.area[near] / blobs.area[start]
    near = near[(ratio < _ALIKE) & (ratio > 1 / _ALIKE)]
    vectors = blobs.centre[near] - blobs.centre[start]
    first: Array | None = None
    for vector in vectors:
        length = np.hypot(*vector)
        if np.hypot(*(vectors + vector).T).min(initial=np.inf) > _NEAR * length:
            continue
        if first is None:
            first = vector
            continue
        cross = first[0] * vector[1] - first[1] * vector[0]
        if abs(cross) > _SLANT * length * np.hypot(*first):
            return np.stack([first, vector if cross > 0 else -vector])
    return None


def _placed(
    plane: CirclePlane,
    blobs: Blobs,
    index: NDArray[np.int64],
    at: NDArray[np.intp],
    image: Image,
) -> PlacedCircles:
    """Compare a lattice with the board in all bases and places."""
    board = _lattice_of(plane)
    found: list[NDArray[np.int64]] = []
    but_one: list[int] = []
    for basis in BASES:
        for places, outside in _shifted(index @ basis.T, board):
            if outside.any():
                but_one.append(int(outside.argmax()))
            else:
                found.append(places)
    if len(set(but_one)) == 1 and not found:
        kept = np.arange(len(index)) != but_one[0]
        return _placed(plane, blobs, index[kept], at[kept], image)
    names = [np.array([board[tuple(one)] for one in places.tolist()]) for places in found]
    several = bool(but_one) and not found
    if len(index) < len(board) and len(names) > 1 and not _are_turns(plane, names):
        beside = [_paper_beside(places, board, blobs, at, image) for places in found]
        kept = [k for k, (shown, _) in enumerate(beside) if shown <= _MOST_WRONG]
        names = [names[k] for k in kept]
        several = any(beside[k][1] > _MOST_WRONG for k in kept)
        several |= len(names) > 1 and not _are_turns(plane, names)
    if several:
        raise NoBoardError(
            f"the image shows {len(index)} circles, which may be several parts of the board; show all of it"
        )
    if not names:
        raise NoBoardError(
            f"the image shows {len(index)} circles, no part of a board of {plane.cols} x {plane.rows} "
            "circles; correct its description"
        )
    chosen = max(range(len(names)), key=lambda k: _rightwards(names[k], blobs.centre[at]))
    return PlacedCircles(names[chosen], blobs.centre[at], blobs.area[at], (_SYMMETRIC,) * (len(names) > 1))


def _paper_beside(
    places: NDArray[np.int64],
    board: dict[tuple[int, int], tuple[int, int]],
    blobs: Blobs,
    at: NDArray[np.intp],
    image: Image,
) -> tuple[float, float]:
    """Where there is paper beside a part of the board, at its places (N, 2), and where it should be.

    Returns the share of the next places on the board that show paper, and of those beyond it that show none.
    The paper has to go on from the circles beside a place to well within it.
    """
    low = places.min(axis=0) - 2
    pixels = np.full((*(places.max(axis=0) - low + 3)[::-1], 2), np.nan)
    x, y = (places - low).T
    pixels[y, x] = blobs.centre[at]
    row, col, around = frontier(np.isfinite(pixels[..., 0]), 1)
    beside = np.asarray(around) <= _MOST_AROUND
    row, col = row[beside], col[beside]
    on_board = np.array([tuple(one) in board for one in (np.column_stack([col, row]) + low).tolist()])
    next_to = predict_vertices(pixels, row, col)
    radius = np.sqrt(np.median(blobs.area[at]) / (np.pi * np.median(np.abs(next_to.area))))
    share = [-0.5, 0.0, 0.5 * radius, 0.9 * radius, *np.linspace(0.5, 1 - _WITHIN * radius, _SAMPLES)]
    start = np.stack([pixels[row + r, col + c] for c, r in ((1, 0), (-1, 0), (0, 1), (0, -1))])
    way = start[:, :, None] + np.array(share)[:, None] * (next_to.points - start)[:, :, None]
    light = interpolate(image, np.nan_to_num(way))
    paper, ink = light[..., 0], light[..., 1:4].min(axis=-1)
    bare = light[..., 4:].min(axis=-1) > ink + np.maximum(_BARE * (paper - ink), _STEPS[0])
    inside = ((way >= 0) & (way <= np.array(image.shape[::-1]) - 1)).all(axis=(2, 3))
    known = np.isfinite(start[..., 0])
    bare, inside = ((one | ~known).all(axis=0) for one in (bare, inside))
    shown, missing = bare & inside & on_board, ~bare & inside & ~on_board
    return shown.sum() / max(on_board.sum(), 1), missing.sum() / max((~on_board).sum(), 1)


def _lattice_of(plane: CirclePlane) -> dict[tuple[int, int], tuple[int, int]]:
    """The circles (c, r) of a board by their places in its lattice."""
    circles = list(product(range(plane.cols), range(plane.rows)))
    if not plane.asymmetric:
        return {(c, r): (c, r) for c, r in circles}
    places = {(c, r): (2 * c + r % 2, r) for c, r in circles}
    return {((x + y) // 2, (y - x) // 2): key for key, (x, y) in places.items()}


def _shifted(
    index: NDArray[np.int64], board: dict[tuple[int, int], tuple[int, int]]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_]]]:
    """A lattice (N, 2) with all shifts that leave at most one place outside the board, and which (N,) is."""
    places = np.array(list(board), dtype=np.int64)
    low, high = places.min(axis=0), places.max(axis=0)
    first, second, *_, last_but_one, last = np.sort(index, axis=0)
    if (np.minimum(last - second, last_but_one - first) > high - low).any():
        return
    known = np.zeros(high - low + 1, dtype=bool)
    known[tuple((places - low).T)] = True
    # One of two places is on the board.
    shifts = np.unique(np.concatenate([places - index[0], places - index[1]]), axis=0)
    shifted = index + shifts[:, None]
    inside = ((shifted >= low) & (shifted <= high)).all(axis=2)
    inside[inside] = known[tuple((shifted[inside] - low).T)]
    for k in np.flatnonzero(np.count_nonzero(inside, axis=1) >= len(index) - 1).tolist():
        yield shifted[k], ~inside[k]


def _are_turns(plane: CirclePlane, names: list[NDArray[np.int64]]) -> bool:
    """Whether placements differ only by turns of a board that looks the same after half a turn.

    They contain the same places, or those turned about the middle of the board.
    """
    every = plane.spread(plane.midpoint_grid())
    turned = every.min(axis=0) + every.max(axis=0) - every
    places = [plane.spread(one.astype(float)) for one in names]
    if {tuple(one) for one in every.tolist()} != {tuple(one) for one in turned.tolist()}:
        return False
    if len({tuple(map(tuple, np.unique(one, axis=0))) for one in names}) == 1:
        return True
    radius = [np.hypot(*(one - 0.5 * (every.min(axis=0) + every.max(axis=0))).T) for one in places]
    return all(np.allclose(one, radius[0]) for one in radius)


def _rightwards(place: NDArray[np.int64], centre: Array) -> float:
    """How much the board's x axis points to the right, and else down."""
    known = np.column_stack([place, np.ones(len(place))])
    axis = np.linalg.lstsq(known, centre, rcond=None)[0][0]
    return float((axis[0] + 1e-3 * axis[1]) / np.hypot(*axis))

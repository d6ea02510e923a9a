"""Which board has markers that lie so: its columns, rows, pattern and first number.

Every upright marker is a frame of its own, in which its neighbours are upright too and at whole multiples of
one distance along both axes. On a ChArUco board the nearest ones are diagonal, on a grid of tags they are
beside it.

On a ChArUco board of C columns, marker n is on the square (x, y) with n = first + floor((y C + x) / 2). On a
grid of tags, tag n is at (c, r) with n = first + r C + c. So the numbers of the markers of an image tell C.
The images together tell where the board begins and ends.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.markers.reading import Marks

_NEAR = 4.5  # sides of a marker between neighbours
_UPRIGHT = 0.35  # greatest difference of a neighbour's sides from those of the marker
_BESIDE, _DIAGONAL = 0.25, 0.6  # ratio of a distance's parts along both axes: at most, at least
_TAGS = 1.4  # greatest ratio of the distance beside to the diagonal one of tags; 2 on a ChArUco board
_SPACED = 2.0  # greatest distance of tags if no diagonal neighbour is seen, in sides
_LEAST = 1.04  # sides
_OFF = 0.22  # of a step; greatest deviation of a neighbour
UNIT = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


@frozen_dataclass(eq=False)
class Lie:
    """N markers of an image in one lattice."""

    marks: Marks
    index: NDArray[np.int64]  # (N, 2) [steps] along the marker's upper side and down
    step: float  # sides of a marker; the side of a square on a ChArUco board
    tags: bool  # whether neighbours are beside each other; else diagonal, and the sum of an index is even

    def only(self, which: NDArray[np.bool_]) -> Lie:
        """Some of the markers."""
        return Lie(self.marks.only(which), self.index[which], self.step, self.tags)


def lie_of(marks: Marks) -> Lie | None:
    """The largest lattice of markers; None if not two lie as neighbours do."""
    n = len(marks)
    offset, near = _neighbours(marks)
    if not near.any():
        return None
    reach = np.abs(offset).max(axis=2)
    slant = np.abs(offset).min(axis=2) / np.maximum(reach, 1e-9)
    beside, diagonal = (
        _usual_least(np.where(near & kind, reach, np.inf)) for kind in (slant < _BESIDE, slant > _DIAGONAL)
    )
    tags = beside < (_TAGS * diagonal if np.isfinite(diagonal) else _SPACED)
    step = beside if tags else min(diagonal, 0.5 * beside)
    if not _LEAST < step < np.inf:
        return None
    for _ in range(2):
        steps = np.rint(offset / step)
        off = np.abs(offset / step - steps).max(axis=2)
        used = near & (off < _OFF) & (np.abs(steps).max(axis=2) <= 2) & steps.any(axis=2)
        if not tags:
            used &= steps.sum(axis=2) % 2 == 0
        if not used.any():
            return None
        along = (offset * steps)[used].sum(axis=1) / (steps[used] ** 2).sum(axis=1)
        step = float(np.median(along))
    best: dict[int, tuple[int, int]] = {}
    left = set(range(n))
    while left:
        start = max(left, key=lambda k: (int(used[k].sum()), -k))
        found = _connected(start, steps.astype(int), np.where(used, off + 0.1 * reach, np.inf))
        left -= set(found)
        best = max(best, found, key=len)
    if len(best) < 2:
        return None
    return Lie(marks.only(np.array(list(best), dtype=np.intp)), np.array(list(best.values())), step, tags)


def _neighbours(marks: Marks) -> tuple[Array, NDArray[np.bool_]]:
    """(N, N, 2) places of markers in the frame of each, and (N, N) whether they may be neighbours."""
    n = len(marks)
    H = homographies(UNIT[None], marks.corners)
    with np.errstate(all="ignore"):
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        seen = homography_at(inverse, marks.corners.reshape(1, -1, 2))
        seen = seen.reshape(n, n, 4, 2)
        offset = seen.mean(axis=2)
        right, down = seen[:, :, 1] - seen[:, :, 0], seen[:, :, 3] - seen[:, :, 0]
        near = np.abs(offset).max(axis=2) < _NEAR
        near &= np.abs(right - [1, 0]).max(axis=2) < _UPRIGHT
        near &= np.abs(down - [0, 1]).max(axis=2) < _UPRIGHT
    near &= np.isfinite(seen).all(axis=(2, 3))
    np.fill_diagonal(near, val=False)
    return np.nan_to_num(offset), near


def _usual_least(distance: Array) -> float:
    """Median of the least distances (N, N) of the markers that have neighbours; infinite for none."""
    least = distance.min(axis=1)
    return float(np.median(least[np.isfinite(least)])) if np.isfinite(least).any() else np.inf


def _connected(start: int, steps: NDArray[np.int_], cost: Array) -> dict[int, tuple[int, int]]:
    """Places of the markers connected to a start, by the best steps first; no place twice."""
    place: dict[int, tuple[int, int]] = {}
    taken: set[tuple[int, int]] = set()
    queue: list[tuple[float, int, tuple[int, int]]] = [(0.0, start, (0, 0))]
    while queue:
        _, k, at = heapq.heappop(queue)
        if k in place or at in taken:
            continue
        place[k] = at
        taken.add(at)
        for j in np.flatnonzero(np.isfinite(cost[k])).tolist():
            if j not in place:
                to = at[0] + int(steps[k, j, 0]), at[1] + int(steps[k, j, 1])
                heapq.heappush(queue, (float(cost[k, j]), j, to))
    return place


_MOST_COLUMNS = 60
_FEWEST = 4  # markers of an image whose numbers agree
_LEAST_SHARE = 0.6  # of the markers of an image
_SURE = 3  # more markers that agree with a number of columns than with any other


@frozen_dataclass(eq=False)
class Numbered:
    """Markers of an image, all of whose numbers agree with a number of columns."""

    source: int  # number of the image
    lie: Lie
    axes: NDArray[np.int64]  # (2, 2) rows: steps of the lattice along the board's rows and columns
    place: NDArray[np.int64]  # (N, 2) along the board's rows and columns, from an unknown origin


@frozen_dataclass
class Numbering:
    """How the markers of images are numbered, and which of them agree with that."""

    cols: int
    as_text: bool  # rows follow each other downwards; those of AprilGrids upwards
    parts: tuple[Numbered, ...]


@frozen_dataclass
class Layout:
    """A board of markers."""

    tags: bool
    cols: int  # of squares, or of tags
    rows: int
    legacy: bool  # whether the first square of a ChArUco board is light
    first_id: int


@frozen_dataclass
class _Way:
    """A way in which numbers may grow: along the board's rows and its columns."""

    cols: int
    axes: tuple[tuple[int, int], tuple[int, int]]  # rows: directions of growing c and r in the lattice
    odd: int  # of a ChArUco board with an even number of columns: the columns' parity in the lattice


def _ways(tags: bool) -> Iterator[_Way]:
    for cols in range(1 if tags else 2, _MOST_COLUMNS + 1):
        if not tags:
            yield from (_Way(cols, ((1, 0), (0, 1)), odd) for odd in ((0,) if cols % 2 else (0, 1)))
            continue
        # Rows run along an axis; columns may run either way.
        for c, r in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            yield _Way(cols, ((c, r), (r, -c)), 0)
            yield _Way(cols, ((c, r), (-r, c)), 0)


def _offsets(lie: Lie, way: _Way) -> NDArray[np.int64]:
    """Number (N,) of each marker less what its place says; all the same if they agree."""
    c, r = (lie.index @ np.array(way.axes).T).T
    grown = r * way.cols + c
    return np.asarray(lie.marks.number - (grown if lie.tags else (grown + way.odd) // 2))


def numbered(lies: Sequence[Lie]) -> Numbering | None:
    """How the markers of images are numbered; None if they do not tell it."""
    score: Counter[tuple[int, bool]] = Counter()
    best: list[dict[tuple[int, bool], tuple[int, _Way]]] = []
    for lie in lies:
        mine: dict[tuple[int, bool], tuple[int, _Way]] = {}
        for way in _ways(lie.tags):
            offsets = _offsets(lie, way)
            count = int(np.bincount(offsets - offsets.min()).max())
            (a, b), (c, d) = way.axes
            key = way.cols, a * d - b * c > 0  # as text
            if count > mine.get(key, (0, way))[0]:
                mine[key] = count, way
        best.append(mine)
        score.update({key: count for key, (count, _) in mine.items()})
    (key, most), *others = [*score.most_common(2), ((0, True), 0)]
    if most < _FEWEST or others[0][1] > most - _SURE:
        return None
    found = []
    for source, (lie, mine) in enumerate(zip(lies, best, strict=True)):
        count, way = mine[key]
        if count >= max(_FEWEST, _LEAST_SHARE * len(lie.marks)):
            offsets, axes = _offsets(lie, way), np.array(way.axes)
            kept = lie.only(offsets == Counter(offsets.tolist()).most_common(1)[0][0])
            found.append(Numbered(source, kept, axes, kept.index @ axes.T))
    return Numbering(*key, tuple(found)) if found else None


def joined(parts: Iterable[Numbered]) -> tuple[Numbered, ...]:
    """The parts in the coordinates of the largest one, without those that have no markers in common."""
    waiting = sorted(parts, key=lambda part: -len(part.place))
    known: dict[int, tuple[int, int]] = {}
    found: list[Numbered] = []
    while waiting:
        for k, part in enumerate(waiting):
            numbers = part.lie.marks.number.tolist()
            shifts = Counter(
                (known[n][0] - x, known[n][1] - y)
                for n, (x, y) in zip(numbers, part.place.tolist(), strict=True)
                if n in known
            )
            if known and not shifts:
                continue
            shift = np.array(shifts.most_common(1)[0][0] if shifts else (0, 0))
            found.append(replace(part, place=part.place + shift))
            for n, place in zip(numbers, found[-1].place.tolist(), strict=True):
                known.setdefault(n, tuple(place))
            del waiting[k]
            break
        else:
            break
    return tuple(found)


def layouts(
    tags: bool, cols: int, parts: Sequence[Numbered], more: tuple[int, int], begins: bool, last: int = 0
) -> list[Layout]:
    """Boards of `cols` columns with the markers of joined parts, the likeliest first.

    There are `more` rows before and after those of the parts, and none before these if the board `begins`
    there. The board has at least the rows up to the marker `last`.
    """
    place, at = np.unique(np.concatenate([part.place for part in parts]), axis=0, return_index=True)
    number = np.concatenate([part.lie.marks.number for part in parts])[at]
    low, high = place.min(axis=0), place.max(axis=0)
    before, after = more
    found: list[tuple[tuple[bool, int, bool], Layout]] = []
    rows_seen = int(high[1] - low[1]) + 1
    for left in range(cols - int(high[0] - low[0])):
        for above in range(before, before + (1 if begins else rows_seen + 1)):
            c, r = (place - low + [left, above]).T
            grown = r * cols + c
            first = number - (grown if tags else grown // 2)
            legacy = not tags and int(c[0] + r[0]) % 2 == 0
            count = last - int(first.min())
            rows = 1 + max(int(r.max()) + after, (count if tags else 2 * count) // cols)
            # OpenCV has no legacy boards of an odd number of rows.
            if first.min() >= 0 and (first == first[0]).all() and not (legacy and rows % 2):
                one = Layout(tags, cols, rows, legacy, int(first[0]))
                found.append(((bool(first[0]), above, legacy), one))
    return [one for _, one in sorted(found, key=lambda each: each[0])]

"""How the markers of an image lie to each other: their places in a lattice of squares or of tags.

Every upright marker is a frame of its own, in which its neighbours are upright too and at whole multiples of
one distance along both axes. On a ChArUco board the nearest ones are diagonal, on a grid of tags they are
beside it.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.markers.lattice import homographies, homography_at
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
    H = homographies(np.broadcast_to(UNIT, (n, 4, 2)), marks.corners)
    with np.errstate(all="ignore"):
        inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
        seen = homography_at(inverse, np.broadcast_to(marks.corners.reshape(1, -1, 2), (n, 4 * n, 2)))
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

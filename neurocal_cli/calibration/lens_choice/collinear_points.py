"""Straight lines among known points: which points of a view are collinear in X, Y, Z.

The images of collinear points are collinear in any pinhole camera. Only the coordinates of the target are
used. Rows, columns and diagonals of boards are found like any other line: pairs of points on one line have
the same direction and the same offset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.measured_directions import unit
from neurocal_cli.observations.points import Correspondences

FEWEST_ON_LINE = 4
_FEWEST_OF_EDGES = 3  # the same for points that are measured across edges, on lines along these edges

# Rounding of coordinates, as a share of the target's size: 2 micrometres on a 200 mm board. The tests in
# test_plumb_line.py repeat that lines are found and that scattered points have none.
_TOLERANCE = 1e-5
_LINES_A_POINT = 4  # rows, columns and diagonals of a board
_OF_EDGES = 8  # the same where only lines along edges are used
_NEARLY_0 = 1e-3  # component of a direction
_ALONG = 0.25  # largest sine of the angle between an edge and the line along it
_ALL_PAIRS = 700  # largest target of which all pairs are compared
_MOST_PAIRS = 500_000  # pairs of some points with all others, for larger targets
# Numbers without a relation: two directions, or two places, have the same product only if they are the same.
_OF_DIRECTION, _OF_PLACE = np.array([0.618, 0.4142, 0.2361]), np.array([0.7321, 0.2361, 0.6458])
_MOST_PLACES = 200_000  # points on lines; more of them do not change the result but cost time

Index = NDArray[np.intp]


@frozen_dataclass(eq=False)
class CollinearPoints:
    """Points of each view, grouped by the lines on which they are."""

    row: Index  # (M,) of each point on each line; a row occurs once for each line through it
    first: Index  # (L,) where each line begins in `row`

    def __len__(self) -> int:
        return len(self.first)

    @property
    def counts(self) -> Index:
        """(L,) points of each line."""
        return np.diff(self.first, append=len(self.row))

    @property
    def line(self) -> Index:
        """(M,) line of each entry of `row`."""
        return np.repeat(np.arange(len(self.first)), self.counts)

    def only(self, which: NDArray[np.bool_]) -> CollinearPoints:
        """Some of the lines; which is a mask (L,)."""
        kept = self.counts[which]
        return CollinearPoints(self.row[which[self.line]], np.cumsum(kept) - kept)


def find_lines(points: Correspondences) -> CollinearPoints:
    """Find the lines of at least `FEWEST_ON_LINE` known points in each view, or of three along edges.

    Each point is used on the four longest lines through it: the row, the column and the diagonals of a
    board. A point that was measured across an edge is used on lines along that edge.
    """
    ids, target = _distinct(points.world)
    fewest, most = FEWEST_ON_LINE, _LINES_A_POINT
    if points.across is not None:
        fewest, most = _FEWEST_OF_EDGES, _OF_EDGES
    line, member = _longest(*_lines_of(target, fewest), len(target), most)
    # Each line in each view: join the rows with the lines through their points.
    order = np.argsort(member, kind="stable")
    line, through = line[order], np.bincount(member, minlength=len(target))
    begins = np.cumsum(through) - through
    copies = through[ids]
    row = np.repeat(np.arange(len(ids)), copies)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(copies) - copies, copies)
    label = line[np.repeat(begins[ids], copies) + rank].astype(np.int64)
    label = label * points.n_views + points.view_index[row]
    order = np.argsort(label, kind="stable")
    changes = np.diff(label[order], prepend=-1) != 0
    lines = CollinearPoints(row[order], np.flatnonzero(changes))
    lines = lines.only(lines.counts >= fewest)
    if points.across is not None and len(lines):
        lines = _along_edges(lines, points.pixels, points.across)
    every = -(-len(lines.row) // _MOST_PLACES)
    return lines.only(np.arange(len(lines)) % every == 0) if every > 1 else lines


def _along_edges(lines: CollinearPoints, pixels: Array, across: Array) -> CollinearPoints:
    """Drop lines across the edges of their points: a position along an edge is not measured."""
    row, first, counts, line = lines.row, lines.first, lines.counts, lines.line
    chord = pixels[row[first + counts - 1]] - pixels[row[first]]
    order = np.lexsort(((pixels[row] * chord[line]).sum(axis=1), line))
    row = row[order]
    # The local direction, from the point before to the point after: distortion may curve the whole line.
    place = np.arange(len(row))
    before = np.maximum(place - 1, first[line])
    after = np.minimum(place + 1, (first + counts - 1)[line])
    n = unit(across)[row]
    slant = np.abs((n * unit(pixels[row[after]] - pixels[row[before]])).sum(axis=1))
    return CollinearPoints(row, first).only(~np.logical_or.reduceat(slant > _ALONG, first))


def _distinct(world: Array) -> tuple[Index, Array]:
    """Number of the distinct point of each row, and these points, centred and scaled to a size of about 1."""
    centre = world.mean(axis=0)
    size = float(np.ptp(world, axis=0).max()) or 1.0
    local = (world - centre) / size
    ids = _clusters(local @ np.array([0.4142135623730951, 0.2360679774997898, 0.1231056256176606]), 1e-11)
    _, first = np.unique(ids, return_index=True)
    return ids, local[first]


def _clusters(values: Array, gap: float) -> Index:
    """Number groups of values whose sorted neighbours are nearer than a gap."""
    order = np.argsort(values, kind="stable")
    labels = np.empty(len(values), dtype=np.intp)
    labels[order] = np.cumsum(np.diff(values[order], prepend=values[order[:1]]) > gap)
    return labels


def _lines_of(target: Array, fewest: int) -> tuple[Index, Index]:
    """Line and point of each point on the lines of a target, whose pairs are all compared if they are few."""
    n = len(target)
    if n <= _ALL_PAIRS:
        a, b = np.triu_indices(n, 1)
        line, member, _ = _through_pairs(target, a, b, fewest)
        return line, member
    anchors = np.linspace(0, n - 1, int(np.clip(_MOST_PAIRS // n, 4, 64))).astype(np.intp)
    a, b = np.repeat(anchors, n), np.tile(np.arange(n), len(anchors))
    line, member, directions = _through_pairs(target, a[a != b], b[a != b], fewest)
    # All lines along the directions of the lines with the most points.
    labels = _clusters(directions @ _OF_DIRECTION, _TOLERANCE)
    _, first = np.unique(labels, return_index=True)
    weight = np.bincount(labels, np.bincount(line))
    most = int(np.clip(10**7 // n, 6, 24))
    return _parallels(target, directions[first[np.argsort(-weight, kind="stable")[:most]]], fewest)


def _through_pairs(target: Array, a: Index, b: Index, fewest: int) -> tuple[Index, Index, Array]:
    """Lines that several pairs of points have in common: line and point of each member, directions."""
    along = target[b] - target[a]
    along /= np.linalg.norm(along, axis=1)[:, None]
    # Opposite directions are the same: the first component that is not nearly 0 becomes positive.
    leading = np.take_along_axis(along, (np.abs(along) > _NEARLY_0).argmax(axis=1)[:, None], axis=1)
    along *= np.where(leading < 0, -1.0, 1.0)
    offset = target[a] - (target[a] * along).sum(axis=1)[:, None] * along
    by_direction = _clusters(along @ _OF_DIRECTION, _TOLERANCE)
    place = offset @ _OF_PLACE
    # Offsets are compared only between pairs of one direction.
    labels = _clusters(4.0 * by_direction + place, _TOLERANCE)
    counts = np.bincount(labels)
    common = counts[labels] >= fewest - 1
    labels, a, b, along = labels[common], a[common], b[common], along[common]
    key = np.unique(np.concatenate([labels, labels]) * len(target) + np.concatenate([a, b]))
    line, member = np.divmod(key, len(target))
    return _checked(line, member, target, labels, along, fewest)


def _checked(
    line: Index, member: Index, target: Array, labels: Index, along: Array, fewest: int
) -> tuple[Index, Index, Array]:
    """Keep the lines with enough points that are collinear, and renumber them."""
    names, first, counts = np.unique(line, return_index=True, return_counts=True)
    given, where = np.unique(labels, return_index=True)
    direction = along[where[np.searchsorted(given, names)]]
    index = np.repeat(np.arange(len(names)), counts)
    start = target[member[first]]
    off = target[member] - start[index]
    off -= (off * direction[index]).sum(axis=1)[:, None] * direction[index]
    astray = np.linalg.norm(off, axis=1) > 3 * _TOLERANCE
    good = (counts >= fewest) & (np.bincount(index, astray, len(names)) == 0)
    number = np.cumsum(good) - 1
    keep = good[index]
    return number[index[keep]], member[keep], direction[good]


def _parallels(target: Array, directions: Array, fewest: int) -> tuple[Index, Index]:
    """All lines along some directions."""
    lines, members, total = [], [], 0
    for direction in directions:
        offset = target - (target @ direction)[:, None] * direction
        labels = _clusters(offset @ _OF_PLACE, _TOLERANCE)
        order = np.argsort(labels, kind="stable")
        along = np.broadcast_to(direction, (len(target), 3))
        line, member, kept = _checked(labels[order], order, target, labels, along, fewest)
        lines.append(line + total)
        members.append(member)
        total += len(kept)
    none = np.zeros(0, dtype=np.intp)
    return np.concatenate([none, *lines]), np.concatenate([none, *members])


def _longest(line: Index, member: Index, n: int, most: int) -> tuple[Index, Index]:
    """Keep lines that are among the `most` longest lines of at least half of their points."""
    if not line.size:
        return line, member
    counts = np.bincount(line)
    order = np.lexsort((line, -counts[line], member))
    through = np.bincount(member, minlength=n)
    rank = np.empty(len(line), dtype=np.intp)
    rank[order] = np.arange(len(line)) - np.repeat(np.cumsum(through) - through, through)
    chosen = np.bincount(line, rank < most) >= 0.5 * counts
    return line[chosen[line]], member[chosen[line]]

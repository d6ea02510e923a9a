"""Split a lattice that covers two planes at the fold between them.

Along a line of vertices on one plane, second differences change slowly, for any tilt and lens distortion. At
a fold they jump: at one vertex if the fold goes through it, otherwise at the two vertices beside it.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.lattice import Lattice
from neurocal_cli.detection.medians import median, quantile

# Pairs of the least second difference of a fold [squares] and its least ratio to those of distant rows,
# because paper is not flat either. Insensitive, like all constants here; FOLDED and WHOLE in
# tests/test_finding.py repeat this.
_FOLDS = ((0.13, 4.0), (0.06, 12.0))
_VERTEX_ERROR = 0.2  # px, added for the errors of the vertices
_UNKNOWN = 0.03  # squares; second difference assumed if there are no distant rows
_LEAST_ROWS = 4
_BETWEEN = 1.4  # factor that makes a jump shared by two rows comparable with that of one row
_ONE_SIDED = 0.7  # weight of a jump that can be compared with one side only
_ALIKE = 2.0  # more than 1.4, so that independent errors (means of two are 1.4 times smaller) are not limited


def split_at_folds(lattice: Lattice) -> list[Lattice]:
    """Split a lattice into connected parts without a fold.

    Vertices on a fold are dropped: they belong to both planes, and the edges change direction there.
    """
    whole = lattice.connected_parts()
    if len(whole) != 1:
        return [part for piece in whole for part in split_at_folds(piece)]
    lattice = whole[0]
    width = max(median(lattice.predicted[2].width), 1.0)
    row, col = (_sharpest_fold(second, width) for second in _second_differences(lattice))
    if row[1] == 0 and col[1] == 0:
        return [lattice]
    seen = lattice.seen
    axis = 0 if row[1] >= col[1] else 1
    position, last = (row, col)[axis][0], seen.shape[axis] - 1
    if position in (1, last - 1):
        # This is either a fold or a wrong outermost row: drop only that row.
        position = 0.0 if position == 1 else last
    index = np.indices(seen.shape)[axis]
    parts = (lattice.subset(seen & side) for side in (index < position - 0.25, index > position + 0.25))
    return [piece for part in parts if part.seen.any() for piece in split_at_folds(part)]


def largest_second_difference(lattice: Lattice) -> float:
    """Largest median second difference of any row or column [squares], folds included."""
    return max(float(_size(second).max()) for second in _second_differences(lattice))


def _second_differences(lattice: Lattice) -> tuple[Array, Array]:
    """Second differences along columns (rows, cols, 2) and rows (cols, rows, 2) [squares]; NaN if unknown."""
    pixels = lattice.pixels
    row, col, at = lattice.predicted
    along = []
    for lines, index in ((pixels, (row, col)), (pixels.swapaxes(0, 1), (col, row))):
        second = np.full(lines.shape, np.nan)
        second[1:-1] = lines[2:] - 2 * lines[1:-1] + lines[:-2]
        second[index] = at.in_squares(second[index])
        along.append(second)
    return along[0], along[1]


def _sharpest_fold(second: Array, width: float) -> tuple[float, float]:
    """Row index and size [squares] of the sharpest fold across the columns; (0, 0) if there is none.

    `second` holds the second differences (rows, cols, 2) [squares], NaN where unknown; `width` is that of a
    square [px].
    """
    rows = len(second)
    if rows < _LEAST_ROWS:
        return 0.0, 0.0
    before, after, far = (np.full_like(second, np.nan) for _ in range(3))
    before[1:], after[:-1], far[:-2] = second[:-1], second[1:], second[2:]
    # Compare with both sides, or with less weight with one side if the other is unknown.
    one = _ONE_SIDED * (second - np.where(np.isnan(before), after, before))
    both = second - 0.5 * (before + after)
    at = _jump(np.where(np.isnan(both), one, both))
    # A fold between row i and row i + 1.
    between = _BETWEEN * _jump(0.5 * (second + after - before - far))
    size = np.empty(2 * rows)
    size[::2], size[1::2] = at, between
    best = int(size.argmax())
    others = np.abs(np.arange(2 * rows) - best) > 3
    far_off = size[others & (size > 0)]
    usual = quantile(far_off, 0.25) if len(far_off) else _UNKNOWN
    least = min(max(fold + _VERTEX_ERROR / width, ratio * usual) for fold, ratio in _FOLDS)
    if size[best] < least:
        return 0.0, 0.0
    return 0.5 * best, float(size[best])


def _jump(values: Array) -> Array:
    """Size of each row's jump, limited to `_ALIKE` times that of the means of neighbouring columns.

    At a fold all columns jump alike. Vertices displaced to alternate sides, as on overexposed boards, jump in
    opposite directions in neighbouring columns, by as much as at a fold.
    """
    beside = np.concatenate([values[:, 1:], values[:, -2:-1]], axis=1)
    means = np.where(np.isnan(beside), values, 0.5 * (values + beside))
    return np.minimum(_size(values), _ALIKE * _size(means))


def _size(values: Array) -> Array:
    """Median length of each row's vectors; 0 if fewer than two are known."""
    ordered = np.hypot(values[..., 0], values[..., 1])
    ordered.sort(axis=1)  # unknown ones come last
    count, row = (ordered >= 0).sum(axis=1), np.arange(len(ordered))
    middle = 0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2])
    return np.where(count >= 2, middle, 0.0)

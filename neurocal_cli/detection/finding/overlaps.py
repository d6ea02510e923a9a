"""Let each vertex belong to one lattice, each board have one lattice, and each lattice cover one plane.

Copies of a lattice and rows beyond a fold are removed; the parts of a board that an occluder divides are
joined; and a lattice that covers two planes is split at the fold between them (`split_at_folds`).

Along a line of vertices on one plane, second differences change slowly, for any tilt and lens distortion. At
a fold they jump: at one vertex if the fold goes through it, otherwise at the two vertices beside it.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.detection.finding.grow import frontier
from neurocal_cli.detection.finding.lattice import Index, Lattice, predict_vertices
from neurocal_cli.detection.grid import TURNS
from neurocal_cli.detection.medians import median, quantile

# Insensitive; FOLDED and "two boards" in test_finding.py repeat this.
_SAME = 0.25  # squares; greatest distance between vertices that are the same
_MEETS = 0.13  # squares; greatest distance of a vertex from another lattice or its next row ...
_MEETS_PARTLY = 0.22  # ... and the same for vertices of incomplete rows
_MOSTLY = 0.6  # share of such vertices above which a row is removed
_COPY = 0.5  # share of vertices in another lattice above which a lattice is its copy
# test_finding.py divides a board into two halves with these limits, and expects one grid.
_NEAR = 4.0  # squares; greatest distance of vertices from the other lattice to be compared
_WHOLE, _WHOLE_WORST = 0.12, 0.3  # squares; greatest median and maximum deviation from whole numbers
_LEAST = 4  # least number of vertices compared
# Pairs of the least second difference of a fold [squares] and its least ratio to those of distant rows,
# because paper is not flat either. Insensitive, like all that follow; FOLDED and WHOLE in
# test_finding.py repeat this.
_FOLDS = ((0.13, 4.0), (0.06, 12.0))
_VERTEX_ERROR = 0.2  # px, added for the errors of the vertices
_UNKNOWN = 0.03  # squares; second difference assumed if there are no distant rows
_LEAST_ROWS = 4
_BETWEEN = 1.4  # factor that makes a jump shared by two rows comparable with that of one row
_ONE_SIDED = 0.7  # weight of a jump that can be compared with one side only
_ALIKE = 2.0  # more than 1.4, so that independent errors (means of two are 1.4 times smaller) are not limited
_OUTERMOST = (
    (np.s_[0, :], np.s_[1, :]),
    (np.s_[-1, :], np.s_[-2, :]),
    (np.s_[:, 0], np.s_[:, 1]),
    (np.s_[:, -1], np.s_[:, -2]),
)


def drop_duplicates(lattices: list[Lattice]) -> list[Lattice]:
    """Drop lattices if most of their vertices belong to a larger one."""
    kept: list[Lattice] = []
    for lattice in sorted(lattices, key=lambda x: -int(x.seen.sum())):
        points = lattice.pixels[lattice.seen]
        reach = _SAME * lattice.width
        if not any((distance(points, x.pixels[x.seen]) < reach).mean() > _COPY for x in kept):
            kept.append(lattice)
    return kept


def trim_overlaps(lattices: list[Lattice]) -> list[Lattice]:
    """Remove outermost rows of a lattice that lie on another lattice or on its next row.

    Such rows occur if a lattice has grown across a fold into the other plane.
    """
    result = list(lattices)
    for _ in range(2):
        places = [_vertices_and_next(x) for x in result]
        for i, lattice in enumerate(result):
            for j, place in enumerate(places):
                if i != j:
                    lattice = _trimmed(lattice, place)
            result[i] = lattice
    return result


def _vertices_and_next(lattice: Lattice) -> tuple[Array, float]:
    """Vertices of a lattice and predicted vertices of its next rows (N, 2), and the width of its squares."""
    wider, _ = lattice.padded()
    row, col, _ = frontier(wider.seen, 1)
    predicted = predict_vertices(wider.pixels, row, col)
    return np.concatenate([lattice.pixels[lattice.seen], predicted.points]), lattice.width


def _trimmed(lattice: Lattice, place: tuple[Array, float]) -> Lattice:
    """Remove the outermost rows that lie on another lattice, whose `_vertices_and_next` is `place`."""
    points, width = place
    seen = lattice.seen
    away = np.full(seen.shape, np.inf)
    away[seen] = distance(lattice.pixels[seen], points) / min(width, lattice.width)
    drop = np.zeros_like(seen)
    for line, inner in _OUTERMOST:
        known = int(seen[line].sum())
        # An incomplete row is more likely to lie beyond the end of its plane.
        meets = _MEETS if known > 0.75 * seen[inner].sum() else _MEETS_PARTLY
        if known and (away[line][seen[line]] < meets).mean() >= _MOSTLY:
            drop[line] = seen[line]
    if not drop.any():
        return lattice
    return lattice.subset(seen & ~drop)


def distance(points: Array, others: Array) -> Array:
    """(N,) distance of each point from the nearest of the others [px]."""
    if not len(points) or not len(others):
        return np.full(len(points), np.inf)
    away = points[:, None] - others[None]
    return np.asarray(np.sqrt((away**2).sum(axis=-1).min(axis=1)))


def merge_lattices(lattices: list[Lattice]) -> list[Lattice]:
    """Join lattices whose extrapolated grid coordinates agree at the vertices of the other."""
    result = sorted(lattices, key=lambda x: -int(x.seen.sum()))
    first = 0
    while first < len(result):
        for second in range(first + 1, len(result)):
            union = _union(result[first], result[second])
            if union is not None:
                result[first] = union
                del result[second]
                break
        else:
            first += 1
    return result


def _union(large: Lattice, small: Lattice) -> Lattice | None:
    """Join two parts of one board; None if their grids do not agree, or share a vertex."""
    motion = _motion(large, small)
    if motion is None or _motion(small, large) is None:
        return None
    turn, shift = motion
    row, col = np.nonzero(small.seen)
    place = np.stack([col, row], axis=-1) @ turn.T + shift
    low = np.minimum(place.min(axis=0), 0)
    high = np.maximum(place.max(axis=0) + 1, large.seen.shape[::-1])
    cols, rows = high - low
    pixels, contrast = np.full((rows, cols, 2), np.nan), np.full((rows, cols), np.nan)
    within = np.s_[-low[1] : -low[1] + large.seen.shape[0], -low[0] : -low[0] + large.seen.shape[1]]
    pixels[within], contrast[within] = large.pixels, large.contrast
    at = place[:, 1] - low[1], place[:, 0] - low[0]
    if np.isfinite(contrast[at]).any():
        return None
    pixels[at], contrast[at] = small.pixels[row, col], small.contrast[row, col]
    return Lattice(pixels, contrast, int(large.dark + low.sum()) % 2)


def _motion(base: Lattice, other: Lattice) -> tuple[Index, Index] | None:
    """Rotation (2, 2) and shift (2,) from the other lattice's (c, r) to the base's; None if they disagree."""
    row, col = np.nonzero(other.seen)
    grid = _continued(base, other)
    rows, cols = base.seen.shape
    beyond = np.maximum(np.maximum(-grid, grid - np.array([cols - 1, rows - 1])), 0).max(axis=1)
    near = np.isfinite(grid).all(axis=1) & (beyond <= _NEAR)
    if near.sum() < _LEAST:
        return None
    own = np.stack([col, row], axis=-1)[near]
    for turn in np.array(TURNS):
        away = grid[near] - own @ turn.T
        shift = np.rint(np.median(away, axis=0)).astype(np.intp)
        off = np.abs(away - shift).max(axis=1)
        if np.median(off) < _WHOLE and off.max() < _WHOLE_WORST:
            # The same square must be dark in both.
            square = np.floor(np.array([0.5, 0.5]) @ turn.T + shift).astype(np.intp)
            same = (square.sum() + base.dark) % 2 == other.dark % 2
            return (turn, shift) if same else None
    return None


def _continued(base: Lattice, other: Lattice) -> Array:
    """Grid coordinates (N, 2) of the other lattice's vertices on the base, extrapolated by a homography."""
    row, col = np.nonzero(base.seen)
    p, q = base.pixels[row, col], other.pixels[other.seen]
    away = distance(p, q)
    # Lens distortion bends the plane, so the vertices near the other lattice have the largest weights.
    weight = np.exp(-(away - away.min()) / (_NEAR * max(base.width, 1e-3)))
    H = homographies(p[None], np.stack([col, row], axis=-1)[None].astype(float), weight[None])
    # Beyond the horizon of the plane there is nothing.
    depth = np.column_stack([q, np.ones(len(q))]) @ H[0, 2]
    usual = np.median(np.column_stack([p, np.ones(len(p))]) @ H[0, 2])
    return np.where((depth * usual > 0)[:, None], homography_at(H, q[None])[0], np.nan)


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
    if rows < _LEAST_ROWS or second.shape[1] < 2:
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

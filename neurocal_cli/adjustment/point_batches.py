"""Observations in batches of equally many points, each batch from one view, for vectorised arithmetic.

Views have from four to a million points. Cut into batches of one size (the last batch of a view is padded
with weight 0), they are plain arrays and need no Python loop over views, and a few batches at a time fit into
the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

# The fastest of 512 to 4096 points on 13 to 1000 views of 54; tests/benchmarks/test_speed.py repeats it.
_LARGEST_BATCH = 512
_POINTS_AT_ONCE = 4096  # about 1.5 MB of derivatives, which fit into the second-level cache


@frozen_dataclass(eq=False)
class PointBatches:
    """Points of several views in batches of n points."""

    local: Array  # (T, 3, n) world points of each batch in its view's own normalised frame
    pixels: Array  # (T, 2, n) normalised
    # (T, 3, n) entries (0, 0), (0, 1), (1, 1) of the upper triangular factor that whitens a residual; None if
    # all points have equal weight and no batch is padded.
    whitening: Array | None
    first: NDArray[np.intp]  # (V,) first batch of each view
    view: NDArray[np.intp]  # (T,) view of each batch
    counts: NDArray[np.intp]  # (V,) number of points of each view
    _memory: dict[int, Array] = field(default_factory=dict, init=False, repr=False)

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.counts)

    def chunks(self) -> Iterator[slice]:
        """Slices of batches, each a few thousand points; the first is the longest."""
        most = max(1, _POINTS_AT_ONCE // self.local.shape[2])
        step = -(-len(self.view) // -(-len(self.view) // most))  # nearly equal lengths
        for start in range(0, len(self.view), step):
            yield slice(start, min(start + step, len(self.view)))

    def memory(self, width: int) -> Array:
        """(T, width + 1, 2, n) buffer for the derivatives of any one of the chunks; zero when it is new.

        Calls with the same width return the same buffer, because allocating new pages took up to half of the
        time. Each derivative is contiguous over all points, which doubles the speed of arithmetic on it. The
        last row is padding; see `products`.
        """
        if width not in self._memory:
            longest = next(self.chunks()).stop
            rows = np.zeros((width + 1, 2, longest, self.local.shape[2]))
            self._memory[width] = np.moveaxis(rows, 2, 0)
        return self._memory[width]

    def sum_by_view(self, by_batch: Array) -> Array:
        """Sum of the batches' values over each view; (T, ...) -> (V, ...)."""
        if len(by_batch) == self.n_views:
            return by_batch
        return np.add.reduceat(by_batch, self.first, axis=0)


def products(J: Array, out: Array) -> None:
    """Products J J^T of the rows of each batch without the last, summed over u and v and over the points.

    J (T, width + 1, 2, n) is a part of `PointBatches.memory`, and `out` (T, width, width) is filled. The last
    row is multiplied as one column too many, so that NumPy does not detect the symmetric product: a general
    product takes half of the time.
    """
    rows = J.transpose(2, 0, 1, 3)
    both = rows[:, :, :-1] @ rows.swapaxes(2, 3)
    np.add(both[0, :, :, :-1], both[1, :, :, :-1], out=out)


def batches_of(
    local: Array, pixels: Array, whitening: Array | None, view: NDArray[np.intp], n_views: int
) -> PointBatches:
    """Cut points into batches: `local` (N, 3), `pixels` (N, 2) and, if not None, `whitening` (N, 3).

    `view` (N,) is the view of each point; each of the `n_views` views has at least one.
    """
    counts = np.bincount(view, minlength=n_views)
    order = np.argsort(view, kind="stable") if np.any(view[1:] < view[:-1]) else None
    size = _batch_size(counts)
    per_view = -(-counts // size)
    first = np.concatenate([[0], np.cumsum(per_view)[:-1]])
    n_batches = int(per_view.sum())
    padded = n_batches * size != len(view)
    # Slot of each point: its view's first batch, then its rank within the view.
    rank = np.arange(len(view)) - np.repeat(np.cumsum(counts) - counts, counts)
    slot = np.repeat(first * size, counts) + rank if padded else None

    def lay(values: Array, columns: int) -> Array:
        values = values if order is None else values[order]
        if slot is not None:
            # Padding repeats a real point, so that no padded slot ever divides by zero.
            filled = np.repeat(values[np.cumsum(counts) - 1], per_view * size, axis=0)
            filled[slot] = values
            values = filled
        return np.ascontiguousarray(np.swapaxes(values.reshape(n_batches, size, columns), 1, 2))

    if whitening is None and padded:
        whitening = np.tile([1.0, 0.0, 1.0], (len(view), 1))
    factors = None if whitening is None else lay(whitening, 3)
    if factors is not None and slot is not None:
        real = np.zeros(n_batches * size)
        real[slot] = 1.0
        factors *= real.reshape(n_batches, 1, size)
    batch_view = np.repeat(np.arange(n_views), per_view)
    return PointBatches(lay(local, 3), lay(pixels, 2), factors, first, batch_view, counts)


def _batch_size(counts: NDArray[np.intp]) -> int:
    """The cheapest batch size: padding adds points, and each batch has a fixed overhead."""
    most = int(counts.max())
    if most <= _LARGEST_BATCH and most == counts.min():
        return most
    quartiles = np.quantile(counts, [0, 0.25, 0.5, 0.75, 1])
    candidates = {min(int(c), _LARGEST_BATCH) for c in quartiles}
    candidates |= {-(-int(c) // -(-int(c) // _LARGEST_BATCH)) for c in quartiles[[2, 4]]}
    overhead = 16
    return min(sorted(candidates), key=lambda n: float((-(-counts // n)).sum() * (n + overhead)))

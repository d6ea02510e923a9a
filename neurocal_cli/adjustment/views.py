"""Points sorted by view and normalised with the paper's S1 and S2: centred, with one S2 for each view.

For bundle adjustment they are cut into batches of equally many points, each from one view. Views have from
four to a million points. In batches of one size (the last batch of a view is padded with weight 0), they are
plain arrays and need no Python loop over views, and a few batches at a time fit into the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, similarity
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.observations.measured_directions import LEAST, equations, loosened
from neurocal_cli.observations.points import Correspondences

# The fastest of 512 to 4096 points on 13 to 1000 views of 54; test_speed.py repeats it.
_LARGEST_BATCH = 512
_POINTS_AT_ONCE = 4096  # about 1.5 MB of derivatives, which fit into the second-level cache
# Repeated by test_convergence.py, with targets of every thickness.
# A target thinner than this share of its length is a plane up to rounding ...
_EXACTLY_FLAT = 1e-6
# ... and thinner than this it is treated as a plane until bundle adjustment, which uses all coordinates.
_NEARLY_FLAT = 0.02


@frozen_dataclass(eq=False)
class Views:
    """All points, sorted by view, in normalised coordinates."""

    names: tuple[str, ...]
    # (N,) row of the original data for each point; None if the data were sorted already.
    order: NDArray[np.intp] | None
    index: NDArray[np.intp]  # (N,) view of each point
    counts: NDArray[np.intp]  # (V,) number of points of each view
    first: NDArray[np.intp]  # (V,) index of each view's first point
    distinct: NDArray[np.intp]  # (V,) number of different world points of each view
    local: Array  # (N, 3) (M - centre) / scale, each view with its own
    pixels: Array  # (N, 2) (m - pixel_centre) / pixel_scale
    weights: Array  # (N,) scalar weights, mean 1
    across: Array | None  # (N, 2) direction in which each point was measured; see `measured_directions`
    # (N, 3) upper triangular factor of the inverse covariance: entries (0, 0), (0, 1), (1, 1).
    whitening: Array | None
    centre: Array  # (V, 3) mean of each view's points [world unit]
    scale: Array  # (V,) S2 of each view [world unit]
    basis: Array  # (V, 3, 3) columns: principal axes of each view's points, longest first; a rotation
    extent: Array  # (V, 3) rms extents along them, normalised
    pixel_centre: Array  # (2,) [px]
    pixel_scale: float  # S1 [px]
    along: float = LEAST  # weight that points measured across an edge have along it
    # (N, 3) unit directions that the networks learn instead of (u, v, 1), from an assumed lens. Without them
    # a network models a pinhole.
    rays: Array | None = None

    @property
    def targets(self) -> Array:
        """(N, 3) training targets of the networks: normalised pixels (u, v, 1), or rays."""
        if self.rays is not None:
            return self.rays
        return np.column_stack([self.pixels, np.ones(len(self.pixels))])

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.names)

    @property
    def side(self) -> float:
        """Number of points along the side of a view whose points are a square grid; of the mean view."""
        return float(np.sqrt(np.mean(self.counts)))

    @property
    def rank(self) -> NDArray[np.intp]:
        """(N,) number of each point within its view, from 0."""
        return np.arange(len(self.index)) - np.repeat(self.first, self.counts)

    @property
    def world(self) -> Array:
        """(N, 3) world points [world unit]."""
        return self.local * self.scale[self.index, None] + self.centre[self.index]

    @cached_property
    def equations(self) -> Array:
        """(V,) number of equations that each view's points give."""
        return np.asarray(np.add.reduceat(equations(self.across, len(self.index), self.along), self.first))

    @property
    def n_equations(self) -> float:
        """Number of equations that all points give."""
        return float(self.equations.sum())

    @property
    def n_distinct_equations(self) -> float:
        """Number of equations that different points give; a repeated point counts once."""
        return float(np.minimum(2 * self.distinct, self.equations).sum())

    @property
    def exactly_flat(self) -> NDArray[np.bool_]:
        """(V,) whether the view's points lie in one plane."""
        return np.asarray(self.extent[:, 2] <= _EXACTLY_FLAT * self.extent[:, 0])

    @property
    def nearly_flat(self) -> NDArray[np.bool_]:
        """(V,) whether the view's points nearly lie in one plane."""
        return np.asarray(self.extent[:, 2] <= _NEARLY_FLAT * self.extent[:, 0])

    @property
    def S1(self) -> Array:
        """(3, 3) matrix from normalised to real pixels, eq. (12)."""
        s, (u, v) = self.pixel_scale, self.pixel_centre
        return np.array([[s, 0.0, u], [0.0, s, v], [0.0, 0.0, 1.0]])

    @property
    def S2(self) -> Array:
        """(V, 4, 4) matrices from real to normalised world coordinates of each view, eq. (12)."""
        S2 = np.eye(4) / self.scale[:, None, None]
        S2[:, :3, 3] = -self.centre / self.scale[:, None]
        S2[:, 3, 3] = 1.0
        return S2

    def subset(self, views: NDArray[np.intp]) -> Views:
        """Only these views, normalised as before."""
        rows = np.concatenate([np.arange(self.first[v], self.first[v] + self.counts[v]) for v in views])
        return self._only(views, rows, self.counts[views])

    def of_points(self, kept: NDArray[np.bool_]) -> Views:
        """Only these points, in the order of the views, normalised as before."""
        counts = np.bincount(self.index[kept], minlength=self.n_views)
        views = np.flatnonzero(counts)
        return self._only(views, np.flatnonzero(kept), counts[views])

    def _only(self, views: NDArray[np.intp], rows: NDArray[np.intp], counts: NDArray[np.intp]) -> Views:
        return replace(
            self,
            names=tuple(self.names[v] for v in views),
            order=None,
            index=np.repeat(np.arange(len(views)), counts),
            counts=counts,
            first=np.cumsum(counts) - counts,
            distinct=self.distinct[views],
            local=self.local[rows],
            pixels=self.pixels[rows],
            weights=self.weights[rows],
            across=None if self.across is None else self.across[rows],
            whitening=None if self.whitening is None else self.whitening[rows],
            rays=None if self.rays is None else self.rays[rows],
            centre=self.centre[views],
            scale=self.scale[views],
            basis=self.basis[views],
            extent=self.extent[views],
        )

    @cached_property
    def batches(self) -> PointBatches:
        """All points, in batches for bundle adjustment."""
        return batches_of(self.local, self.pixels, self.whitening, self.index, self.n_views)


def arrange(points: Correspondences) -> Views:
    """Sort points by view and normalise them; raises DegenerateGeometryError if all pixels coincide."""
    index, V = points.view_index, points.n_views
    world, pixels, covariance, across = points.world, points.pixels, points.covariance, points.across
    order = None
    if np.any(index[1:] < index[:-1]):
        order = np.argsort(index, kind="stable")
        index, world, pixels = index[order], world[order], pixels[order]
        covariance = None if covariance is None else covariance[order]
        across = None if across is None else across[order]
    counts = np.bincount(index, minlength=V)
    first = np.cumsum(counts) - counts
    centre = np.add.reduceat(world, first) / counts[:, None]
    local = world - np.repeat(centre, counts, axis=0)
    scale = np.maximum.reduceat(np.abs(local), first).max(axis=1)
    scale = np.where(scale > 0, scale, 1.0)
    local /= np.repeat(scale, counts)[:, None]
    pixel_centre, pixel_scale = similarity(pixels)
    if len(pixels) > 1 and (pixels == pixels[0]).all():
        raise DegenerateGeometryError(f"{points.source}: all pixels u,v are the same; check the columns")
    basis, extent = _principal_axes(local, counts, first)
    weights, whitening = noise_model(covariance, across)
    if weights is None:
        weights = np.ones(len(index))
    return Views(
        points.view_names, order, index, counts, first, _distinct(local, index, V), local,
        (pixels - pixel_centre) / pixel_scale, weights, across, whitening, centre, scale, basis,
        extent, pixel_centre, pixel_scale,
    )  # fmt: skip


def _principal_axes(local: Array, counts: NDArray[np.intp], first: NDArray[np.intp]) -> tuple[Array, Array]:
    """Principal axes (V, 3, 3) and rms extents (V, 3) of each view's centred points."""
    scatter = np.empty((len(counts), 3, 3))
    columns = np.ascontiguousarray(local.T)
    for a in range(3):
        for b in range(a, 3):
            scatter[:, a, b] = scatter[:, b, a] = np.add.reduceat(columns[a] * columns[b], first)
    values, basis = np.linalg.eigh(scatter / counts[:, None, None])
    basis = basis[:, :, ::-1] * np.where(np.linalg.det(basis[:, :, ::-1]) < 0, -1.0, 1.0)[:, None, None]
    # Rounding leaves 1e-16 in a zero eigenvalue, so 1e-8 in the extent, below `_EXACTLY_FLAT`.
    return basis, np.sqrt(np.maximum(values[:, ::-1], 0.0))


def _distinct(local: Array, index: NDArray[np.intp], n_views: int) -> NDArray[np.intp]:
    """Number of different world points of each view.

    Points are identified by a fixed irrational combination of their coordinates; one sort handles all views.
    """
    key = local @ np.array([0.4142135623730951, 0.2360679774997898, 0.1231056256176606])
    key = np.sort(index + 0.5 * (np.round(key, 11) + 0.8) / 1.6)
    view = np.floor(key).astype(np.intp)
    fresh = np.concatenate([[True], np.diff(key) > 1e-13 * n_views])
    return np.bincount(view[fresh], minlength=n_views)


def noise_model(
    covariance: Array | None, across: Array | None = None, along: float = LEAST
) -> tuple[Array | None, Array | None]:
    """Scalar weights (N,) of mean 1 and whitening factors (N, 3) of mean square 1 for each equation.

    The columns of `covariance` (N, 3) are suu, suv, svv; it is None if they are equal for all points.
    `across` (N, 2) is the direction in which each point was measured (see `measured_directions`), and `along`
    is the weight of such points along their edge.
    """
    if covariance is None:
        if across is None:
            return None, None
        covariance = np.tile([1.0, 0.0, 1.0], (len(across), 1))
    suu, suv, svv = loosened(covariance, across, along).T
    # Inverse covariance = U^T U with U upper triangular.
    v11 = 1.0 / np.sqrt(svv)
    u00 = 1.0 / np.sqrt(suu - suv**2 / svv)
    u01 = -u00 * suv / svv
    factors = np.column_stack([u00, u01, v11])
    of_point, count = (factors**2).sum(axis=1), equations(across, len(factors), along)
    information = of_point / count
    return information / information.mean(), factors / np.sqrt(of_point.sum() / count.sum())


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
    _memory: dict[tuple[int, bool], Array] = field(default_factory=dict, init=False, repr=False)

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

    def memory(self, width: int, square: bool = False) -> Array:
        """(T, width + 1, 2, n) buffer for the derivatives of any one of the chunks; zero when it is new.

        Calls with the same width return the same buffer, because allocating new pages took up to half of the
        time; a camera with square pixels has one of its own, since other derivatives are always 0 for it.
        Each derivative is contiguous over all points, which doubles the speed of arithmetic on it. The last
        row is padding; see `products`.
        """
        key = width, square
        if key not in self._memory:
            longest = next(self.chunks()).stop
            rows = np.zeros((width + 1, 2, longest, self.local.shape[2]))
            self._memory[key] = np.moveaxis(rows, 2, 0)
        return self._memory[key]

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

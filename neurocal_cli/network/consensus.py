"""Consensus: robust training of each view's network from random weights, to detect gross outliers.

A network trained on all points is biased by outliers. Here each start is trained on a few random points and
rated by the median error of all points (least median of squares, Rousseeuw 1984): it is small if the few
points are inliers and most of all points are. The best starts are then trained repeatedly on all points near
them, until two starts agree on the same points. Points far from that network are gross outliers. A view
without such a network is wrong as a whole.

Lens distortion increases all errors and with them the threshold. Points left out here by mistake come back
when the camera is known (`outlier_rejection`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.network.levenberg_marquardt import LMOptions, train_lm
from neurocal_cli.network.network import Patterns, Task, patterns_of, random_weights

# Repeated by tests/test_outlier_rejection.py (slow: 200 scenes with a fifth of the points wrong, 105 sets
# with one wrong view, each within 3 standard deviations of clean data): the hardest scene needed this many
# starts and rounds, and the limits lie between the clean and the wrong views of these sets.
#
# For flat (True) and solid targets: points on which a start is trained, and fewest points of a searched view.
_SEEN = {True: 5, False: 7}
FEWEST_OF_PLANE = 8
"""Fewest points of a plane in a view that is searched."""
_FEWEST = {True: FEWEST_OF_PLANE, False: 11}
_STARTS, _ROUNDS = 24, 5
_FINALISTS = 4  # starts of each round that are trained further
_PASSES = 6
_FAR = 6.0  # standard deviations
_MOST_SEEN = 512  # most points of a view used in the search
_AGREED = 0.97  # share of points on which two starts have to agree
# A view is wrong as a whole if at most this share of its points agree, or if their scatter exceeds this share
# of the view's size.
_MAJORITY, _TIGHT = 0.5, 0.05
_LOOSE, _LOOSER = 0.01, 10.0  # or if it exceeds this share, and so many times the median of the views
_AT_ONCE = 20_000 // _STARTS  # views: 20,000 networks fit into memory
# Trial angles of the farthest point from the axis [rad], and the factor by which a lens must reduce the
# scatter. A board covers a small part of the image, where a lens that is 20 % off displaces points by 1 %.
_HALF_ANGLES = (0.8, 1.1, 1.4, 1.7)
_TIGHTER = 0.5


@frozen_dataclass(eq=False)
class Consensus:
    """Points that agree with the robust network of their view, in the order of the views."""

    # (N,) points near their view's network; all points of views that have too few for a search.
    kept: NDArray[np.bool_]
    hopeless: NDArray[np.bool_]  # (V,) views whose points do not agree on any network
    # Scatter of the points around their network, as a share of the view's size; the median of the views.
    looseness: float


def find_consensus(views: Views, rng: np.random.Generator) -> Consensus:
    """Find the points of each view that agree with one network; nearly flat targets are taken as planes."""
    kept = np.ones(len(views.index), dtype=bool)
    hopeless = np.zeros(views.n_views, dtype=bool)
    loose = np.full(views.n_views, np.nan)
    for flat in (True, False):
        members = np.flatnonzero((views.nearly_flat == flat) & (views.distinct >= _FEWEST[flat]))
        for first in range(0, len(members), _AT_ONCE):
            some = members[first : first + _AT_ONCE]
            search = _Search(views, some, flat, rng)
            search.run()
            hopeless[some] = search.judge(kept)
            # If all pixels of a view coincide, its scatter is undefined.
            loose[some] = np.divide(
                search.scale, search.spread, np.full(len(some), np.inf), where=search.spread > 0
            )
    # Distortion increases the scatter of all views; a view far above the others is wrong.
    told = loose[~np.isnan(loose)]
    if len(told) > 2:
        with np.errstate(invalid="ignore"):
            hopeless |= (loose > _LOOSE) & (loose > _LOOSER * median(told))
    return Consensus(kept, hopeless, float(median(told)) if len(told) else np.inf)


def find_consensus_through_wide_lens(
    pinhole: Consensus, views: Views, middle: Array, rng: np.random.Generator
) -> Consensus:
    """The same through a wide lens, which displaces points by more than outliers do.

    The networks learn rays instead of pixels, through equidistant lenses of several focal lengths; the lens
    with the smallest scatter is used. `pinhole` is the consensus without a lens, and is returned unless a
    lens reduces the scatter decidedly. `middle` (2,) is the assumed position of the optical axis, in
    normalised pixels.
    """
    away = views.pixels - middle
    radius = np.hypot(*away.T)
    best, most = None, _TIGHTER * pinhole.looseness
    for half_angle in _HALF_ANGLES:
        theta = radius * (half_angle / radius.max())
        rays = np.column_stack([away * np.sinc(theta / np.pi)[:, None], np.cos(theta)])
        rays[:, :2] *= half_angle / radius.max()
        consensus = find_consensus(replace(views, rays=rays), rng)
        if consensus.looseness < most:
            best, most = consensus, consensus.looseness
    return pinhole if best is None or best.hopeless.sum() > pinhole.hopeless.sum() else best


class _Search:
    """Search with starts on a few points each, for K views of one kind, flat or solid."""

    def __init__(self, views: Views, members: NDArray[np.intp], flat: bool, rng: np.random.Generator) -> None:
        self.views, self.members, self.flat, self.rng = views, members, flat, rng
        self.patterns = patterns_of(views, members, flat, _MOST_SEEN, rng)
        self.real = self.patterns.weights > 0
        K, n = self.real.shape
        self.product = np.zeros((K, 3, self.patterns.n_inputs))
        self.scale = np.full(K, np.inf)
        self.near = np.zeros((K, n), dtype=bool)
        self.agreed = np.zeros(K, dtype=np.int64)
        seen = np.where(self.real[..., None], self.patterns.targets, np.nan)
        self.spread = np.sqrt(np.nanvar(seen, axis=1).sum(axis=1))

    def run(self) -> None:
        """Search until two starts of each view agree, for a few rounds at most."""
        open_views = np.arange(len(self.members))
        for _ in range(_ROUNDS):
            if not open_views.size:
                return
            self._round(open_views)
            open_views = open_views[self.agreed[open_views] < 2]

    def _round(self, which: NDArray[np.intp]) -> None:
        product = self._few_points(which)  # (K', S, 3, I)
        scale, _ = self._near(which, product)
        order = np.argsort(scale, axis=1, kind="stable")[:, :_FINALISTS]
        product = np.take_along_axis(product, order[..., None, None], axis=1)
        product, scale, near = self._learn_on(which, product)
        for start in range(product.shape[1]):
            self._enter(which, product[:, start], scale[:, start], near[:, start])

    def _few_points(self, which: NDArray[np.intp]) -> Array:
        """Train starts from random weights on a few points each."""
        real = self.real[which]
        seen = _SEEN[self.flat]
        key = self.rng.random((len(which), _STARTS, real.shape[1])) + 2.0 * ~real[:, None]
        slots = np.argpartition(key, seen, axis=2)[..., :seen].reshape(len(which), -1)
        chosen = (
            np.take_along_axis(self.patterns.inputs[which], slots[..., None], axis=1),
            np.take_along_axis(self.patterns.targets[which], slots[..., None], axis=1),
            np.ones(slots.shape),
        )
        few = Patterns(*(a.reshape(len(which) * _STARTS, seen, *a.shape[2:]) for a in chosen))
        W, V = random_weights(self.rng, len(few.weights), few.n_inputs)
        product = _trained(few, W @ V, LMOptions(tolerance=1e-4, max_iterations=40))
        return product.reshape(len(which), _STARTS, 3, few.n_inputs)

    def _learn_on(self, which: NDArray[np.intp], product: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Train repeatedly on all points near each network."""
        K, S = product.shape[:2]
        patterns = self.patterns.take(np.repeat(which, S))
        options = LMOptions(stiffness=(0.0,), tolerance=1e-3, damping=1e-6, max_iterations=15)
        near = np.zeros((K, S, patterns.weights.shape[1]), dtype=bool)
        for _ in range(_PASSES):
            before, (_, near) = near, self._near(which, product)
            if (near == before).all():
                break
            weights = np.where(near.reshape(K * S, -1), patterns.weights, 0.0)
            flat = product.reshape(K * S, 3, -1)
            product = _trained(replace(patterns, weights=weights), flat, options).reshape(product.shape)
        return product, *self._near(which, product)

    def _enter(self, which: NDArray[np.intp], product: Array, scale: Array, near: NDArray[np.bool_]) -> None:
        """Compare one start of each view with the best so far, and keep the one with the lower median."""
        same = ((near == self.near[which]) | ~self.real[which]).sum(1) >= _AGREED * near.shape[1]
        # Two failed starts with a large scatter also agree, because then all points are near.
        same &= self.scale[which] < _TIGHT * self.spread[which]
        better = scale < self.scale[which]
        self.agreed[which] = np.where(same, self.agreed[which] + 1, np.where(better, 1, self.agreed[which]))
        won = which[better]
        self.product[won], self.scale[won], self.near[won] = product[better], scale[better], near[better]

    def _near(self, which: NDArray[np.intp], product: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Robust standard deviation (K', S) of the points from their networks; the points near (K', S, n)."""
        o = self.patterns.inputs[which][:, None] @ np.swapaxes(product, -1, -2)
        distance = self._distance(o, self.patterns.targets[which][:, None])
        real = np.broadcast_to(self.real[which][:, None], distance.shape)
        ordered = np.sort(np.where(real, distance, np.inf), axis=-1)
        middle = (real.sum(axis=-1, keepdims=True) - 1) // 2
        # The median length of two normal errors is 1.18 sigma.
        scale = np.take_along_axis(ordered, middle, axis=-1)[..., 0] / 1.1774 + 1e-9
        return scale, real & (distance < _FAR * scale[..., None])

    def _distance(self, o: Array, targets: Array) -> Array:
        """Between outputs and targets: in the image, or the sine of the angle between rays."""
        with np.errstate(all="ignore"):
            if self.views.rays is None:
                error = np.hypot(*np.moveaxis(o[..., :2] / o[..., 2:] - targets[..., :2], -1, 0))
            else:
                along = (o * targets).sum(axis=-1, keepdims=True)
                across = o - along * targets
                error = np.sqrt((across * across).sum(axis=-1) / (o * o).sum(axis=-1))
                # The sign of a product is arbitrary.
                same_side = along[..., 0] * along.sum(axis=-2) > 0
                error = np.where(same_side, error, np.nan)
        return np.where(np.isfinite(error), error, 1e9)

    def judge(self, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Write the points near their network into `kept`; return the views that are wrong as a whole."""
        hopeless = np.zeros(len(self.members), dtype=bool)
        everything = self.views.targets
        for k, view in enumerate(self.members):
            rows = slice(self.views.first[view], self.views.first[view] + self.views.counts[view])
            local = self.views.local[rows]
            if self.flat:
                local = (local @ self.views.basis[view])[:, :2]
            o = np.column_stack([local, np.ones(len(local))]) @ self.product[k].T
            targets = everything[rows]
            near = self._distance(o, targets) < _FAR * self.scale[k]
            extent = np.sqrt(targets[near].var(axis=0).sum()) if near.any() else 0.0
            hopeless[k] = near.mean() <= _MAJORITY or self.scale[k] > _TIGHT * extent
            kept[rows] = near
        return hopeless


def _trained(patterns: Patterns, product: Array, options: LMOptions) -> Array:
    """Train the products W V themselves, with W the identity."""
    n, inputs = len(product), product.shape[2]
    W = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
    free = np.ones((3, 3), dtype=bool), np.ones((3, inputs), dtype=bool)
    return train_lm(Task(patterns, W, product, *free), options).product

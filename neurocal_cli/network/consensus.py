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

# Repeated by test_outlier_rejection.py (slow: 200 scenes with a fifth of the points wrong, 105 sets
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
            patterns = patterns_of(views, some, flat, _MOST_SEEN, rng)
            seen = np.where((patterns.weights > 0)[..., None], patterns.targets, np.nan)
            spread = np.sqrt(np.nanvar(seen, axis=1).sum(axis=1))
            product, scale = _search(patterns, spread, flat, views.rays is not None, rng)
            hopeless[some] = _judge(views, some, flat, product, scale, kept)
            # If all pixels of a view coincide, its scatter is undefined.
            loose[some] = np.divide(scale, spread, np.full(len(some), np.inf), where=spread > 0)
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
    with the smallest scatter is used. `pinhole` is the consensus without a lens, and is returned unless its
    scatter is as large as a lens makes it, so that some view is hopeless, and a lens reduces it decidedly.
    `middle` (2,) is the assumed position of the optical axis, in normalised pixels.
    """
    if not pinhole.hopeless.any() or pinhole.looseness < _LOOSE:
        return pinhole
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


def _search(
    patterns: Patterns, spread: Array, flat: bool, rays: bool, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Products (K, 3, I) of the robust networks of K views of one kind, flat or solid, and their `_scatter`.

    The rounds of a view end when two of its starts agree on the same points. `spread` (K,) is the size of
    each view; `rays` tells that the targets are rays, not pixels.
    """
    real = patterns.weights > 0
    K, n = real.shape
    product, scale = np.zeros((K, 3, patterns.n_inputs)), np.full(K, np.inf)
    near, agreed = np.zeros((K, n), dtype=bool), np.zeros(K, dtype=np.int64)
    which = np.arange(K)
    for _ in range(_ROUNDS):
        if not which.size:
            break
        some = patterns.take(which)
        starts = _few_points(some, flat, rng)
        order = np.argsort(_scatter(some, starts, rays)[0], axis=1, kind="stable")[:, :_FINALISTS]
        finalists = np.take_along_axis(starts, order[..., None, None], axis=1)
        finalists, scales, nears = _learn_on_near(some, finalists, rays)
        # Compare each finalist with the best so far, and keep the one with the lower median.
        for start in range(finalists.shape[1]):
            new_scale, new_near = scales[:, start], nears[:, start]
            same = ((new_near == near[which]) | ~real[which]).sum(1) >= _AGREED * n
            # Two failed starts with a large scatter also agree, because then all points are near.
            same &= scale[which] < _TIGHT * spread[which]
            better = new_scale < scale[which]
            agreed[which] = np.where(same, agreed[which] + 1, np.where(better, 1, agreed[which]))
            won = which[better]
            product[won], scale[won], near[won] = (
                finalists[better, start],
                new_scale[better],
                new_near[better],
            )
        which = which[agreed[which] < 2]
    return product, scale


def _few_points(patterns: Patterns, flat: bool, rng: np.random.Generator) -> Array:
    """Products (K, S, 3, I) of S starts of each view, from random weights on a few points each."""
    real, seen = patterns.weights > 0, _SEEN[flat]
    K = len(real)
    key = rng.random((K, _STARTS, real.shape[1])) + 2.0 * ~real[:, None]
    slots = np.argpartition(key, seen, axis=2)[..., :seen].reshape(K, -1)
    chosen = (
        np.take_along_axis(patterns.inputs, slots[..., None], axis=1),
        np.take_along_axis(patterns.targets, slots[..., None], axis=1),
        np.ones(slots.shape),
    )
    few = Patterns(*(a.reshape(K * _STARTS, seen, *a.shape[2:]) for a in chosen))
    W, V = random_weights(rng, len(few.weights), few.n_inputs)
    product = _trained(few, W @ V, LMOptions(tolerance=1e-4, max_iterations=40))
    return product.reshape(K, _STARTS, 3, few.n_inputs)


def _learn_on_near(patterns: Patterns, product: Array, rays: bool) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Train products (K, S, 3, I) repeatedly on all points near each network; also their `_scatter`."""
    K, S = product.shape[:2]
    repeated = patterns.take(np.repeat(np.arange(K), S))
    options = LMOptions(stiffness=(0.0,), tolerance=1e-3, damping=1e-6, max_iterations=15)
    near = np.zeros((K, S, patterns.weights.shape[1]), dtype=bool)
    for _ in range(_PASSES):
        before, (_, near) = near, _scatter(patterns, product, rays)
        if (near == before).all():
            break
        weights = np.where(near.reshape(K * S, -1), repeated.weights, 0.0)
        flat = product.reshape(K * S, 3, -1)
        product = _trained(replace(repeated, weights=weights), flat, options).reshape(product.shape)
    return product, *_scatter(patterns, product, rays)


def _trained(patterns: Patterns, product: Array, options: LMOptions) -> Array:
    """Train the products W V themselves, with W the identity."""
    n, inputs = len(product), product.shape[2]
    W = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
    free = np.ones((3, 3), dtype=bool), np.ones((3, inputs), dtype=bool)
    return train_lm(Task(patterns, W, product, *free), options).product


def _scatter(patterns: Patterns, product: Array, rays: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Robust standard deviation (K, S) of the points from their networks; the points near (K, S, n)."""
    o = patterns.inputs[:, None] @ np.swapaxes(product, -1, -2)
    distance = _distance(o, patterns.targets[:, None], rays)
    real = np.broadcast_to((patterns.weights > 0)[:, None], distance.shape)
    ordered = np.sort(np.where(real, distance, np.inf), axis=-1)
    middle = (real.sum(axis=-1, keepdims=True) - 1) // 2
    # The median length of two normal errors is 1.18 sigma.
    scale = np.take_along_axis(ordered, middle, axis=-1)[..., 0] / 1.1774 + 1e-9
    return scale, real & (distance < _FAR * scale[..., None])


def _distance(o: Array, targets: Array, rays: bool) -> Array:
    """Between outputs and targets: in the image, or the sine of the angle between rays."""
    with np.errstate(all="ignore"):
        if rays:
            along = (o * targets).sum(axis=-1, keepdims=True)
            across = o - along * targets
            error = np.sqrt((across * across).sum(axis=-1) / (o * o).sum(axis=-1))
            # The sign of a product is arbitrary.
            same_side = along[..., 0] * along.sum(axis=-2) > 0
            error = np.where(same_side, error, np.nan)
        else:
            error = np.hypot(*np.moveaxis(o[..., :2] / o[..., 2:] - targets[..., :2], -1, 0))
    return np.where(np.isfinite(error), error, 1e9)


def _judge(
    views: Views,
    members: NDArray[np.intp],
    flat: bool,
    product: Array,
    scale: Array,
    kept: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Write the points near their view's network into `kept`; return the views that are wrong as a whole."""
    hopeless = np.zeros(len(members), dtype=bool)
    everything = views.targets
    for k, view in enumerate(members):
        rows = slice(views.first[view], views.first[view] + views.counts[view])
        local = views.local[rows]
        if flat:
            local = (local @ views.basis[view])[:, :2]
        o = np.column_stack([local, np.ones(len(local))]) @ product[k].T
        targets = everything[rows]
        near = _distance(o, targets, views.rays is not None) < _FAR * scale[k]
        extent = np.sqrt(targets[near].var(axis=0).sum()) if near.any() else 0.0
        hopeless[k] = near.mean() <= _MAJORITY or scale[k] > _TIGHT * extent
        kept[rows] = near
    return hopeless

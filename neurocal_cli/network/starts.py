"""Random starts: networks and cameras from random weights.

Training from random weights may end in a local minimum. Two starts that end at the same lowest loss, with all
points on the same side of the camera, have most probably found the global minimum.

Some data cannot train a free network. A product W V has 11 degrees of freedom. With fewer points than it
needs, or with all points but one in a plane, the points may still determine a pose (type 3) or a camera with
a given centre (type 2). Then random weights are converted to a camera at once: V's left block becomes the
nearest rotation, and its last column follows from the linear conditions of the pixels on t. Each start
minimises the reprojection error (3).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.views import PointBatches, Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.network import Patterns, Task, Trained, Trainer, patterns_of, random_weights


@frozen_dataclass
class Agreement:
    """Tolerances within which two losses are the same."""

    relative: float = 1e-4  # difference in rms error, as a share of it
    absolute: float = 1e-10  # the same in normalised pixels, the accuracy of the trainer


@frozen_dataclass(eq=False)
class Learnt:
    """The best network of each of K views."""

    W: Array  # (K, 3, 3)
    V: Array  # (K, 3, I)
    rms: Array  # (K,) network error in normalised pixels
    in_front: NDArray[np.bool_]  # (K,) whether all points are on one side of the camera
    starts: NDArray[np.int64]  # (K,)
    agreed: NDArray[np.int64]  # (K,) number of starts that ended at the best loss
    iterations: int  # of all the starts together
    curve: Array  # rms error of the best start of the first view along its training

    @property
    def product(self) -> Array:
        """W V of each view; (K, 3, I)."""
        return self.W @ self.V


def learn(
    patterns: Patterns,
    trainer: Trainer,
    rng: np.random.Generator,
    limit: int,
    agreement: Agreement | None = None,
    *,
    W: Array | None = None,
    V: Array | None = None,
) -> Learnt:
    """Train each network from random weights until two starts agree, with `limit` >= 2 starts at most.

    W (3, 3) are output weights that are given, nan where they are not, and V (1, 3, I) hidden weights.
    """
    agreement = agreement or Agreement()
    K = len(patterns.weights)
    best = Learnt(
        W=np.zeros((K, 3, 3)),
        V=np.zeros((K, 3, patterns.n_inputs)),
        rms=np.full(K, np.inf),
        in_front=np.zeros(K, dtype=bool),
        starts=np.zeros(K, dtype=np.int64),
        agreed=np.zeros(K, dtype=np.int64),
        iterations=0,
        curve=np.zeros(0),
    )
    free_W = np.ones((3, 3), dtype=bool) if W is None else np.isnan(W)
    free_V = np.full((3, patterns.n_inputs), V is None)
    views = np.arange(K)
    round_size = 2
    while views.size:
        count = min(round_size, limit - int(best.starts[views[0]]))
        if count <= 0:
            break
        many = patterns.take(np.repeat(views, count))
        random_W, random_V = random_weights(rng, len(many.weights), many.n_inputs)
        if W is not None:
            random_W = np.where(free_W, random_W, W)
        if V is not None:
            random_V = np.repeat(V, len(random_V), axis=0)
        trained = trainer(Task(many, random_W, random_V, free_W, free_V))
        best = _best_of(best, views, many, trained, agreement)
        views = views[best.agreed[views] < 2]
        round_size = 4
    return best


def _best_of(
    best: Learnt, views: NDArray[np.intp], patterns: Patterns, trained: Trained, agreement: Agreement
) -> Learnt:
    """Compare new starts of these views with the best so far, whose arrays are updated in place.

    A start with all points on one side of the camera is better than one without.
    """
    count = len(trained.W) // len(views)
    depth = (patterns.inputs @ (trained.W[:, 2:] @ trained.V).swapaxes(1, 2))[..., 0]
    real = patterns.weights > 0
    all_rms = patterns.rms(trained.loss)
    # A loss that overflowed to nan must not be chosen.
    all_front = ((~real | (depth > 0)).all(1) | (~real | (depth < 0)).all(1)) & np.isfinite(all_rms)
    best.starts[views] += count
    curve = best.curve
    for start in range(count):
        which = slice(start, None, count)
        rms, in_front = all_rms[which], all_front[which]
        old, old_front = best.rms[views], best.in_front[views]
        close = agreement.relative * np.minimum(rms, old) + agreement.absolute
        with np.errstate(invalid="ignore"):
            same = in_front & old_front & (np.abs(rms - old) <= close)
        wins = ~same & ((in_front & ~old_front) | ((in_front == old_front) & (rms < old)))
        won = views[wins]
        best.agreed[views[same]] += 1
        best.agreed[won] = in_front[wins]
        best.W[won], best.V[won] = trained.W[which][wins], trained.V[which][wins]
        best.rms[won], best.in_front[won] = rms[wins], in_front[wins]
        if won.size and won[0] == 0:
            first = patterns.take(np.zeros(len(trained.curve), dtype=np.intp))
            curve = first.rms(trained.curve[:, start])
    return replace(best, iterations=best.iterations + int(trained.iterations.sum()), curve=curve)


# Repeated by test_convergence.py, whose scenes of 3 to 8 points begin here.
_MOST_POINTS = 64
_NEAREST = 1.2  # least depth of the target's centre, in target radii
_TIE = 1e-4  # relative difference within which two costs are equal
# With hardly more equations than unknowns several minima fit well, and two starts may agree on a wrong one.
# So this many starts are always trained, side by side, before their results are compared.
_BATCH = 48
_POSE_STEPS = 50  # of a pose: starts that have not settled by then are not at the best minimum


@frozen_dataclass(eq=False)
class Found:
    """Best random starts of K views."""

    state: CameraState
    agreed: NDArray[np.int64]  # (K,) number of starts with the lowest cost
    starts: int
    iterations: int


def find_poses(
    views: Views, which: NDArray[np.intp], entries: Array, rng: np.random.Generator, starts: int
) -> Found:
    """Poses of the views `which` (K,) for known intrinsics, all starts of all views side by side.

    `entries` (1, 5) are the normalised A11, A12, A22, A13, A23, and `starts` is the number for each view.
    """
    patterns = patterns_of(views, which, flat=False, most=_MOST_POINTS, rng=rng)
    many = patterns.take(np.repeat(np.arange(len(which)), starts))
    R = nearest_rotation(rng.uniform(-1, 1, (len(many.weights), 3, 3)))
    state = CameraState(entries, R, _translation(entries, R, many))
    adjusted = adjust(_as_batches(many), state, np.zeros(5, dtype=bool), max_iterations=_POSE_STEPS)
    cost = adjusted.cost.reshape(len(which), starts)
    best = cost.argmin(axis=1)
    lowest = cost[np.arange(len(which)), best]
    agreed = (cost <= lowest[:, None] * (1 + _TIE) + 1e-20).sum(axis=1)
    chosen = np.arange(len(which)) * starts + best
    state = CameraState(entries, adjusted.state.R[chosen], adjusted.state.t[chosen])
    return Found(state, agreed, starts * len(which), adjusted.iterations)


def find_camera(
    views: Views, given: Array, free: NDArray[np.bool_], rng: np.random.Generator, starts: int
) -> Found | None:
    """Intrinsics and pose of a single view, by batches of starts until two agree; None if none converged.

    `given` (5,) are the normalised entries where `free` (5,) is False. A new batch is started only after
    fewer than `starts` starts.
    """
    patterns = patterns_of(views, np.array([0]), flat=False, most=_MOST_POINTS, rng=rng)
    best, cost, agreed, iterations, used = None, np.inf, 0, 0, 0
    while used < starts and agreed < 2:
        many = patterns.take(np.zeros(_BATCH, dtype=np.intp))
        used += _BATCH
        entries = np.where(free, rng.uniform(-1, 1, (_BATCH, 5)), given)
        # A focal length of 0.5 to 20 image half-widths covers every lens; no skew at first.
        focal = 0.5 * 40.0 ** rng.random(_BATCH)
        entries[:, [0, 2]] = np.where(free[[0, 2]], focal[:, None], entries[:, [0, 2]])
        entries[:, 1] = 0.0 if free[1] else given[1]
        R = nearest_rotation(rng.uniform(-1, 1, (_BATCH, 3, 3)))
        batches = _as_batches(many)
        # The pose first, then everything.
        state = CameraState(entries, R, _translation(entries, R, many))
        posed = adjust(batches, state, np.zeros(5, dtype=bool))
        trained = adjust(batches, posed.state, free)
        iterations += posed.iterations + trained.iterations
        total = np.where(trained.each_settled, trained.cost, np.inf)
        n = int(total.argmin())
        if not np.isfinite(total[n]):
            continue
        if total[n] < cost * (1 - _TIE) - 1e-20:
            best, cost, agreed = trained.state.of_view(n), float(total[n]), 0
        agreed += int((total <= cost * (1 + _TIE) + 1e-20).sum())
    if best is None:
        return None
    return Found(best, np.array([agreed]), used, iterations)


def _as_batches(patterns: Patterns) -> PointBatches:
    """One batch for each network."""
    networks = np.arange(len(patterns.weights))
    root = np.sqrt(patterns.weights)
    whitening = np.stack([root, np.zeros_like(root), root], axis=1)
    local = np.ascontiguousarray(np.swapaxes(patterns.inputs[..., :3], 1, 2))
    pixels = np.ascontiguousarray(np.swapaxes(patterns.targets[..., :2], 1, 2))
    counts = (patterns.weights > 0).sum(axis=1)
    return PointBatches(local, pixels, whitening, networks, networks, counts)


def _translation(entries: Array, R: Array, patterns: Patterns) -> Array:
    """Estimate t from the pixels by linear least squares, given R; the target is moved in front.

    With the ray (x, y) of a pixel: t1 - x t3 = x Y3 - Y1 and t2 - y t3 = y Y3 - Y2, Y = R M.
    """
    a, s, b, u0, v0 = np.atleast_2d(entries).T[..., None]
    w = patterns.weights
    y = (patterns.targets[..., 1] - v0) / b
    x = (patterns.targets[..., 0] - u0 - s * y) / a
    Y = patterns.inputs[..., :3] @ np.swapaxes(R, 1, 2)
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate([np.stack([one, zero, -x], -1), np.stack([zero, one, -y], -1)], axis=1)
    right = np.concatenate([x * Y[..., 2] - Y[..., 0], y * Y[..., 2] - Y[..., 1]], axis=1)
    weighted = np.swapaxes(rows * np.concatenate([w, w], axis=1)[..., None], 1, 2)
    t = np.linalg.solve(weighted @ rows + 1e-12 * np.eye(3), weighted @ right[..., None])[..., 0]
    radius = np.abs(Y).max(axis=(1, 2))
    t[:, 2] = np.maximum(np.abs(t[:, 2]), _NEAREST * radius)
    total = w.sum(axis=1)
    t[:, 0] = (w * x).sum(axis=1) / total * t[:, 2]
    t[:, 1] = (w * y).sum(axis=1) / total * t[:, 2]
    return t

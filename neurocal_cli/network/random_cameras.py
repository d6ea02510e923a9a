"""Random starting cameras, for data that cannot train a free network.

A product W V has 11 degrees of freedom. With fewer points than it needs, or with all points but one in a
plane, the points may still determine a pose (type 3) or a camera with a given centre (type 2). Then random
weights are converted to a camera at once: V's left block becomes the nearest rotation, and its last column
follows from the linear conditions of the pixels on t. Each start minimises the reprojection error (3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.views import PointBatches, Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.network import Patterns, patterns_of

# Repeated by test_convergence.py, whose scenes of 3 to 8 points begin here.
_MOST_POINTS = 64
_NEAREST = 1.2  # least depth of the target's centre, in target radii
_TIE = 1e-4  # relative difference within which two costs are equal
# With hardly more equations than unknowns several minima fit well, and two starts may agree on a wrong one.
# So this many starts are always trained, side by side, before their results are compared.
_BATCH = 48


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
    adjusted = adjust(_as_batches(many), state, np.zeros(5, dtype=bool))
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

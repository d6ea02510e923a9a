"""Random starts, repeated until two of them agree.

Training from random weights may end in a local minimum. Two starts that end at the same lowest loss, with all
points on the same side of the camera, have most probably found the global minimum.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.network import Patterns, Task, Trained, Trainer, random_weights


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

"""Random starts, repeated until two of them agree.

Training from random weights may end in a local minimum. Two starts that end at the same lowest loss, with all
points on the same side of the camera, have most probably found the global minimum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.network import Patterns, random_weights
from neurocal_cli.training import Task, Trained, Trainer


@frozen_dataclass
class Agreement:
    """Tolerances within which two losses are the same.

    Parameters
    ----------
    relative : float
        Difference in rms error, as a share of it.
    absolute : float
        The same in normalised pixels, the accuracy of the trainer.
    """

    relative: float = 1e-4
    absolute: float = 1e-10


@frozen_dataclass(eq=False)
class Learnt:
    """The best network of each view.

    Attributes
    ----------
    W : (K, 3, 3) array
    V : (K, 3, I) array
    rms : (K,) array
        Network error in normalised pixels.
    starts, agreed : (K,) int arrays
        Number of starts, and number of those that ended at the best loss.
    iterations : int
        Of all the starts together.
    curve : (J,) array
        Rms error of the best start of the first view along its training.
    """

    W: Array
    V: Array
    rms: Array
    starts: NDArray[np.int64]
    agreed: NDArray[np.int64]
    iterations: int
    curve: Array

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
    """Train each network from random weights until two starts agree, with `limit` starts at most.

    Parameters
    ----------
    patterns : Patterns
        Of K networks.
    trainer : Trainer
    rng : numpy.random.Generator
    limit : int
        Most starts for each network, at least 2.
    agreement : Agreement, optional
    W : (3, 3) array, optional
        Output weights that are given; nan where they are not.
    V : (1, 3, I) array, optional
        Hidden weights that are given.
    """
    search = _BestStarts(patterns, trainer, rng, agreement or Agreement(), W, V)
    open_views = np.arange(len(patterns.weights))
    round_size = 2
    while open_views.size:
        used = int(search.starts[open_views[0]])
        count = min(round_size, limit - used)
        if count <= 0:
            break
        search.train(open_views, count)
        open_views = open_views[search.agreed[open_views] < 2]
        round_size = 4
    return search.result()


class _BestStarts:
    def __init__(
        self,
        patterns: Patterns,
        trainer: Trainer,
        rng: np.random.Generator,
        agreement: Agreement,
        given_W: Array | None,
        given_V: Array | None,
    ) -> None:
        K = len(patterns.weights)
        self.patterns, self.trainer, self.rng, self.agreement = patterns, trainer, rng, agreement
        self.given_W, self.given_V = given_W, given_V
        self.W = np.zeros((K, 3, 3))
        self.V = np.zeros((K, 3, patterns.n_inputs))
        self.rms = np.full(K, np.inf)
        self.in_front = np.zeros(K, dtype=bool)
        self.starts = np.zeros(K, dtype=np.int64)
        self.agreed = np.zeros(K, dtype=np.int64)
        self.iterations = 0
        self.curve = np.zeros(0)

    def train(self, views: NDArray[np.intp], count: int) -> None:
        """Train `count` more starts of each of these views."""
        networks = np.repeat(views, count)
        patterns = self.patterns.take(networks)
        W, V = random_weights(self.rng, len(networks), patterns.n_inputs)
        free_W, free_V = np.ones((3, 3), dtype=bool), np.ones((3, patterns.n_inputs), dtype=bool)
        if self.given_W is not None:
            free_W = np.isnan(self.given_W)
            W = np.where(free_W, W, self.given_W)
        if self.given_V is not None:
            free_V[:] = False
            V = np.repeat(self.given_V, len(networks), axis=0)
        trained = self.trainer(Task(patterns, W, V, free_W, free_V))
        self.iterations += int(trained.iterations.sum())
        self.starts[views] += count
        depth = (patterns.inputs @ (trained.W[:, 2:] @ trained.V).swapaxes(1, 2))[..., 0]
        real = patterns.weights > 0
        rms = patterns.rms(trained.loss)
        # A loss that overflowed to nan must not be chosen.
        in_front = ((~real | (depth > 0)).all(1) | (~real | (depth < 0)).all(1)) & np.isfinite(rms)
        for start in range(count):
            self._keep(views, slice(start, None, count), trained, rms, in_front, start)

    def _keep(
        self,
        views: NDArray[np.intp],
        which: slice,
        trained: Trained,
        rms: Array,
        in_front: NDArray[np.bool_],
        start: int,
    ) -> None:
        """Compare one start of each view with its best so far; all points on one side is better."""
        rms, in_front = rms[which], in_front[which]
        old, old_front = self.rms[views], self.in_front[views]
        close = self.agreement.relative * np.minimum(rms, old) + self.agreement.absolute
        with np.errstate(invalid="ignore"):
            same = in_front & old_front & (np.abs(rms - old) <= close)
        wins = ~same & ((in_front & ~old_front) | ((in_front == old_front) & (rms < old)))
        self.agreed[views] = np.where(same, self.agreed[views] + 1, self.agreed[views])
        won = views[wins]
        self.agreed[won] = in_front[wins]
        self.W[won], self.V[won] = trained.W[which][wins], trained.V[which][wins]
        self.rms[won], self.in_front[won] = rms[wins], in_front[wins]
        if won.size and won[0] == 0:
            self.curve = self.patterns.take(np.zeros(len(trained.curve), dtype=np.intp)).rms(
                trained.curve[:, start]
            )

    def result(self) -> Learnt:
        """The best start of each view."""
        return Learnt(self.W, self.V, self.rms, self.starts, self.agreed, self.iterations, self.curve)

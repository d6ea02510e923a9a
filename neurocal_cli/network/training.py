"""Patterns: the points of views as a network learns them, normalised and with equally many for each view.

Trainers of the calibrating network, and their interface: patterns and weights, but no cameras.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


@frozen_dataclass(eq=False)
class Patterns:
    """Training data of a stack of G networks."""

    inputs: Array  # (G, N, I) normalised world points, with the last input 1; shared if G is 1
    targets: Array  # (G, N, 3) normalised pixels (u, v, 1)
    weights: Array  # (G, N) weight w_i of each pattern; 0 for padding

    @property
    def n_inputs(self) -> int:
        """I: 4 for points in space, 3 for points of a plane."""
        return self.inputs.shape[2]

    def take(self, networks: NDArray[np.intp]) -> Patterns:
        """Patterns of some of the networks."""
        return Patterns(self.inputs[networks], self.targets[networks], self.weights[networks])

    def rms(self, loss: Array) -> Array:
        """Root mean square error of each network whose E_2D is `loss`; (G,)."""
        return np.sqrt(2 * loss / np.maximum(self.weights.sum(axis=1), 1e-300))


def patterns_of(
    views: Views, members: NDArray[np.intp], flat: bool, most: int, rng: np.random.Generator | None = None
) -> Patterns:
    """Training patterns of some views' networks, at most `most` of each view.

    If a view has more points, one is drawn from each of `most` equal stretches of its rows, at random or,
    without a generator, the middle one. Views with fewer points than the others are padded with weight 0.
    """
    n = views.counts[members]
    width = min(int(n.max()), most)
    slot = np.arange(width)
    inside = 0.5 if rng is None else rng.random((len(members), width))
    stretch = np.maximum(n / width, 1.0)[:, None]
    rank = np.minimum((slot + inside * (stretch > 1)) * stretch, n[:, None] - 1).astype(np.intp)
    rows = views.first[members][:, None] + rank
    local = views.local[rows]
    if flat:
        local = (local @ views.basis[members])[:, :, :2]
    ones = np.ones((*rows.shape, 1))
    weights = np.where(slot < n[:, None], views.weights[rows], 0.0)
    targets = np.concatenate([views.pixels[rows], ones], axis=2) if views.rays is None else views.rays[rows]
    return Patterns(np.concatenate([local, ones], axis=2), targets, weights)


@frozen_dataclass(eq=False)
class Task:
    """A stack of G networks to train on E_2D from given initial weights."""

    patterns: Patterns
    W: Array  # (G, 3, 3) initial output weights
    V: Array  # (G, 3, I) initial hidden weights
    free_W: NDArray[np.bool_]  # (3, 3) which weights are free; the others keep their initial values
    free_V: NDArray[np.bool_]  # (3, I) the same


@frozen_dataclass(eq=False)
class Trained:
    """G networks after training."""

    W: Array  # (G, 3, 3)
    V: Array  # (G, 3, I)
    gamma: Array  # (G, N) factor of each pattern
    loss: Array  # (G,) E_2D
    iterations: NDArray[np.int64]  # (G,) iterations (epochs of back-propagation) of each network
    settled: NDArray[np.bool_]  # (G,) whether training converged before its limit of iterations
    curve: Array  # (K, G) loss of each network along its training

    @property
    def product(self) -> Array:
        """W V, which determines the network's output; (G, 3, I)."""
        return self.W @ self.V


Trainer = Callable[[Task], Trained]
"""A function that lowers E_2D from the task's initial weights."""

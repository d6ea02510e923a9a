"""Trainers of the calibrating network, and their interface: patterns and weights, but no cameras."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.patterns import Patterns


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

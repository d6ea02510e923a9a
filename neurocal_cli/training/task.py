"""The interface between the calibrating network and its trainers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.network import Patterns


@frozen_dataclass(eq=False)
class Task:
    """A stack of networks to train on E_2D from given initial weights.

    Parameters
    ----------
    patterns : Patterns
        Of G networks.
    W : (G, 3, 3) array
        Initial output weights.
    V : (G, 3, I) array
        Initial hidden weights.
    free_W, free_V : bool arrays (3, 3) and (3, I)
        Which weights are free; the others keep their initial values.
    """

    patterns: Patterns
    W: Array
    V: Array
    free_W: NDArray[np.bool_]
    free_V: NDArray[np.bool_]


@frozen_dataclass(eq=False)
class Trained:
    """Networks after training.

    Attributes
    ----------
    W : (G, 3, 3) array
    V : (G, 3, I) array
    gamma : (G, N) array
        Factor of each pattern.
    loss : (G,) array
        E_2D.
    iterations : (G,) int array
        Iterations (epochs of back-propagation) of each network.
    settled : (G,) bool array
        Whether training converged before its limit of iterations.
    curve : (K, G) array
        Loss of each network along its training.
    """

    W: Array
    V: Array
    gamma: Array
    loss: Array
    iterations: NDArray[np.int64]
    settled: NDArray[np.bool_]
    curve: Array

    @property
    def product(self) -> Array:
        """W V, which determines the network's output; (G, 3, I)."""
        return self.W @ self.V


class Trainer(Protocol):
    """A function that trains a stack of networks."""

    def __call__(self, task: Task) -> Trained:
        """Lower E_2D from the task's initial weights."""
        ...

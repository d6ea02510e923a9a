"""Gradients of the network's error, as the paper writes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.network import Patterns


@dataclass(frozen=True, eq=False)
class Gradients:
    """Derivatives of E_2D by W (G, 3, 3), V (G, 3, I) and gamma (G, N)."""

    W: Array
    V: Array
    gamma: Array


def gradients(W: Array, V: Array, gamma: Array, patterns: Patterns) -> Gradients:
    """Exact gradient of E_2D; (9)-(11) are its negative for a single pattern."""
    Z, w = patterns.inputs, patterns.weights
    Y = Z @ np.swapaxes(V, -1, -2)  # hidden outputs, eq. (6)
    o = Y @ np.swapaxes(W, -1, -2)
    error = w[..., None] * (patterns.targets - gamma[..., None] * o)
    scaled = gamma[..., None] * error
    return Gradients(
        W=-np.swapaxes(scaled, -1, -2) @ Y,  # eq. (9)
        V=-np.swapaxes(scaled @ W, -1, -2) @ Z,  # eq. (10)
        gamma=-(error * o).sum(-1),  # eq. (11)
    )

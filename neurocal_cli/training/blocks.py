"""The learning rule in blocks of patterns, in NumPy: what trains where numba is missing.

Plain Python spends 15 us on a pattern, 700 times the compiled kernel. A block's changes are summed
at the rule's own rates, as if its patterns had been presented at once; blocks of 8 are small enough
to be as stable as single patterns at the default rates, and a stack of networks shares the cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.network import e_orth_gradient

__all__ = ["BLOCK", "present"]

BLOCK = 8

Mask = NDArray[np.bool_]


def _blocks(used: int) -> Iterator[slice]:
    """Slices of nearly equal length, none above `BLOCK`."""
    edges = np.linspace(0, used, -(-used // BLOCK) + 1).astype(int)
    return (slice(start, stop) for start, stop in pairwise(edges))


def present(
    Z: Array, d: Array, w: Array, W: Array, V: Array, gamma: Array, free_W: Mask, free_V: Mask,
    rate_weights: Array, rate_gamma: Array, pull: float, a: float, epochs: int, used: NDArray[np.int64],
    active: Mask,
) -> None:  # fmt: skip
    """Let the active networks of a stack learn in place; the arguments of `rule.present`."""
    W_, V_, gamma_ = W[active], V[active], gamma[active]
    rate, rate_factor = rate_weights[active, None, None], rate_gamma[active, None]
    move_W, move_V = rate * free_W, rate * free_V
    parts = [
        (Z[active, s], d[active, s], w[active, s, None], gamma_[:, s], s.stop - s.start)
        for s in _blocks(int(used[active].max()))
    ]
    for _ in range(epochs):
        for z, target, weight, factor, size in parts:
            Y = z @ np.swapaxes(V_, 1, 2)  # eq. (6)
            o = Y @ np.swapaxes(W_, 1, 2)
            error = weight * (target - factor[..., None] * o)
            scaled = np.swapaxes(factor[..., None] * error, 1, 2)
            change_V = np.swapaxes(W_, 1, 2) @ (scaled @ z)
            if pull > 0:
                change_V -= size * pull * e_orth_gradient(V_, a)
            factor += rate_factor * (error * o).sum(-1)  # eq. (11)
            W_ += move_W * (scaled @ Y)  # eq. (9)
            V_ += move_V * change_V  # eq. (10)
    W[active], V[active], gamma[active] = W_, V_, gamma_

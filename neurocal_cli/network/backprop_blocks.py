"""Back-propagation in blocks of patterns, in NumPy, for installations without numba.

Plain Python takes 15 us for a pattern, 700 times the compiled kernel. The changes of a block are summed, as
if its patterns had been presented at once. Successive patterns would correct each other, but the changes of
a block add up. `stable_rate` therefore bounds the rate of the weights by the curvature of the loss. The
networks of a stack are trained together.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.network import e_orth_gradient

BLOCK = 8

# Steps of 2 over the curvature neither converge nor diverge; this is less, and the curvature an upper bound.
# test_blocks_do_not_diverge_by_the_rate_of_the_weights repeats it.
_STABLE = 1.5

Mask = NDArray[np.bool_]


def stable_rate(Z: Array, w: Array, W: Array, V: Array, gamma: Array, used: NDArray[np.int64]) -> Array:
    """Largest rate of W and V at which sums over blocks do not overshoot; (G,)."""
    weighted = Z * (w * gamma**2)[..., None]
    C = np.swapaxes(weighted, 1, 2) @ Z / used[:, None, None]
    by_W = np.linalg.norm(V @ C @ np.swapaxes(V, 1, 2), axis=(1, 2))
    by_V = np.linalg.norm(np.swapaxes(W, 1, 2) @ W, axis=(1, 2)) * np.linalg.norm(C, axis=(1, 2))
    return np.asarray(_STABLE / (BLOCK * np.maximum(by_W + by_V, 1e-300)))


def present(
    Z: Array, d: Array, w: Array, W: Array, V: Array, gamma: Array, free_W: Mask, free_V: Mask,
    rate_weights: Array, rate_gamma: Array, pull: float, a: float, epochs: int, used: NDArray[np.int64],
    active: Mask,
) -> None:  # fmt: skip
    """Train the active networks of a stack in place; the arguments are those of `backprop_kernel.present`."""
    W_, V_, gamma_ = W[active], V[active], gamma[active]
    rate, rate_factor = rate_weights[active, None, None], rate_gamma[active, None]
    move_W, move_V = rate * free_W, rate * free_V
    # Blocks of nearly equal length, none above `BLOCK`.
    most = int(used[active].max())
    edges = np.linspace(0, most, -(-most // BLOCK) + 1).astype(int)
    blocks = (slice(start, stop) for start, stop in pairwise(edges))
    parts = [(Z[active, s], d[active, s], w[active, s, None], gamma_[:, s], s.stop - s.start) for s in blocks]
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
    # Fixed weights stay the same to the last bit, even where 0 times a change is nan or -0 becomes 0.
    W[active], V[active] = np.where(free_W, W_, W[active]), np.where(free_V, V_, V[active])
    gamma[active] = gamma_

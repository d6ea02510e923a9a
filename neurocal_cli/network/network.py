"""The calibrating network of the paper's section 3: two linear layers and a factor for each pattern.

A pattern is a normalised world point ``Z = (X, Y, Z, 1)`` and its normalised pixel ``d = (u, v, 1)``. The
hidden layer has the weights V (3 x 4, the pose), the output layer W (3 x 3, the intrinsic matrix). The
paper's fourth hidden neuron is the constant 1. Its output weights are the zero column of A, so it is left
out. For a flat board the input Z is always 0. Its column of V is left out as well, and V is 3 x 3. With
o = W V Z the network's outputs are O = gamma o, eq. (7).

    E_2D = 1/2 sum_i w_i |d_i - gamma_i o_i|^2                                    eqs. (5), (8)

Every function takes a stack of networks: a leading axis of G networks, each with N patterns of I inputs. A
network is one view of a camera, or one random start of it. Its trainers (`levenberg_marquardt`, `backprop`)
know patterns and weights, but no cameras.

Index conventions: the paper swaps V's indices between (6) and (9)-(10) and W's between (10) and (15). Here
``V[j, l]`` goes from input l to hidden neuron j and ``W[k, j]`` from there to output k.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError


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


def random_weights(rng: np.random.Generator, networks: int, n_inputs: int) -> tuple[Array, Array]:
    """Initial weights, uniform in [-1, 1] as in the paper; W (G, 3, 3) and V (G, 3, I)."""
    return rng.uniform(-1, 1, (networks, 3, 3)), rng.uniform(-1, 1, (networks, 3, n_inputs))


def output(W: Array, V: Array, inputs: Array) -> Array:
    """O = W V Z before the factor gamma, eqs. (6) and (7); (G, N, 3)."""
    return inputs @ np.swapaxes(W @ V, -1, -2)


def optimal_gamma(o: Array, targets: Array) -> Array:
    """The factor that minimises |d - gamma o|^2, the fixed point of (11); (G, N)."""
    return np.asarray((targets * o).sum(-1) / (o * o).sum(-1))


def e_2d(W: Array, V: Array, gamma: Array, patterns: Patterns) -> Array:
    """E_2D, eq. (8) summed over the patterns; (G,)."""
    error = patterns.targets - gamma[..., None] * output(W, V, patterns.inputs)
    return np.asarray(0.5 * (patterns.weights * (error**2).sum(-1)).sum(-1))


def _rotation_part(V: Array) -> Array:
    """Columns of V that form the rotation; InputError for a flat board, whose third column is missing."""
    if V.shape[-1] != 4:
        raise InputError("E_orth needs V with four inputs; a flat board's V lacks a column of the rotation")
    return V[..., :, :3]


def e_orth(V: Array, a: float = 1.0) -> Array:
    """E_orth of eq. (14): deviation of the rows of V's rotation from orthonormal times sqrt(a); (G,)."""
    M = _rotation_part(V)
    gram = M @ np.swapaxes(M, -1, -2) - a * np.eye(3)
    upper = np.triu(np.ones((3, 3)))
    return np.asarray((upper * gram**2).sum((-2, -1)))


def e_orth_gradient(V: Array, a: float = 1.0) -> Array:
    """Exact gradient of E_orth by V, zero in the translation's column; (G, 3, I).

    Erratum of eq. (15): as printed, delta v_1j = (V_2j + V_3j) {(v_1.v_2) + (v_1.v_3)} adds the two
    products before it multiplies. The correct derivative multiplies each row by its own product,
    2 {(v_1.v_2) V_2j + (v_1.v_3) V_3j}. Rows 2 and 3 are alike.
    """
    M = _rotation_part(V)
    gram = M @ np.swapaxes(M, -1, -2) - a * np.eye(3)
    # 4 (|v_l|^2 - a) v_l from the diagonal, 2 (v_l . v_m) v_m from the rest.
    factor = 2.0 * (np.ones((3, 3)) + np.eye(3))
    gradient = np.zeros_like(V)
    gradient[..., :, :3] = (factor * gram) @ M
    return gradient

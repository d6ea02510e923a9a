"""One multi-layer feed-forward network (the paper's MLFN) from lens controls to one camera parameter.

Two hidden layers of tanh units and a linear output. Units of the first see one control each, so they
bend its scale; units of the second see the controls and the bent ones. The output sees both by direct
connections as well, so that without any hidden unit the network is a plane:

    r = (x, tanh(s x + c)),   g = tanh(U r + b),   y = v.g + q.r + o

Stacks of B networks of one topology are computed side by side: weights are (B, P).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import lgamma, log

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

__all__ = ["Topology", "respond", "respond_with_jacobian"]


@dataclass(frozen=True)
class Topology:
    """Which units a network has.

    Parameters
    ----------
    controls : int
        Inputs, D.
    own : int
        Units of the first hidden layer for each control.
    hidden : int
        Units of the second hidden layer, H.
    """

    controls: int
    own: int
    hidden: int

    @property
    def width(self) -> int:
        """R: what the second layer and the output see."""
        return self.controls * (1 + self.own)

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Places of s, c, U, b, v, q, o among the weights."""
        first, R, H = self.controls * self.own, self.width, self.hidden
        parts, start = {}, 0
        for name, count in (("s", first), ("c", first), ("U", H * R), ("b", H), ("v", H), ("q", R), ("o", 1)):
            parts[name] = slice(start, start + count)
            start += count
        return parts

    @property
    def n_weights(self) -> int:
        """P."""
        return self.parts["o"].stop

    @cached_property
    def groups(self) -> NDArray[np.int64]:
        """(P,) the prior that each weight is under; -1: the plane, which is free.

        Weights of one kind share a prior: s, c, the weights in U from each control, b, v, and q from
        the first layer.
        """
        D, R, H = self.controls, self.width, self.hidden
        group = np.full(self.n_weights, -1)
        group[self.parts["s"]], group[self.parts["c"]] = 0, 1
        source = np.concatenate([np.arange(D), np.repeat(np.arange(D), self.own)])
        group[self.parts["U"]] = np.tile(2 + source, H)
        group[self.parts["b"]], group[self.parts["v"]] = 2 + D, 3 + D
        group[self.parts["q"]] = np.where(np.arange(R) < D, -1, 4 + D)
        return group

    @property
    def n_groups(self) -> int:
        """How many priors there are."""
        return 5 + self.controls

    @property
    def log_symmetries(self) -> float:
        """Logarithm of the number of weight vectors that give the same function."""
        own = self.controls * (lgamma(self.own + 1) + self.own * log(2))
        return own + lgamma(self.hidden + 1) + self.hidden * log(2)

    def random_weights(self, count: int, rng: np.random.Generator) -> Array:
        """(count, P) weights to start from: hidden units at random, their outgoing weights small."""
        weights = rng.normal(size=(count, self.n_weights))
        weights[:, self.parts["v"]] *= 0.3
        weights[:, self.parts["q"]] *= 0.3
        weights[:, self.parts["o"]] = 0.0
        return weights


def respond(topology: Topology, weights: Array, x: Array) -> Array:
    """Outputs of a stack of networks.

    Parameters
    ----------
    topology : Topology
    weights : (B, P) array
    x : (n, D) array
        Controls, scaled to about [-1, 1].

    Returns
    -------
    y : (B, n) array
    """
    return _layers(topology, weights, x)[0]


def respond_with_jacobian(topology: Topology, weights: Array, x: Array) -> tuple[Array, Array]:
    """Outputs (B, n) and their derivatives by the weights (B, n, P)."""
    y, bent, r, g = _layers(topology, weights, x)
    part, D = topology.parts, topology.controls
    B, n, H = len(weights), len(x), topology.hidden
    U = weights[:, part["U"]].reshape(B, H, topology.width)
    by_sum = (1 - g * g) * weights[:, None, part["v"]]  # by the argument of each second-layer unit
    by_r = by_sum @ U + weights[:, None, part["q"]]
    by_argument = by_r[:, :, D:] * (1 - bent * bent)
    J = np.empty((B, n, topology.n_weights))
    J[:, :, part["s"]] = by_argument * np.repeat(x, topology.own, axis=1)
    J[:, :, part["c"]] = by_argument
    J[:, :, part["U"]] = (by_sum[..., None] * r[:, :, None]).reshape(B, n, -1)
    J[:, :, part["b"]], J[:, :, part["v"]], J[:, :, part["q"]], J[:, :, part["o"]] = by_sum, g, r, 1.0
    return y, J


def _layers(topology: Topology, weights: Array, x: Array) -> tuple[Array, Array, Array, Array]:
    """Output (B, n), first hidden layer (B, n, D own), what the second sees (B, n, R), second (B, n, H)."""
    part = topology.parts
    B, n, D = len(weights), *x.shape
    bent = np.tanh(
        weights[:, None, part["s"]] * np.repeat(x, topology.own, axis=1) + weights[:, None, part["c"]]
    )
    r = np.concatenate([np.broadcast_to(x, (B, n, D)), bent], axis=2)
    U = weights[:, part["U"]].reshape(B, topology.hidden, topology.width)
    g = np.tanh(r @ np.swapaxes(U, 1, 2) + weights[:, None, part["b"]])
    y = (g @ weights[:, part["v"], None] + r @ weights[:, part["q"], None])[..., 0] + weights[:, part["o"]]
    return y, bent, r, g

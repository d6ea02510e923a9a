"""A multi-layer feed-forward network (the paper's MLFN) from zoom and focus to one camera parameter.

The network has two hidden layers and a linear output. The first layer has one rational unit for each control
and tanh units of single controls. The tanh units of the second layer take the controls and the first layer.
The output takes all of them by direct connections, and products of two controls and of their rational units
(sigma-pi units). A network whose weights under a prior are 0 is a plane:

    h(x) = (1 - x^2) / (1 + tilt x),   tilt = 0.99 tanh(a),
    z = (x, h(x)),   r = (z, tanh(s x + c)),   g = tanh(U r + b),
    y = v.g + q.r + z'M z / 2 + o,   M = 0 but between two controls

The rational unit is made for optics. By Newton's formula, image distances and focal lengths are homographic
functions (A x + B) / (1 + C x) of the positions of groups of glass and of the object's distance. They rise
steeply towards a pole beyond the end of the range, at close focus or at the long end of a zoom. Tanh units
would need many settings there. Plane and rational unit together are all such functions, with the pole at
-1 / tilt, and all parabolas (tilt 0). The rational unit is 0 at both ends of the range. Beyond them x in its
denominator stays -1 or 1, so that extrapolation does not reach the pole.

B networks of one topology are computed together: weights are (B, P).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

# Keeps the pole 1 % of half the range outside it or farther. The poles of
# test_plane_and_rational_unit_are_any_homographic_function come as near as 2 %.
_LARGEST_TILT = 0.99


@frozen_dataclass
class Topology:
    """Numbers of units of a network."""

    controls: int  # inputs, D
    own: int  # tanh units of the first hidden layer for each control, beside its rational unit
    hidden: int  # units of the second hidden layer, H

    @property
    def width(self) -> int:
        """R: inputs of the second layer and of the output."""
        return self.controls * (2 + self.own)

    @cached_property
    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices in r of the two factors of each product."""
        D = self.controls
        pairs = [(i, j) for i in range(2 * D) for j in range(i) if i % D != j % D]
        first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        return first, second

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Slices of a, s, c, U, b, v, q, m (the weights in M), o among the weights."""
        D, own, R, H = self.controls, self.controls * self.own, self.width, self.hidden
        counts = {"a": D, "s": own, "c": own, "U": H * R, "b": H, "v": H, "q": R}
        counts |= {"m": len(self.pairs[0]), "o": 1}
        ends = np.cumsum(list(counts.values())).tolist()
        return {name: slice(end - counts[name], end) for name, end in zip(counts, ends, strict=True)}

    @property
    def n_weights(self) -> int:
        """P."""
        return self.parts["o"].stop

    @cached_property
    def groups(self) -> NDArray[np.int64]:
        """(P,) number of the prior of each weight; -1: the plane, which has none.

        Weights of one kind share a prior: s, c, the weights in U from each control, b, v, q from tanh
        units, q from rational units, a, and m.
        """
        D, R, H = self.controls, self.width, self.hidden
        group = np.full(self.n_weights, -1)
        group[self.parts["s"]], group[self.parts["c"]] = 0, 1
        source = np.concatenate([np.arange(D), np.arange(D), np.repeat(np.arange(D), self.own)])
        group[self.parts["U"]] = np.tile(2 + source, H)
        group[self.parts["b"]], group[self.parts["v"]] = 2 + D, 3 + D
        group[self.parts["q"]] = np.repeat([-1, 5 + D, 4 + D], [D, D, R - 2 * D])
        group[self.parts["a"]], group[self.parts["m"]] = 6 + D, 7 + D
        return group

    @property
    def n_groups(self) -> int:
        """Number of priors."""
        return 8 + self.controls

    @cached_property
    def membership(self) -> Array:
        """(n_groups, P) 1 where a weight has a prior, else 0."""
        return (self.groups[None] == np.arange(self.n_groups)[:, None]).astype(float)

    def random_weights(self, count: int, rng: np.random.Generator) -> Array:
        """(count, P) initial weights: random hidden units with small outgoing weights."""
        weights = rng.normal(size=(count, self.n_weights))
        for outgoing in ("v", "q", "m"):
            weights[:, self.parts[outgoing]] *= 0.3
        weights[:, self.parts["o"]] = 0.0
        return weights


def respond(topology: Topology, weights: Array, x: Array) -> Array:
    """Outputs (B, n) of a stack of networks (B, P) at controls (n, D), scaled to about [-1, 1]."""
    return _layers(topology, weights, x)[0]


def respond_with_jacobian(topology: Topology, weights: Array, x: Array) -> tuple[Array, Array]:
    """Outputs (B, n) and their derivatives by the weights (B, n, P)."""
    y, r, g = _layers(topology, weights, x)
    part, D = topology.parts, topology.controls
    B, n, H = len(weights), len(x), topology.hidden
    z, rational, own_units = r[:, :, : 2 * D], r[:, :, D : 2 * D], r[:, :, 2 * D :]
    U = weights[:, part["U"]].reshape(B, H, topology.width)
    by_sum = (1 - g * g) * weights[:, None, part["v"]]  # by the argument of each second-layer unit
    by_r = by_sum @ U + weights[:, None, part["q"]]
    by_r[:, :, : 2 * D] += z @ _products(topology, weights)
    by_argument = by_r[:, :, 2 * D :] * (1 - own_units * own_units)
    squashed, inside = np.tanh(weights[:, None, part["a"]]), np.clip(x, -1, 1)
    by_tilt = by_r[:, :, D : 2 * D] * rational * -inside / (1 + _LARGEST_TILT * squashed * inside)
    first, second = topology.pairs
    J = np.empty((B, n, topology.n_weights))
    J[:, :, part["a"]] = by_tilt * _LARGEST_TILT * (1 - squashed * squashed)
    J[:, :, part["s"]] = by_argument * np.repeat(x, topology.own, axis=1)
    J[:, :, part["c"]] = by_argument
    J[:, :, part["U"]] = (by_sum[..., None] * r[:, :, None]).reshape(B, n, -1)
    J[:, :, part["b"]], J[:, :, part["v"]], J[:, :, part["q"]], J[:, :, part["o"]] = by_sum, g, r, 1.0
    J[:, :, part["m"]] = r[:, :, first] * r[:, :, second]
    return y, J


def _products(topology: Topology, weights: Array) -> Array:
    """M (B, 2 D, 2 D), symmetric."""
    M = np.zeros((len(weights), 2 * topology.controls, 2 * topology.controls))
    first, second = topology.pairs
    M[:, first, second] = M[:, second, first] = weights[:, topology.parts["m"]]
    return M


def _layers(topology: Topology, weights: Array, x: Array) -> tuple[Array, Array, Array]:
    """Output (B, n), controls and first hidden layer (B, n, R), second hidden layer (B, n, H)."""
    part = topology.parts
    B, n, D = len(weights), *x.shape
    tilt = _LARGEST_TILT * np.tanh(weights[:, None, part["a"]])
    rational = (1 - x * x) / (1 + tilt * np.clip(x, -1, 1))
    own_units = np.tanh(
        weights[:, None, part["s"]] * np.repeat(x, topology.own, axis=1) + weights[:, None, part["c"]]
    )
    r = np.concatenate([np.broadcast_to(x, (B, n, D)), rational, own_units], axis=2)
    U = weights[:, part["U"]].reshape(B, topology.hidden, topology.width)
    g = np.tanh(r @ np.swapaxes(U, 1, 2) + weights[:, None, part["b"]])
    y = (g @ weights[:, part["v"], None] + r @ weights[:, part["q"], None])[..., 0] + weights[:, part["o"]]
    if D > 1:
        z = r[:, :, : 2 * D]
        y = y + 0.5 * ((z @ _products(topology, weights)) * z).sum(axis=2)
    return y, r, g

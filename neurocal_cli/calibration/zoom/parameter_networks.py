"""The networks of one zoom lens: each predicts one camera parameter at any setting.

The outputs are centred and scaled. alpha_u is on a logarithmic, linear or reciprocal scale, whichever has the
highest evidence. Instead of alpha_v there is log(alpha_v / alpha_u), as the pixels' shape hardly changes with
the setting. u0, v0, t_z and the distortion coefficients are used as they are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.zoom.mlfn import Topology, respond, respond_with_jacobian
from neurocal_cli.calibration.zoom.network_training import prior_precision
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

SCALES = ("log", "linear", "inverse")


def to_scale(scale: str, alpha: Array) -> tuple[Array, Array]:
    """Values on one of `SCALES`, and their derivatives by the value; of the shape of alpha."""
    if scale == "log":
        return np.log(alpha), 1 / alpha
    if scale == "inverse":
        return 1 / alpha, -1 / alpha**2
    return np.asarray(alpha, dtype=float), np.ones_like(alpha)


def from_scale(scale: str, y: Array) -> tuple[Array, Array]:
    """Values from one of `SCALES`, and their derivatives by y; of the shape of y."""
    if scale == "log":
        alpha = np.exp(y)
        return alpha, alpha
    if scale == "inverse":
        return 1 / y, -1 / y**2
    return np.asarray(y, dtype=float), np.ones_like(y)


@frozen_dataclass(eq=False)
class ParameterNet:
    """One network with the scaling of its output: centre + spread y."""

    topology: Topology
    weights: Array  # (P,)
    precision: Array  # (G,) of the weights' priors
    centre: float
    spread: float
    scatter: float = 0.0  # variance of the output from setting to setting that the network does not explain

    def output(self, x: Array) -> Array:
        """(n,) outputs at scaled controls (n, D)."""
        return self.centre + self.spread * respond(self.topology, self.weights[None], x)[0]

    def output_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Outputs (n,) and their derivatives by the weights (n, P)."""
        y, J = respond_with_jacobian(self.topology, self.weights[None], x)
        return self.centre + self.spread * y[0], self.spread * J[0]

    @property
    def prior(self) -> Array:
        """(P,) precision of each weight's prior."""
        return prior_precision(self.topology, self.precision)


@frozen_dataclass(eq=False)
class LensNets:
    """One network for each local parameter: alpha_u, alpha_v, u0, v0, and then t_z and distortion."""

    scale: str  # of alpha_u's network, one of `SCALES`
    nets: tuple[ParameterNet, ...]

    @property
    def weights(self) -> Array:
        """(P,) weights of all networks, one after the other."""
        return np.concatenate([net.weights for net in self.nets])

    @property
    def prior(self) -> Array:
        """(P,) precisions of the priors of all weights."""
        return np.concatenate([net.prior for net in self.nets])

    def moved(self, step: Array) -> LensNets:
        """After a step (P,) of all weights."""
        moved = [
            replace(net, weights=net.weights + part)
            for net, part in zip(self.nets, self.split(step), strict=True)
        ]
        return replace(self, nets=tuple(moved))

    def split(self, weights: Array) -> list[Array]:
        """Split a vector of the length of all weights (P,) into the parts of each network."""
        return np.split(weights, np.cumsum([net.topology.n_weights for net in self.nets])[:-1])

    def local(self, x: Array) -> Array:
        """(n, L) local parameters at scaled controls (n, D)."""
        return outputs_to_local(self.scale, np.column_stack([net.output(x) for net in self.nets]))[0]

    def local_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Local parameters (n, L) and their derivatives by all weights (n, L, P)."""
        pairs = [net.output_with_jacobian(x) for net in self.nets]
        local, by_output = outputs_to_local(self.scale, np.column_stack([y for y, _ in pairs]))
        parts = [by_output[:, :, j, None] * J[:, None] for j, (_, J) in enumerate(pairs)]
        return local, np.concatenate(parts, axis=2)

    def local_scatter(self, local: Array) -> Array:
        """(L,) variance of the local parameters from setting to setting; `local` (S, L) are their values."""
        scatter = np.array([net.scatter for net in self.nets])
        alpha = np.median(local[:, :2], axis=0)
        slope = float(np.median(np.abs(to_scale(self.scale, local[:, 0])[1])))
        scatter[0] /= slope**2
        scatter[1] = scatter[1] * alpha[1] ** 2 + scatter[0]
        return scatter


def are_cameras(local: Array) -> NDArray[np.bool_]:
    """(...) which local parameters (..., L) are finite, with positive scale factors."""
    return np.asarray(np.isfinite(local).all(axis=-1) & (local[..., :2] > 0).all(axis=-1))


def outputs_to_local(scale: str, outputs: Array) -> tuple[Array, Array]:
    """Local parameters (n, L) from the networks' outputs (n, L), and derivatives (n, L, L)."""
    local, n, L = outputs.copy(), *outputs.shape
    by_output = np.tile(np.eye(L), (n, 1, 1))
    local[:, 0], by_output[:, 0, 0] = from_scale(scale, outputs[:, 0])
    ratio = np.exp(outputs[:, 1])
    local[:, 1] = local[:, 0] * ratio
    by_output[:, 1, 0], by_output[:, 1, 1] = by_output[:, 0, 0] * ratio, local[:, 1]
    return local, by_output


def local_to_outputs(scale: str, local: Array) -> tuple[Array, Array]:
    """The networks' outputs (n, L) for local parameters (n, L), and derivatives (n, L, L)."""
    outputs, n, L = local.copy(), *local.shape
    by_local = np.tile(np.eye(L), (n, 1, 1))
    outputs[:, 0], by_local[:, 0, 0] = to_scale(scale, local[:, 0])
    outputs[:, 1] = np.log(local[:, 1] / local[:, 0])
    by_local[:, 1, 0], by_local[:, 1, 1] = -1 / local[:, 0], 1 / local[:, 1]
    return outputs, by_local

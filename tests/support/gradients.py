"""Gradients of the network's error, as the paper writes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.network import Patterns, optimal_gamma, output


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


def residual_jacobian(W: Array, V: Array, patterns: Patterns) -> tuple[Array, Array]:
    """Residuals d - gamma o (G, N, 3) with gamma eliminated, and their derivative by the product W V.

    The derivative is (G, N, 3, 3, I), by the entries of the (3, I) product. The residual is the component of
    the target perpendicular to the ray o. The derivative of gamma is along the ray and is dropped (Kaufman's
    variable projection). The gradient is exact, and the Hessian is that of Gauss-Newton.
    """
    Z = patterns.inputs
    o = output(W, V, Z)
    gamma = optimal_gamma(o, patterns.targets)
    ray = o / np.linalg.norm(o, axis=-1, keepdims=True)
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    root = np.sqrt(patterns.weights)
    residuals = root[..., None] * (patterns.targets - gamma[..., None] * o)
    jacobian = -(root * gamma)[..., None, None, None] * across[..., None] * Z[..., None, None, :]
    return residuals, jacobian

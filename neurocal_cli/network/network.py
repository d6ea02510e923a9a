"""The calibrating network of the paper's section 3: two linear layers and a factor for each pattern.

A pattern is a normalised world point ``Z = (X, Y, Z, 1)`` and its normalised pixel
``d = (u, v, 1)``. The hidden layer has the weights V (3 x 4, the pose), the output layer W (3 x 3,
the intrinsic matrix). The paper's fourth hidden neuron is the constant 1. Its output weights are the
zero column of A, so it is left out. For a flat board the input Z is always 0. Its column of V is left
out as well, and V is 3 x 3. With o = W V Z the network's outputs are O = gamma o, eq. (7).

    E_2D = 1/2 sum_i w_i |d_i - gamma_i o_i|^2                                    eqs. (5), (8)

Every function takes a stack of networks: a leading axis of G networks, each with N patterns of I
inputs. A network is one view of a camera, or one random start of it.

Index conventions: the paper swaps V's indices between (6) and (9)-(10) and W's between (10) and
(15). Here ``V[j, l]`` goes from input l to hidden neuron j and ``W[k, j]`` from there to output k.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.network.training import Patterns


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

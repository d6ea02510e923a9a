"""Back-propagation of the paper's section 3, one pattern at a time, as a kernel for numba.

This module imports numba if it is installed, so only the trainer imports it, when it runs. The same source
runs as plain Python where numba is missing. Fast-math is off: the compiled kernel and its Python source give
the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array


def _importable() -> ModuleType | None:
    """Import numba if it is installed and not switched off by its own NUMBA_DISABLE_JIT."""
    try:
        numba = import_module("numba")
    except ImportError:
        return None
    return None if numba.config.DISABLE_JIT else numba


_NUMBA = _importable()

# Whether `jit` compiles or returns the Python function.
COMPILING = _NUMBA is not None

_Function = TypeVar("_Function", bound=Callable[..., Any])


def jit(function: _Function) -> _Function:
    """Compile a function of numbers and arrays, and cache the machine code on disk if possible."""
    if _NUMBA is None:
        return function
    try:
        return cast(_Function, _NUMBA.njit(cache=True)(function))
    except RuntimeError:
        # Neither the package's folder nor the user's cache is writable: compile at each start.
        return cast(_Function, _NUMBA.njit(function))


Mask = NDArray[np.bool_]


@jit
def descend_orthogonality(V: Array, free: Mask, rate: float, a: float, gradient: Array) -> None:
    """One gradient step on E_orth of eq. (14); see `network.e_orth_gradient`."""
    for row in range(3):
        for column in range(3):
            gradient[row, column] = 0.0
        for other in range(3):
            product = V[row, 0] * V[other, 0] + V[row, 1] * V[other, 1] + V[row, 2] * V[other, 2]
            factor = 4.0 * (product - a) if row == other else 2.0 * product
            for column in range(3):
                gradient[row, column] += factor * V[other, column]
    for row in range(3):
        for column in range(3):
            if free[row, column]:
                V[row, column] -= rate * gradient[row, column]


@jit
def learn(
    Z: Array, d: Array, w: Array, W: Array, V: Array, gamma: Array, free_W: Mask, free_V: Mask,
    rate_weights: float, rate_gamma: float, pull: float, a: float, epochs: int, used: int,
) -> None:  # fmt: skip
    """Train one network on its first `used` patterns, one by one, for some epochs."""
    Y, error, back, gradient = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    for _ in range(epochs):
        for i in range(used):
            for j in range(3):  # eq. (6)
                Y[j] = V[j, 0] * Z[i, 0] + V[j, 1] * Z[i, 1] + V[j, 2] * Z[i, 2] + V[j, 3] * Z[i, 3]
            along = 0.0
            for k in range(3):  # eq. (7)
                o = W[k, 0] * Y[0] + W[k, 1] * Y[1] + W[k, 2] * Y[2]
                error[k] = w[i] * (d[i, k] - gamma[i] * o)
                along += error[k] * o
                error[k] *= rate_weights * gamma[i]
            for j in range(3):  # before W changes
                back[j] = error[0] * W[0, j] + error[1] * W[1, j] + error[2] * W[2, j]
            for k in range(3):  # eq. (9)
                for j in range(3):
                    if free_W[k, j]:
                        W[k, j] += error[k] * Y[j]
            for j in range(3):  # eq. (10)
                for m in range(4):
                    if free_V[j, m]:
                        V[j, m] += back[j] * Z[i, m]
            gamma[i] += rate_gamma * along  # eq. (11)
            if pull > 0.0:
                descend_orthogonality(V, free_V, rate_weights * pull, a, gradient)


@jit
def present(
    Z: Array, d: Array, w: Array, W: Array, V: Array, gamma: Array, free_W: Mask, free_V: Mask,
    rate_weights: Array, rate_gamma: Array, pull: float, a: float, epochs: int, used: NDArray[np.int64],
    active: Mask,
) -> None:  # fmt: skip
    """Train the active networks of a stack in place."""
    for g in range(W.shape[0]):
        if active[g]:
            learn(Z[g], d[g], w[g], W[g], V[g], gamma[g], free_W, free_V,
                  rate_weights[g], rate_gamma[g], pull, a, epochs, used[g])  # fmt: skip

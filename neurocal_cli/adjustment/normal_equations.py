"""Stacks of normal equations: solved, damped and inverted, always scaled to a unit diagonal."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array

NOTHING = 1e-300  # avoids a division by 0 for a zero diagonal
ROUNDING = 1e-14  # a ridge that regularises a singular system and is negligible in a regular one
_ABSENT = 1e-30  # an eigenvalue of the scaled matrix below this counts as 0


def unit_diagonal(H: Array) -> tuple[Array, Array]:
    """Matrices (..., n, n) with rows and columns scaled to a unit diagonal, and the scales (..., n)."""
    scale = 1.0 / np.sqrt(np.abs(np.diagonal(H, axis1=-2, axis2=-1)) + NOTHING)
    return H * scale[..., :, None] * scale[..., None, :], scale


def solve_scaled(H: Array, rhs: Array, ridge: float = 0.0) -> Array:
    """Solve systems H (..., n, n), rhs (..., n, m) scaled to a unit diagonal; a singular one yields nan.

    `ridge` is added to the unit diagonal; `ROUNDING` keeps undetermined unknowns finite.
    """
    scaled, scale = unit_diagonal(H)
    if ridge:
        scaled += ridge * np.eye(H.shape[-1])
    try:
        return scale[..., :, None] * np.linalg.solve(scaled, scale[..., :, None] * rhs)
    except np.linalg.LinAlgError:
        if H.ndim > 2:  # solve one by one, so that a singular system does not spoil the others
            return np.stack([solve_scaled(one, right, ridge) for one, right in zip(H, rhs, strict=True)])
        return np.full(rhs.shape, np.nan)


def damped_step(H: Array, g: Array, damping: Array) -> tuple[Array, Array]:
    """Marquardt's step (H + lambda diag H) d = g of each group, and its predicted gain.

    H (G, n, n) are the Gauss-Newton matrices J^T J, which are damped in place. g (G, n) is J^T r with
    r = observed - predicted: downhill. Returns the steps (G, n), nan where the system is singular, and the
    predicted drops of the sum of squares (G,), 2 g.d - d.H d = d.(g + lambda diag(H) d).
    """
    places = range(H.shape[1])
    ridge = damping[:, None] * (np.diagonal(H, axis1=1, axis2=2) + NOTHING)
    H[:, places, places] += ridge
    step = solve_scaled(H, g[..., None])[..., 0]
    return step, (step * (g + ridge * step)).sum(axis=1)


def inverse_scaled(H: Array, reference: Array) -> tuple[Array, float]:
    """Inverse of symmetric matrices (..., n, n), and their smallest eigenvalue in units of the reference.

    The unit is the diagonal of `reference`. The inverse is nan and the eigenvalue 0 if a matrix is singular.
    """
    scale = 1.0 / np.sqrt(np.diagonal(reference, axis1=-2, axis2=-1) + NOTHING)
    outer = scale[..., :, None] * scale[..., None, :]
    scaled = H * outer
    if not np.isfinite(scaled).all():
        return np.full_like(H, np.nan), 0.0
    values, vectors = np.linalg.eigh(scaled)
    smallest = float(values.min(initial=1.0))
    if smallest < _ABSENT:
        return np.full_like(H, np.nan), 0.0
    inverse = (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return inverse * outer, smallest

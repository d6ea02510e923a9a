"""Points that were measured in one direction only.

The mid-point of an edge is measured across the edge. Its position along the edge comes from the smooth map
through all edges of its board. That is often more precise, but it is no independent measurement: the errors
along the edges are common to a board's points. To count them as independent would make every standard
deviation several times too small. So such a point gives one equation, across its edge. Along the edge it has
the small weight `LEAST`, which keeps a pose determined that nothing else determines. If the residuals are
model errors, the weight is larger (`common_noise`).

All functions take `across`, (N, 2): the direction in which each point was measured, of any length, or (0, 0)
for points measured in both directions; None if all were.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array

LEAST = 0.01  # of an equation


def equations(across: Array | None, n: int, along: float = LEAST) -> Array:
    """Number of equations that each of n points gives, (n,): 2, or 1 plus its weight along the edge."""
    if across is None:
        return np.full(n, 2.0)
    return np.where(single(across), 1.0 + along, 2.0)


def measured_part(errors: Array, across: Array | None) -> Array:
    """Pixel errors (N, 2) projected on the measured directions; (N, 2)."""
    if across is None:
        return errors
    n = unit(across)
    return np.where(single(across)[:, None], (errors * n).sum(axis=1, keepdims=True) * n, errors)


def variance_across(covariance: Array, across: Array) -> Array:
    """Variance (N,) in the measured direction; the mean of both where both were measured.

    The columns of `covariance` (N, 3) are suu, suv, svv.
    """
    suu, suv, svv = covariance.T
    nu, nv = unit(across).T
    return np.where(single(across), suu * nu * nu + 2 * suv * nu * nv + svv * nv * nv, 0.5 * (suu + svv))


def loosened(covariance: Array, across: Array | None, along: float = LEAST) -> Array:
    """Covariances (N, 3) of independent points, with the weight `along` in the direction of their edges."""
    if across is None:
        return covariance
    variance, (nu, nv) = variance_across(covariance, across), unit(across).T
    one_way = [
        variance * (first * first_too + second * second_too / along)
        for first, first_too, second, second_too in ((nu, nu, nv, nv), (nu, nv, -nv, nu), (nv, nv, nu, nu))
    ]
    return np.where(single(across)[:, None], np.stack(one_way, axis=1), covariance)


def rounded(whitening: Array, across: Array | None) -> Array:
    """Whitening factors (N, 3), made isotropic with the factor across the edge."""
    if across is None:
        return whitening
    nu, nv = unit(across).T
    w = np.hypot(whitening[:, 0] * nu + whitening[:, 1] * nv, whitening[:, 2] * nv)
    return np.where(single(across)[:, None], np.column_stack([w, np.zeros_like(w), w]), whitening)


def across_first(whitening: Array, across: Array) -> Array:
    """Whitening factors (N, 3), for one residual across an edge and 0 as the other."""
    factors = rounded(whitening, across)[:, :1] * unit(across)
    return np.where(single(across)[:, None], np.column_stack([factors, np.zeros(len(factors))]), whitening)


def single(across: Array) -> NDArray[np.bool_]:
    """Which points (N,) were measured in one direction only."""
    return np.asarray((across != 0).any(axis=1))


def unit(across: Array) -> Array:
    """Directions normalised to length 1; (0, 0) stays."""
    length = np.hypot(across[:, 0], across[:, 1])[:, None]
    return np.asarray(across / np.where(length > 0, length, 1.0))

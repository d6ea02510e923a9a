"""Points that were measured in one direction only.

The mid-point of an edge is seen across the edge. Where along the edge it lies is told by the smooth map
through all the edges of its board: true, and often to a smaller fraction of a pixel, but it is what the
other edges have said already. Errors along the edges are common to a board's points, and taking them
for as many independent measurements would make every standard deviation too small, several times over.
So such a point gives one equation, across its edge; along it, it has the small say `LEAST` that keeps a
pose in place which nothing else holds. Where residuals are not the measurement's (`noise`), it has more.

All functions take `across`, (N, 2): the direction in which each point was measured, of any length, or
(0, 0) for one measured in both directions; None when all were.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

LEAST = 0.01  # of an equation


def equations(across: Array | None, n: int, along: float = LEAST) -> Array:
    """How many equations each of n points gives, (n,): 2, or 1 and its say along the edge."""
    if across is None:
        return np.full(n, 2.0)
    return np.where(single(across), 1.0 + along, 2.0)


def measured_part(errors: Array, across: Array | None) -> Array:
    """The part of pixels' errors (N, 2) in the measured directions; (N, 2)."""
    if across is None:
        return errors
    n = unit(across)
    return np.where(single(across)[:, None], (errors * n).sum(axis=1, keepdims=True) * n, errors)


def variance_across(covariance: Array, across: Array) -> Array:
    """Variance (N,) in the measured direction; in the mean direction where both were measured.

    Parameters
    ----------
    covariance : (N, 3) array
        suu, suv, svv.
    across : (N, 2) array
    """
    suu, suv, svv = covariance.T
    nu, nv = unit(across).T
    return np.where(single(across), suu * nu * nu + 2 * suv * nu * nv + svv * nv * nv, 0.5 * (suu + svv))


def loosened(covariance: Array, across: Array | None, along: float = LEAST) -> Array:
    """Covariances (N, 3) of points taken to be independent, with some say along their edges."""
    if across is None:
        return covariance
    variance, (nu, nv) = variance_across(covariance, across), unit(across).T
    one_way = [
        variance * (first * first_too + second * second_too / along)
        for first, first_too, second, second_too in ((nu, nu, nv, nv), (nu, nv, -nv, nu), (nv, nv, nu, nu))
    ]
    return np.where(single(across)[:, None], np.stack(one_way, axis=1), covariance)


def rounded(whitening: Array, across: Array | None) -> Array:
    """Whitening factors (N, 3), what is known across an edge being known in all directions."""
    if across is None:
        return whitening
    nu, nv = unit(across).T
    w = np.hypot(whitening[:, 0] * nu + whitening[:, 1] * nv, whitening[:, 2] * nv)
    return np.where(single(across)[:, None], np.column_stack([w, np.zeros_like(w), w]), whitening)


def single(across: Array) -> NDArray[np.bool_]:
    """Which points (N,) were measured in one direction only."""
    return np.asarray((across != 0).any(axis=1))


def unit(across: Array) -> Array:
    """Directions of length 1; (0, 0) stays."""
    length = np.hypot(across[:, 0], across[:, 1])[:, None]
    return np.asarray(across / np.where(length > 0, length, 1.0))

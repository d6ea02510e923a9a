"""What the points' stated covariances leave out: errors that are alike for all points.

A detector knows how sharply it sees each point, not how far the target's squares or the camera's model
are off. Where that is the larger error, weighing points by the stated covariances C alone gives the
sharpest few all the say. So the noise is taken for

    k ((1 - m) C + m c I),   c the mean variance of C,

k being the residuals' level. As long as they do not contradict it, m is 0; otherwise it is the largest
share that they do not contradict: too much say for a few points costs more than too little. Where C says
nothing of the residuals, m is 1 and all points count the same.

Covariances that are round for every point (a column ``sigma``) are weights that somebody chose: they are
taken as they are.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array

__all__ = ["common_share", "measured", "with_common_share"]

_MOST_POINTS = 20000  # enough to tell a share to a percent
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_STEPS = 12  # of golden section and of bisection
_CONTRADICTED = 3.0  # standard deviations


def measured(covariance: Array) -> bool:
    """Whether covariances (N, 3) are measured ones: not round for every point."""
    suu, suv, svv = covariance.T
    return bool((suv != 0).any() or (suu != svv).any())


def with_common_share(covariance: Array, share: float) -> Array:
    """Covariances (N, 3) of the same mean with a share that is the same for all points.

    Parameters
    ----------
    covariance : (N, 3) array
        suu, suv, svv.
    share : float
        m, from 0 to 1.
    """
    mean = 0.5 * float((covariance[:, 0] + covariance[:, 2]).mean())
    return np.asarray((1.0 - share) * covariance + share * mean * np.array([1.0, 0.0, 1.0]))


def common_share(covariance: Array, residuals: Array) -> float:
    """The share of the noise that is the same for all points, as the residuals have it.

    Parameters
    ----------
    covariance : (N, 3) array
        suu, suv, svv as stated, any unit.
    residuals : (N, 2) array
        Of a fit, any unit.
    """
    some = slice(None, None, max(1, len(residuals) // _MOST_POINTS))
    C, r = covariance[some], residuals[some]
    if not (r**2).sum() > 0:
        return 0.0
    low, high = 0.0, 1.0
    inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
    values = [_unlikelihood(C, r, m) for m in inner]
    for _ in range(_STEPS):
        if values[0] < values[1]:
            high, inner[1], values[1] = inner[1], inner[0], values[0]
            inner[0] = high - _GOLDEN * (high - low)
            values[0] = _unlikelihood(C, r, inner[0])
        else:
            low, inner[0], values[0] = inner[0], inner[1], values[1]
            inner[1] = low + _GOLDEN * (high - low)
            values[1] = _unlikelihood(C, r, inner[1])
    best = min((0.0, 0.5 * (low + high), 1.0), key=lambda m: _unlikelihood(C, r, m))
    enough = _unlikelihood(C, r, best) + 0.5 * _CONTRADICTED**2 / len(r)
    for extreme in (0.0, 1.0):
        if _unlikelihood(C, r, extreme) <= enough:
            return extreme
    low, high = best, 1.0
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _unlikelihood(C, r, middle) <= enough else (low, middle)
    return low


def _unlikelihood(covariance: Array, residuals: Array, share: float) -> float:
    """The negative log-likelihood of a point, but for a constant, the level k at its best."""
    suu, suv, svv = with_common_share(covariance, share).T
    det = suu * svv - suv * suv
    u, v = residuals.T
    chi = ((svv * u - 2 * suv * v) * u + suu * v * v) / det
    return float(np.log(chi.mean()) + 0.5 * np.log(det).mean())

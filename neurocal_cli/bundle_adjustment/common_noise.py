"""What the points' stated covariances leave out: errors that are alike for all points.

A detector knows how sharply it sees each point, not how far the target's squares or the camera's model
are off. Where that is the larger error, weighing points by the stated covariances C alone lets the sharpest
few points decide everything. So the noise is taken for

    k ((1 - m) C + m c I),   c the mean variance of C,

k being the residuals' level. As long as they do not contradict it, m is 0; otherwise it is the largest
share that they do not contradict: too much weight for a few points costs more than too little. Where C says
nothing of the residuals, m is 1 and all points count the same.

Covariances that are round for every point (a column ``sigma``) are weights that somebody chose: they are
taken as they are.

Of points measured across edges (`measured_directions`) C and the residuals count there. Their covariances are
those of the measurement and of the board's unevenness. Where k is 4 and more, most of the residuals is
of a target or a lens that are not as modelled, which shows along the edges as much as across: all points
then count the same in both directions, and up to k = 2 as they were measured.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from neurocal_cli.bundle_adjustment.measured_directions import (
    LEAST,
    equations,
    measured_part,
    single,
    variance_across,
)
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

# Repeated by tests/test_common_noise.py and tests/test_measured_directions.py: with these, true covariances
# lower the errors of the camera and wrong ones do no harm; boards that are not flat have levels of 4 and
# more, rendered ones of about 1.
_MOST_POINTS = 20000  # enough to tell a share to a percent
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_STEPS = 12  # of golden section and of bisection
_CONTRADICTED = 3.0  # standard deviations
_MEASURED, _MISFIT = 2.0, 4.0  # levels up to and from which residuals are and are not the measurement's


@frozen_dataclass
class Noise:
    """How far stated covariances are believed.

    Attributes
    ----------
    share : float
        m, what is the same for all points.
    along : float
        Say along their edges of points that were measured across them.
    """

    share: float = 0.0
    along: float = LEAST


def noise_of(covariance: Array, residuals: Array, across: Array | None) -> Noise:
    """What the residuals of a fit bear out.

    Parameters
    ----------
    covariance : (N, 3) array [px^2]
        suu, suv, svv as stated.
    residuals : (N, 2) array [px]
    across : (N, 2) array or None
        Direction in which each point was measured.
    """
    share = common_share(covariance, residuals, across)
    if across is None:
        return Noise(share)
    one_way = single(across)
    variance = variance_across(with_common_share(covariance, share, across), across)[one_way]
    seen = measured_part(residuals, across)[one_way]
    k = float(((seen**2).sum(axis=1) / variance).mean())
    misfit = float(np.clip((k - _MEASURED) / (_MISFIT - _MEASURED), 0.0, 1.0))
    return Noise(share + misfit * (1.0 - share), LEAST ** (1.0 - misfit))


def measured(covariance: Array) -> bool:
    """Whether covariances (N, 3) are measured ones: not round for every point."""
    suu, suv, svv = covariance.T
    return bool((suv != 0).any() or (suu != svv).any())


def with_common_share(covariance: Array, share: float, across: Array | None = None) -> Array:
    """Covariances (N, 3) of the same mean with a share that is the same for all points.

    Parameters
    ----------
    covariance : (N, 3) array
        suu, suv, svv.
    share : float
        m, from 0 to 1.
    across : (N, 2) array, optional
        Direction in which each point was measured.
    """
    if across is None:
        mean = 0.5 * float((covariance[:, 0] + covariance[:, 2]).mean())
    else:
        mean = float(np.average(variance_across(covariance, across), weights=equations(across, len(across))))
    return np.asarray((1.0 - share) * covariance + share * mean * np.array([1.0, 0.0, 1.0]))


def common_share(covariance: Array, residuals: Array, across: Array | None = None) -> float:
    """The share of the noise that is the same for all points, as the residuals have it.

    Parameters
    ----------
    covariance : (N, 3) array
        suu, suv, svv as stated, any unit.
    residuals : (N, 2) array
        Of a fit, any unit.
    across : (N, 2) array, optional
        Direction in which each point was measured.
    """
    some = slice(None, None, max(1, len(residuals) // _MOST_POINTS))
    C, n = covariance[some], None if across is None else across[some]
    r = measured_part(residuals[some], n)
    if not (r**2).sum() > 0:
        return 0.0
    unlikelihood = _unlikelihood(C, r, n)
    low, high = 0.0, 1.0
    inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
    values = [unlikelihood(m) for m in inner]
    for _ in range(_STEPS):
        if values[0] < values[1]:
            high, inner[1], values[1] = inner[1], inner[0], values[0]
            inner[0] = high - _GOLDEN * (high - low)
            values[0] = unlikelihood(inner[0])
        else:
            low, inner[0], values[0] = inner[0], inner[1], values[1]
            inner[1] = low + _GOLDEN * (high - low)
            values[1] = unlikelihood(inner[1])
    best = min((0.0, 0.5 * (low + high), 1.0), key=unlikelihood)
    enough = unlikelihood(best) + 0.5 * _CONTRADICTED**2 / len(r)
    for extreme in (0.0, 1.0):
        if unlikelihood(extreme) <= enough:
            return extreme
    low, high = best, 1.0
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if unlikelihood(middle) <= enough else (low, middle)
    return low


def _unlikelihood(covariance: Array, residuals: Array, across: Array | None) -> Callable[[float], float]:
    """The negative log-likelihood of a point by the share, but for a constant, the level k at its best.

    With covariances as `with_common_share` has them. Points that were measured in one direction have one
    variance, the others two by two.
    """
    if across is None:
        own, one = 0.5 * (covariance[:, 0] + covariance[:, 2]), np.zeros(len(covariance), dtype=bool)
    else:
        own, one = variance_across(covariance, across), single(across)
    mean = np.average(own, weights=equations(across, len(own)))
    count = np.where(one, 1.0, 2.0).mean()
    squared, own = (residuals[one] ** 2).sum(axis=1), own[one]
    (suu, suv, svv), (u, v) = covariance[~one].T, residuals[~one].T

    def at(share: float) -> float:
        a, b = 1.0 - share, share * mean
        variance, uu, uv, vv = a * own + b, a * suu + b, a * suv, a * svv + b
        det = uu * vv - uv * uv
        chi = (squared / variance).sum() + (((vv * u - 2 * uv * v) * u + uu * v * v) / det).sum()
        log_det = np.log(variance).sum() + np.log(det).sum()
        return float(0.5 * count * np.log(chi / len(one)) + 0.5 * log_det / len(one))

    return at

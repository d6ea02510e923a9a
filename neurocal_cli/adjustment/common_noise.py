"""Noise that the stated covariances of the points leave out because it is common to all points.

A detector knows how sharply it sees each point, but not the errors of the target or of the camera model. If
those dominate, weights from the stated covariances C alone let the few sharpest points decide the result. So
the noise is modelled as

    k ((1 - m) C + m c I),   c the mean variance of C,

where k is the level of the residuals. If the residuals do not contradict m = 0, m is 0. Otherwise it is the
largest m that they do not contradict, because overweighting a few points does more harm than underweighting
them. If C does not predict the residuals at all, m is 1 and all points have equal weight. Adjusting and
estimating m alternate (`reweighted`).

Isotropic covariances (a column ``sigma``) are weights that the user chose; they are used as they are.

For points measured across edges (`measured_directions`), C and the residuals are those across the edge. Their
covariances contain the measurement noise and the board's unevenness. If k is 4 or more, most of the residuals
are model errors of the target or the lens, which appear along the edges as much as across them: then all
points are weighted equally in both directions. Up to k = 2 they are weighted as measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import Views, arrange, noise_model
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.measured_directions import (
    LEAST,
    equations,
    measured_part,
    single,
    variance_across,
)
from neurocal_cli.observations.points import Correspondences

# Repeated by test_common_noise.py and test_measured_directions.py: with these, true covariances
# lower the errors of the camera and wrong ones do no harm; boards that are not flat have levels of 4 and
# more, rendered ones of about 1.
_MOST_POINTS = 20000  # enough to estimate the share to a percent
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_STEPS = 12  # of golden section and of bisection
_CONTRADICTED = 3.0  # standard deviations
_MEASURED, _MISFIT = 2.0, 4.0  # levels: measurement noise up to the first, model error from the second
_PASSES = 10
_SETTLED = 0.005  # change of the share that is negligible for every result


@frozen_dataclass
class Noise:
    """How far the stated covariances are trusted."""

    share: float = 0.0  # m, the share of the noise that is common to all points
    along: float = LEAST  # weight along the edge of points measured across it


def reweighted(solution: Solution) -> Solution:
    """Alternate between adjusting and estimating the noise common to all points.

    The given solution is adjusted with the stated covariances alone.
    """
    points = solution.problem.points
    if points.covariance is None or not measured(points.covariance):
        return solution
    # Start from equal weights: if a few points dominated the fit, their small residuals would confirm that.
    noise = Noise(share=1.0)
    solution = _adjusted_with(solution, noise)
    for _ in range(_PASSES):
        views = solution.problem.views
        residuals = point_residuals(views, solution.state) * views.pixel_scale
        last, noise = noise, noise_of(_stated(points, views), residuals, views.across)
        if max(abs(noise.share - last.share), abs(noise.along - last.along)) < _SETTLED:
            break
        solution = _adjusted_with(solution, noise)
    return replace(solution, common_noise=noise.share)


def _adjusted_with(solution: Solution, noise: Noise) -> Solution:
    problem = solution.problem
    problem = replace(problem, views=_with_noise(problem.views, problem.points, noise))
    return replace(solution, problem=problem, adjusted=problem.adjust(solution.adjusted))


def weighed(points: Correspondences, residuals: Array) -> Views:
    """Arrange points and weight them as far as the residuals (N, 2) [px] of a calibration support that."""
    views = arrange(points)
    if points.covariance is None or not measured(points.covariance):
        return views
    rows = slice(None) if views.order is None else views.order
    return _with_noise(views, points, noise_of(_stated(points, views), residuals[rows], views.across))


def _stated(points: Correspondences, views: Views) -> Array:
    """The stated covariances in the order of the views."""
    assert points.covariance is not None
    return points.covariance if views.order is None else points.covariance[views.order]


def _with_noise(views: Views, points: Correspondences, noise: Noise) -> Views:
    believed = with_common_share(_stated(points, views), noise.share, views.across)
    whitening = noise_model(believed, views.across, noise.along)[1]
    return replace(views, whitening=whitening, along=noise.along)


def noise_of(covariance: Array, residuals: Array, across: Array | None) -> Noise:
    """The noise model that the residuals (N, 2) [px] of a fit support.

    The columns of `covariance` (N, 3) are suu, suv, svv as stated [px^2]. `across` (N, 2) is the direction in
    which each point was measured.
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
    """Whether covariances (N, 3) are measured ones, that is, not all isotropic."""
    suu, suv, svv = covariance.T
    return bool((suv != 0).any() or (suu != svv).any())


def with_common_share(covariance: Array, share: float, across: Array | None = None) -> Array:
    """Covariances (N, 3) suu, suv, svv with the same mean and a share m, 0 to 1, common to all points.

    `across` (N, 2) is the direction in which each point was measured.
    """
    if across is None:
        mean = 0.5 * float((covariance[:, 0] + covariance[:, 2]).mean())
    else:
        mean = float(np.average(variance_across(covariance, across), weights=equations(across, len(across))))
    return np.asarray((1.0 - share) * covariance + share * mean * np.array([1.0, 0.0, 1.0]))


def common_share(covariance: Array, residuals: Array, across: Array | None = None) -> float:
    """Share of the noise that is common to all points, estimated from residuals by maximum likelihood.

    The columns of `covariance` (N, 3) are suu, suv, svv as stated, and `residuals` (N, 2) are those of a fit;
    each may be in any unit. `across` (N, 2) is the direction in which each point was measured.
    """
    some = slice(None, None, max(1, len(residuals) // _MOST_POINTS))
    C, n = covariance[some], None if across is None else across[some]
    r = measured_part(residuals[some], n)
    if not (r**2).sum() > 0:
        return 0.0
    unlikelihood = _unlikelihood(C, r, n)
    low, high = 0.0, 1.0
    for _ in range(_STEPS):
        step = _GOLDEN * (high - low)
        is_left = unlikelihood(high - step) < unlikelihood(low + step)
        low, high = (low, low + step) if is_left else (high - step, high)
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
    """Mean negative log-likelihood per point as a function of the share, up to a constant.

    The level k is at its optimum. The covariances are those of `with_common_share`. Points measured in one
    direction have a scalar variance, the others a 2 x 2 covariance.
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

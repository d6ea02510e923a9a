"""Reweight points: their measured covariances count only as far as the residuals support them."""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.adjustment.common_noise import Noise, measured, noise_of, with_common_share
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import Views, arrange, noise_model
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.points import Correspondences

_PASSES = 10
_SETTLED = 0.005  # change of the share that is negligible for every result


def reweighted(solution: Solution) -> Solution:
    """Alternate between adjusting and estimating the noise common to all points; see `common_noise`.

    The given solution is adjusted with the stated covariances alone.
    """
    points = solution.problem.points
    if points.covariance is None or not measured(points.covariance):
        return solution
    # Start from equal weights: if a few points dominated the fit, their small residuals would confirm that.
    noise = Noise(share=1.0)
    solution = _weighed(solution, noise)
    for _ in range(_PASSES):
        views = solution.problem.views
        residuals = point_residuals(views, solution.state) * views.pixel_scale
        last, noise = noise, noise_of(_stated(points, views), residuals, views.across)
        if max(abs(noise.share - last.share), abs(noise.along - last.along)) < _SETTLED:
            break
        solution = _weighed(solution, noise)
    return replace(solution, common_noise=noise.share)


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


def _weighed(solution: Solution, noise: Noise) -> Solution:
    problem = solution.problem
    problem = replace(problem, views=_with_noise(problem.views, problem.points, noise))
    return replace(solution, problem=problem, adjusted=problem.adjust(solution.adjusted))

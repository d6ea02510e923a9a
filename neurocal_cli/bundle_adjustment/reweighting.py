"""Points weighed by their measured covariances only as far as the residuals bear them out."""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.bundle_adjustment.common_noise import Noise, measured, noise_of, with_common_share
from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.residual_correlation import point_residuals
from neurocal_cli.bundle_adjustment.views import Views, arrange, noise_model
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["reweighted", "weighed"]

_PASSES = 10
_SETTLED = 0.005  # change of the share that no result depends on


def reweighted(job: Job, solution: Solution, points: Correspondences) -> tuple[Job, Solution, float]:
    """Refine again with the share of the noise that is the same for all points; see `noise`.

    Parameters
    ----------
    job, solution
        Adjusted by the stated covariances alone.
    points : Correspondences
        What the job's views are of.

    Returns
    -------
    job, solution
    share : float
    """
    if points.covariance is None or not measured(points.covariance):
        return job, solution, 0.0
    # From equal weights: residuals of a fit that a few points rule would confirm that they should.
    noise = Noise(share=1.0)
    job, solution = _weighed(job, solution, points, noise)
    for _ in range(_PASSES):
        residuals = point_residuals(job.views, solution.adjusted.state) * job.views.pixel_scale
        last, noise = noise, noise_of(_stated(points, job.views), residuals, job.views.across)
        if max(abs(noise.share - last.share), abs(noise.along - last.along)) < _SETTLED:
            break
        job, solution = _weighed(job, solution, points, noise)
    return job, solution, noise.share


def weighed(points: Correspondences, residuals: Array) -> Views:
    """Points arranged, and weighed as far as residuals (N, 2) [px] of a calibration bear out."""
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


def _weighed(job: Job, solution: Solution, points: Correspondences, noise: Noise) -> tuple[Job, Solution]:
    job = replace(job, views=_with_noise(job.views, points, noise), tally=job.tally)
    return job, Solution(job.adjust(solution.adjusted.state), job.tally)

"""Points weighed by their measured covariances only as far as the residuals bear them out."""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.adjustment.job import Job, Solution
from neurocal_cli.adjustment.noise import common_share, measured, with_common_share
from neurocal_cli.adjustment.views import noise_model
from neurocal_cli.adjustment.whiteness import of_points
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["reweighted"]

_PASSES = 10
_SETTLED = 0.005  # change of the share that no result depends on


def reweighted(job: Job, solution: Solution, points: Correspondences) -> tuple[Job, Solution, float]:
    """Refine again with the share of the noise that is the same for all points; see `noise`.

    Parameters
    ----------
    job, solution
        Refined by the stated covariances alone.
    points : Correspondences
        What the job's views are of.

    Returns
    -------
    job, solution
    share : float
    """
    if points.covariance is None or not measured(points.covariance):
        return job, solution, 0.0
    stated = points.covariance if job.views.order is None else points.covariance[job.views.order]
    # From equal weights: residuals of a fit that a few points rule would confirm that they should.
    share = 1.0
    job, solution = _with_share(job, solution, stated, share)
    for _ in range(_PASSES):
        last, share = share, common_share(stated, of_points(job.views, solution.refined.state))
        if abs(share - last) < _SETTLED:
            break
        job, solution = _with_share(job, solution, stated, share)
    return job, solution, share


def _with_share(job: Job, solution: Solution, stated: Array, share: float) -> tuple[Job, Solution]:
    whitening = noise_model(with_common_share(stated, share))[1]
    job = replace(job, views=replace(job.views, whitening=whitening), tally=job.tally)
    return job, Solution(job.refine(solution.refined.state), job.tally)

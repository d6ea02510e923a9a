"""A lens model that was asked for, from another start where the first ends in a wrong minimum.

A strong lens can be told from a pinhole's mistakes only if the descent begins near it. Where the residuals of
neighbours are alike, as a wrong lens leaves them (and a board that is not flat), every model is fitted, each
from the one before it, from this start and from others; the wanted one is the best of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.distortion.candidate_models import fit_candidates
from neurocal_cli.points import Correspondences

__all__ = ["with_more_starts"]

_ALIKE = 0.15  # correlation of neighbours' residuals


def with_more_starts(
    job: Job,
    solution: Solution,
    points: Correspondences,
    more_starts: Callable[[], Iterable[CameraState]],
) -> Solution:
    """The better of a solution and what other starts lead to, where it may be a wrong minimum.

    Parameters
    ----------
    job : Job
        With the model to be estimated; without one there is nothing to do.
    solution : Solution
    points : Correspondences
    more_starts : callable
        Other states to begin with.
    """
    views, state = job.views, solution.adjusted.state
    if not job.known.free_lens:
        return solution
    if solution.adjusted.converged and correlation(views, point_residuals(views, state)) < _ALIKE:
        return solution
    best, cost = solution, float(solution.adjusted.cost.sum())
    for start in (state, *more_starts()):
        found = fit_candidates(job, start, points, by_views=False).get(job.known.lens.model)
        if found is None or not found.adjusted.cost.sum() < cost:
            continue
        adjusted = job.adjust(found.adjusted.state)
        if adjusted.cost.sum() < cost:
            best, cost = Solution(adjusted, job.tally), float(adjusted.cost.sum())
    return best

"""A lens model that was asked for, from another start where the first ends in a wrong minimum.

A strong lens can be told from a pinhole's mistakes only if the descent begins near it. Where the residuals of
neighbours are alike, as a wrong lens leaves them (and a board that is not flat), every model is fitted, each
from the one before it, from this start and from others; the wanted one is the best of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from neurocal_cli.adjustment.job import Job, Solution
from neurocal_cli.adjustment.pixel_error import CameraState
from neurocal_cli.adjustment.whiteness import correlation, of_points
from neurocal_cli.lenses.candidates import fit_candidates
from neurocal_cli.points import Correspondences

__all__ = ["with_lens_asked_for"]

_ALIKE = 0.15  # correlation of neighbours' residuals


def with_lens_asked_for(
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
    views, state = job.views, solution.refined.state
    if not job.known.free_lens:
        return solution
    if solution.refined.converged and correlation(views, of_points(views, state)) < _ALIKE:
        return solution
    best, cost = solution, float(solution.refined.cost.sum())
    for start in (state, *more_starts()):
        found = fit_candidates(job, start, points, by_views=False).get(job.known.lens.model)
        if found is None or not found.refined.cost.sum() < cost:
            continue
        refined = job.refine(found.refined.state)
        if refined.cost.sum() < cost:
            best, cost = Solution(refined, job.tally), float(refined.cost.sum())
    return best

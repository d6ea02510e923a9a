"""Multi-start for a given distortion model, against local minima.

The minimum of a strong distortion is found only from a start near it. If the residuals of neighbours are
correlated (as a wrong distortion or a board that is not flat leaves them), or if a focal length is poorly
determined, all models are fitted from this start and from others, each model from a simpler one. The best fit
of the wanted model is the result. Wide lenses are reached from the fisheye, thin-prism and tilted models from
the rational model. With many views, a few of them are used to test whether another start leads to a lower
minimum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.observability import is_weak
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState, farthest_angle
from neurocal_cli.bundle_adjustment.residual_correlation import correlation
from neurocal_cli.bundle_adjustment.restart import is_elsewhere, of_few_views
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import WITH_PRISM
from neurocal_cli.distortion.denominator import DENOMINATOR

# Repeated by tests/test_multi_start.py (slow: 200 lenses of each of five models): every local minimum there
# had a larger correlation.
_CORRELATED = 0.15  # correlation of neighbouring residuals
FEW_VIEWS = 20  # most views with which other starts are tested, to limit the time
_LOWER = 0.999  # ratio of squared errors below which a minimum is lower


def with_more_starts(solution: Solution, more_starts: Callable[[Problem], Iterable[CameraState]]) -> Solution:
    """The better of a solution and the results of other starts, if it may be a local minimum.

    Parameters
    ----------
    solution : Solution
        Returned unchanged if no distortion is estimated.
    more_starts : callable
        Yields other starting states for a problem.
    """
    problem = solution.problem
    # A fixed xi and omitted k4 to k6 were chosen for this fit, so others do not compare.
    if not problem.free_distortion or problem.fixed & {"xi", *DENOMINATOR} or not _may_be_local(solution):
        return solution
    few = of_few_views(solution, FEW_VIEWS)
    if few is solution or is_elsewhere(few, solution) or _is_lower(few, _lowest(few, more_starts)):
        return replace(solution, adjusted=_lowest(solution, more_starts))
    return solution


def _is_lower(solution: Solution, other: Adjusted) -> bool:
    return _cost(other) < _LOWER * _cost(solution.adjusted)


def _may_be_local(solution: Solution) -> bool:
    if not solution.adjusted.converged or is_weak(solution.problem, solution.state, solution.covariance):
        return True
    return not correlation(solution.problem.views, solution.residuals) < _CORRELATED


def _lowest(solution: Solution, more_starts: Callable[[Problem], Iterable[CameraState]]) -> Adjusted:
    """The lowest minimum of the wanted model from all starts."""
    # Imported here, because most calibrations need no other starts.
    from neurocal_cli.distortion.candidate_models import fit_candidates

    problem, best = solution.problem, solution.adjusted
    wanted = problem.distortion.model
    fitted = "fisheye" if wanted in WIDE else "rational" if wanted in WITH_PRISM else wanted
    for start in (best.state, *more_starts(problem)):
        found = fit_candidates(problem, start, by_views=False, wanted=fitted).get(fitted)
        if found is None or (fitted == wanted and not found.cost < _cost(best)):
            continue
        for near in _as(wanted, found.adjusted, problem.views):
            adjusted = problem.adjust(near)
            if _cost(adjusted) < _cost(best):
                best = adjusted
    return best


def _cost(adjusted: Adjusted) -> float:
    return float(adjusted.cost.sum())


def _as(wanted: str, found: Adjusted, views: Views) -> list[Adjusted]:
    """The fit itself if it has the wanted model, else the most similar lenses of that model."""
    if found.state.model == wanted:
        return [found]
    from neurocal_cli.distortion.similar_lens import similar_states

    starts = similar_states(found.state, wanted, farthest_angle(views, found.state))
    return [replace(found, state=start) for start in starts]

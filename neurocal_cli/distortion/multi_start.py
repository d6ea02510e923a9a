"""A given choice of distortion model, fitted from other starts where the first ends in a local minimum.

The minimum of a strong distortion is found only from a start that is near it. Where the residuals of
neighbours are correlated, as a wrong distortion leaves them (and a board that is not flat), or where the
points tell a focal length badly, every model is fitted, each from the one before it, from this start and
from others; the best fit of the wanted model is the result. Wide lenses are reached through the fisheye, and
a thin prism or a tilted sensor through the rational model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.covariance import covariance
from neurocal_cli.bundle_adjustment.observability import is_weak
from neurocal_cli.bundle_adjustment.reprojection import CameraState, farthest_angle
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import WIDE, WITH_PRISM
from neurocal_cli.distortion.denominator import DENOMINATOR

__all__ = ["with_more_starts"]

# Repeated by tests/test_multi_start.py (slow: 200 lenses of each of five models): every local minimum there
# showed more.
_CORRELATED = 0.15  # correlation of neighbours' residuals


def with_more_starts(solution: Solution, more_starts: Callable[[], Iterable[CameraState]]) -> Solution:
    """The better of a solution and what other starts lead to, where it may be a local minimum.

    Parameters
    ----------
    solution : Solution
        Of a problem whose distortion model is to be estimated; without one there is nothing to do.
    more_starts : callable
        Other states to begin with.
    """
    problem, best = solution.problem, solution.adjusted
    # An xi that is held, and k4 to k6 that are left out, belong to this lens.
    if not problem.free_distortion or problem.fixed & {"xi", *DENOMINATOR}:
        return solution
    views, wanted = problem.views, problem.distortion.model
    cov = covariance(best.normal, problem.free_camera, problem.free_poses, views.n_equations)
    weak = is_weak(problem, best.state, cov)
    if best.converged and not weak and correlation(views, point_residuals(views, best.state)) < _CORRELATED:
        return solution

    # Most are at the lowest minimum, and need none of what follows.
    from neurocal_cli.distortion.candidate_models import fit_candidates

    fitted = "fisheye" if wanted in WIDE else "rational" if wanted in WITH_PRISM else wanted
    for start in (best.state, *more_starts()):
        found = fit_candidates(problem, start, by_views=False, wanted=fitted).get(fitted)
        if found is None or (fitted == wanted and not found.adjusted.cost.sum() < best.cost.sum()):
            continue
        for near in _as(wanted, found.adjusted, views):
            adjusted = problem.adjust(near)
            if adjusted.cost.sum() < best.cost.sum():
                best = adjusted
    return replace(solution, adjusted=best)


def _as(wanted: str, found: Adjusted, views: Views) -> list[Adjusted]:
    """The fit itself where it is of the wanted model, else the most similar lenses of that model."""
    if found.state.model == wanted:
        return [found]
    from neurocal_cli.distortion.similar_lens import similar_states

    starts = similar_states(found.state, wanted, farthest_angle(views, found.state))
    return [replace(found, state=start) for start in starts]

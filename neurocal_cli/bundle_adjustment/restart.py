"""A solution adjusted again to other points: fewer of them, or those of fewer views."""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.units import normalised
from neurocal_cli.points import Correspondences


def restarted(solution: Solution, points: Correspondences) -> Solution:
    """Adjust a solution to other points of the same views, or of some of them."""
    problem = solution.problem.with_points(points)
    if not problem.free_distortion:
        problem = problem.with_seen_pixels()
    place = [solution.problem.views.names.index(name) for name in problem.views.names]
    known, record = solution.in_pixels, solution.record
    start = normalised(replace(known, R=known.R[place], t=known.t[place]), problem.views)
    return Solution(
        problem,
        problem.adjust(replace(solution.adjusted, state=start)),
        replace(record, agreed=record.agreed[place]),
        would_take=solution.would_take,
    )


def of_few_views(solution: Solution, most: int) -> Solution:
    """The solution adjusted to at most so many of its views."""
    few = solution.problem.points.of_few_views(most)
    return solution if few is solution.problem.points else restarted(solution, few)

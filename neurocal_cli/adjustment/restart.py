"""Adjust a known solution again to other points: fewer of them, or those of fewer views."""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.units import normalised
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

# Least ratio of the squared errors after and before, at the same minimum: the fifteen unknowns of a lens
# explain a twentieth of 300 residuals.
_SAME = 0.9


def restarted(solution: Solution, points: Correspondences) -> Solution:
    """Adjust a solution to other points of the same views, or of some of them."""
    known = solution.problem
    if points is known.points and points.covariance is None and known.penalty is None:  # it is there already
        return Solution(known, solution.adjusted, solution.record, would_take=solution.would_take)
    problem = solution.problem.with_points(points)
    if not problem.free_distortion:
        problem = problem.with_seen_pixels()
    place = _places(problem, solution)
    return Solution(
        problem,
        problem.adjust(replace(solution.adjusted, state=_start(problem, solution))),
        replace(solution.record, agreed=solution.record.agreed[place]),
        would_take=solution.would_take,
    )


def of_few_views(solution: Solution, most: int) -> Solution:
    """The solution adjusted to at most `most` of its views."""
    few = solution.problem.points.of_few_views(most)
    return solution if few is solution.problem.points else restarted(solution, few)


def is_elsewhere(few: Solution, whole: Solution) -> bool:
    """Whether a solution moved to another local minimum when it was adjusted `of_few_views`.

    At the same minimum, the squared error of these views hardly drops.
    """
    before, _ = normal_blocks(few.problem.views.batches, _start(few.problem, whole))
    return bool(few.adjusted.cost.sum() < _SAME * before[:, -1, -1].sum())


def _start(problem: Problem, solution: Solution) -> CameraState:
    """The state of a solution, reduced to the views of a problem and normalised as they are."""
    known, place = solution.in_pixels, _places(problem, solution)
    return normalised(replace(known, R=known.R[place], t=known.t[place]), problem.views)


def _places(problem: Problem, solution: Solution) -> list[int]:
    place = {name: k for k, name in enumerate(solution.problem.views.names)}
    return [place[name] for name in problem.views.names]

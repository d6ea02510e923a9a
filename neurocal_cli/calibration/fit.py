"""Fit a problem: from random weights, or again from a known solution with points added or left out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

from neurocal_cli.adjustment.common_noise import reweighted
from neurocal_cli.adjustment.cross_validation import quietly
from neurocal_cli.adjustment.observability import check_points
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import farthest_angle
from neurocal_cli.adjustment.residual_correlation import effective_number
from neurocal_cli.adjustment.solution import Solution, restarted
from neurocal_cli.calibration.lens_choice.given_model import (
    DENOMINATOR,
    Starts,
    check_distortion,
    total_cost,
    with_denominator_if_supported,
    with_more_starts,
)
from neurocal_cli.calibration.verdict.findings import LEVEL, log_odds
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import WITH_PRISM
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.local_minima import OnlyMirroredError, try_mirrored
from neurocal_cli.network.neuro import solve
from neurocal_cli.network.options import Options
from neurocal_cli.observations.points import Correspondences

# Model of a second start, for when the radial start fails, for example because the distortion centre is far
# from the image centre. Repeated by test_multi_start.py (slow: 200 lenses of each of five models, no
# local minimum).
_FIRST_MODEL = "k1k2"
_TILT_ROUNDS, _TILT_STEPS = 2, 60
_SKEW = 1  # place of A12 among A's entries


@quietly  # starts that run into a pole of the distortion or into the camera's plane lose
def fit(
    problem: Problem, options: Options, known: Solution | None = None, *, more_starts: bool = True
) -> Solution:
    """Fit a camera and its distortion model from random weights, or from a known fit of the same points.

    Without `more_starts`, the minimum next to that of a pinhole is taken.

    Raises `DegenerateGeometryError` if the points do not determine the camera; the message says why.
    """
    if known is not None:
        return fit_again(known, problem.points, options, only_from_here=True)
    if options.distortion == "plumb-line":
        return _plumb_line_first(problem, options)
    if problem.free_distortion and problem.distortion.model == "rich":
        return _displaced(fit(problem.with_model("fisheye"), options))
    check_points(problem)
    return _finished(_first_solution(problem, options), options, not more_starts)


@quietly
def fit_again(
    solution: Solution, points: Correspondences, options: Options, *, only_from_here: bool = False
) -> Solution:
    """Fit other points of the same views (or of some of them), starting from a solution.

    With `only_from_here`, no other starts are tried, because the solution is already near the minimum.
    """
    if options.distortion == "plumb-line":
        return _plumb_line_first(solution.problem.with_points(points), options)
    again = restarted(solution, points)
    if again.problem.penalty is not None:  # a rich lens's prior
        return _displaced(again)
    return _finished(again, options, only_from_here)


def _finished(solution: Solution, options: Options, only_from_here: bool = False) -> Solution:
    """Find the lens, and reweight the points as far as the residuals support that."""
    starts = None if only_from_here else partial(_distorted_starts, options=options)
    solution = reweighted(_with_lens(solution, starts, options))
    # A selected lens is checked already, but reweighting may have moved it.
    if options.distortion != "auto" or solution.problem.points.covariance is not None:
        solution = check_distortion(solution)
    return solution


def _with_lens(solution: Solution, starts: Starts | None, options: Options) -> Solution:
    """The lowest minimum of the named lens, or of the one that is selected among all.

    It is found again if mirrored poses of flat boards fit better with it. Other starts are tried if there are
    any.
    """

    def found_from(start: Solution) -> Solution:
        if options.distortion != "auto":
            return with_more_starts(start, starts)
        from neurocal_cli.calibration.lens_choice.model_selection import select_model

        return select_model(start, starts, options.preferred)

    found = found_from(solution)
    # The first solution of several views that share a camera has tried the mirrored poses already.
    tried = found is solution and solution.problem.type != 3 and solution.problem.views.n_views > 1
    turned = found if starts is None or tried else _turned(found)
    return found if turned is found else found_from(replace(solution, adjusted=turned.adjusted))


def _first_solution(problem: Problem, options: Options) -> Solution:
    """Fit a pinhole; if strong distortion makes the points look mirrored to it, a camera with distortion.

    If distortion does not help either, the pinhole's error is raised. Wide lenses start from a fisheye, whose
    coefficients enter linearly; thin-prism and tilted models start without the prism or tilt.
    """
    model = problem.distortion.model
    if problem.free_distortion and model in WIDE and model != "fisheye":
        return _from_simpler(problem, _first_solution(problem.with_model("fisheye"), options))
    if problem.free_distortion and model in WITH_PRISM:
        plain = _first_solution(problem.with_model("plumb_bob"), options)
        return with_denominator_if_supported(
            _from_simpler(replace(problem, fixed=problem.fixed | DENOMINATOR), plain)
        )
    try:
        return solve(problem, options)
    except OnlyMirroredError:
        found = _through_distortion(problem, options)
        if found is None:
            raise
        return found


def _from_simpler(problem: Problem, simpler: Solution) -> Solution:
    """Adjust the wanted model from its lenses that are most similar to a simpler one; the best result."""
    from neurocal_cli.calibration.lens_choice.xi_profile import with_xi_held_if_flat
    from neurocal_cli.camera.nearest_camera import similar_states, tilted_states

    state, views = simpler.state, problem.views
    starts = similar_states(state, problem.distortion.model, farthest_angle(views, state))
    found = [problem.adjust(replace(simpler.adjusted, state=start)) for start in starts]
    if not found:
        raise DegenerateGeometryError(
            f"no lens of the distortion model {problem.distortion.model} fits these points; choose another "
            "--distortion"
        )
    if problem.distortion.model == "tilted" and problem.free_poses and problem.free[3:].all():
        for _ in range(_TILT_ROUNDS):
            lowest = min(found, key=total_cost)
            found += [
                problem.adjust(replace(lowest, state=s), _TILT_STEPS) for s in tilted_states(lowest.state)
            ]
    best = min(found, key=total_cost)
    problem, best = with_xi_held_if_flat(problem, best)
    return _turned(replace(simpler, problem=problem, adjusted=best))


def _distorted_starts(problem: Problem, options: Options) -> Iterator[CameraState]:
    """Further starting cameras, which include distortion from the beginning."""
    from neurocal_cli.calibration.lens_choice.candidate_models import supported
    from neurocal_cli.network.radial_networks import radial_start

    found = radial_start(problem, options)
    if found is not None:
        yield found.state
    first = supported(problem, _FIRST_MODEL)
    if first is not None:
        with suppress(DegenerateGeometryError):
            yield _turned(solve(first, options)).state


def _through_distortion(problem: Problem, options: Options) -> Solution | None:
    """Fit with distortion from the beginning; None if none is to be estimated, or if that fails too."""
    wanted = problem.distortion.model
    if problem.type == 3 or (options.distortion != "auto" and not problem.free_distortion):
        return None
    from neurocal_cli.calibration.lens_choice.candidate_models import fit_candidates
    from neurocal_cli.network.radial_networks import radial_start

    found = radial_start(problem, options)
    if found is None or options.distortion == "auto":
        return found
    fitted = fit_candidates(problem, found.state, by_views=False).get(wanted)
    return None if fitted is None else _turned(replace(found, problem=problem, adjusted=fitted.adjusted))


def _displaced(solution: Solution) -> Solution:
    """Add the displacement of a rich lens. The import is local because other models do not need it."""
    from neurocal_cli.calibration.lens_choice.rich_fit import with_displacement

    return with_displacement(solution)


def _plumb_line_first(problem: Problem, options: Options) -> Solution:
    """Estimate the distortion from straight lines, then the pinhole camera, then both together."""
    # Imported here: it takes 0.01 s, which other models need not spend.
    from neurocal_cli.calibration.lens_choice.plumb_line import distortion_and_camera, fit_plumb_line

    points = problem.points
    plumb = fit_plumb_line(points, problem.given_centre)
    pinhole = problem.with_points(plumb.corrected(points))
    check_points(pinhole)
    corrected = reweighted(solve(pinhole, options))
    solution = distortion_and_camera(corrected, plumb, points)
    return replace(check_distortion(solution), straight_lines=plumb.record)


def _turned(solution: Solution) -> Solution:
    """Use the mirrored pose of a flat board in each view where it fits better with the distortion."""
    if solution.state.model == "none":
        return solution
    turned = try_mirrored(solution.problem, solution.adjusted)
    return solution if turned.state is solution.state else replace(solution, adjusted=turned)


def shows_skew(solution: Solution) -> bool:
    """Whether theta, held at 90 degrees by the solution, has the evidence that causes of errors need."""
    problem = solution.problem
    free = problem.free.copy()
    free[_SKEW] = True
    skewed = replace(problem, free=free, fixed=problem.fixed - {"theta"})
    cost, with_it = float(solution.adjusted.cost.sum()), float(skewed.adjust(solution.adjusted).cost.sum())
    if not 0 < with_it < cost:
        return False
    n = effective_number(max(problem.views.n_equations - skewed.n_parameters, 1.0), solution.alike)
    return log_odds(cost, with_it, n, 1) > LEVEL

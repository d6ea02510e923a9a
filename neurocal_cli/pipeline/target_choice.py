"""The target found with the camera, where the data ask for it: lens and target are chosen together.

A bent board looks like a lens. So the target is found under the lens that was chosen for the given target,
the lens is chosen anew for the target that was found, and so on until the lens stays. The points that were
set aside are judged anew, too: many of them contradict only the given target.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.outlier_views import conditions_on_views, free_networks
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.repeated_poses import repeated_poses
from neurocal_cli.bundle_adjustment.reprojection import predicted_pixels
from neurocal_cli.bundle_adjustment.residual_correlation import point_residuals
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.calibration import Rejected
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.initialisation.options import Options
from neurocal_cli.pipeline.fit import fit, fit_again
from neurocal_cli.pipeline.odd_views import may_be_bent
from neurocal_cli.pipeline.outlier_rejection import NO_WORSE, fit_robustly, rms
from neurocal_cli.pipeline.surveyed_points import with_survey
from neurocal_cli.target import Target, distinct_points, planes_of
from neurocal_cli.target_shape.bent_anew import find_bends
from neurocal_cli.target_shape.find import LEAST_GAIN, Found, enough_views, find_target
from neurocal_cli.target_shape.lens_and_target import find_lens_and_target, named_lens_is_too_simple
from neurocal_cli.verdict.given_parameters import asked_for
from neurocal_cli.verdict.stated_noise import stated_noise
from neurocal_cli.verdict.view_groups import OWN_STEPS, ViewGroups, view_groups

_ROUNDS = 3
_WORTH = 0.8  # of the views' number, where some repeat a pose
_OF_LINES = "k1k2p1p2"  # as `plumb-line` finds
_TOLD_APART = 5.0  # standard deviations, as for the verdict
# Of the variance by which views contradict each other, bends explain nine tenths, or leave but a little. With
# eight tenths, a half of photographs of paper boards predicts the other half 3 % worse.
_SHARE, _NOISE = 0.9, 1.1
_SETTLED = 0.01  # standard deviations by which a camera may move and still is the same


def with_target(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str
) -> tuple[Solution, Rejected]:
    """Find the target, and fit the camera to it.

    Parameters
    ----------
    problem : Problem
        With all points, where their file has them.
    solution, rejected
        For the given target.
    options : Options
    choice : {"auto", "given", "flat", "free"}

    Returns
    -------
    solution, rejected
        The ones given where the target stays as it is.
    """
    if choice != "given" and problem.points.world_std is not None and not solution.refusal:
        return with_survey(problem, solution, rejected, options)
    rich = solution.state.model == "rich"  # it bends as a target does
    if choice == "given" or solution.refusal or options.distortion == "plumb-line" or rich:
        return solution, rejected
    known = _searched(problem, solution, rejected, options, choice)
    target, views = known[0].target, known[1].views
    unexplained = target is None or target.bends is not None
    if unexplained and views and all(map(may_be_bent, views.values())):
        return _taking_views_back(problem, solution.of_all, known, options, choice)
    return known


def _taking_views_back(
    problem: Problem,
    of_all: Solution | None,
    known: tuple[Solution, Rejected],
    options: Options,
    choice: str,
) -> tuple[Solution, Rejected]:
    """With a target that explains all views, where some contradict only the given one."""
    try:
        found = _searched(problem, of_all or fit(problem, options), known[1], options, choice)
    except DegenerateGeometryError:
        return known
    explained = found[0].target is not None and not found[1].views
    return found if explained and rms(found[0]) <= NO_WORSE * rms(known[0]) else known


def _searched(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str
) -> tuple[Solution, Rejected]:
    """As `with_target`, beginning with the views of one solution."""
    if not _can_tell(solution, choice, None):
        return solution, rejected
    found = _found(solution, choice, None)
    if choice != "flat":
        found = _with_bends(solution, found)
    if found is not None and choice == "auto" and _other_reason(solution, found):
        return solution, rejected
    kept = replace(solution, target_kept=choice == "auto")
    best: tuple[Solution, Rejected] = kept, rejected
    for _ in range(_ROUNDS):
        if found is None:
            break
        (new, adjusted), *_ = found.fits
        # A view that only contradicted the given target is back, with a record of its own.
        start = replace(solution, problem=new, adjusted=adjusted, record=best[0].record)
        again = _fitted_to(problem, found.target, (start, best[1]), options)
        if again is None:
            break
        lens = new.distortion.model
        known = found.target
        if not _can_tell(again[0], choice, known):
            break
        if not _is_where_it_was(found, again[0]):
            found = _found(again[0], choice, known)
        if found is None:
            break
        (new, adjusted), *_ = found.fits
        best = replace(again[0], problem=new, adjusted=adjusted, target=found.target), again[1]
        if new.distortion.model == lens:
            break
    return best


def lines_that_are_bent(solution: Solution, unit: str) -> str:
    """What a bent board does to a distortion that was found from straight lines; empty where it is not bent.

    The bend is told by a free distortion, because the one from the lines has taken it in.
    """
    problem = solution.problem.with_model(_OF_LINES)
    fit = problem, problem.adjust(solution.adjusted)
    _, label, _ = distinct_points([problem.points])
    if not problem.free_poses or not enough_views(label, problem.views.n_views):
        return ""
    found = find_target([fit], least_gain=LEAST_GAIN)
    if found is None or _other_reason(replace(solution, problem=fit[0], adjusted=fit[1]), found):
        return ""
    target = found.target
    off = float(np.sqrt((target.offsets**2).sum(axis=1).mean()))
    return (
        f"the target is bent by {target.bend():.2g} {unit}, and its points lie {off:.2g} {unit} rms from "
        "where they are given; its lines are not straight, and the distortion that they tell has taken that "
        "in; find it from the points instead (--distortion auto)"
    )


def _other_reason(solution: Solution, found: Found) -> bool:
    """Whether stated sigmas, a named distortion, given parameters or several cameras are why."""
    problem, points = solution.problem, solution.problem.points
    place = np.array([problem.views.names.index(name) for name in points.view_names])
    predicted, _ = predicted_pixels(solution.in_pixels, points.world, place[points.view_index])
    if any(grade for grade, *_ in stated_noise(points, predicted - points.pixels)):
        return True
    named = solution.model_errors is None and solution.straight_lines is None
    if named and named_lens_is_too_simple([(problem, solution.adjusted)], found):
        return True
    if not problem.free_poses:
        return False
    asked = asked_for(problem.views, solution.state, problem.fixed, problem.free_poses)
    if any(abs(a.found - a.given) > _TOLD_APART * a.std for a in asked):
        return True
    return _are_two_cameras(solution, found)


def _are_two_cameras(solution: Solution, found: Found) -> bool:
    """Whether two cameras, or a zoom that moves, explain more with the given target than one with the found.

    They still contradict each other where the target was found; a bent board looks like two before. One that
    is bent anew in some views looks like two afterwards, too, but these explain less.
    """
    if _groups(*found.fits[0]) is None:
        return False
    before, (_, after) = solution.adjusted, found.fits[0]
    groups = _groups(solution.problem, before)
    return groups is not None and bool((1.0 - groups.explained) * before.cost.sum() < after.cost.sum())


def _groups(problem: Problem, adjusted: Adjusted) -> ViewGroups | None:
    """Two cameras among the views, or a zoom that moves."""
    if not problem.free.any():
        return None
    return view_groups(problem.views, adjusted.state, adjusted.normal, problem.free_camera)


def _with_bends(solution: Solution, common: Found | None) -> Found | None:
    """With bends of each view, if these explain why the views contradict each other.

    Of two cameras, or of a rolling shutter, they explain a part.
    """
    fit = solution.problem, solution.adjusted
    found = find_bends(fit, common)
    if found is None or found.target.bends is None:
        return found
    before, after = fit if common is None else common.fits[0], found.fits[0]
    least = _noise_of_views(*after)
    given = _noise(*before, 0.0)
    bent = _noise(*after, found.target.bends.determined(found.target.bends.coefficients))
    if bent > _NOISE * least and given - bent < _SHARE * (given - least):
        return common
    # Two cameras of this lens leave no less than a camera for each view.
    least_of_groups = float(free_networks(before[0].views, before[1].state, OWN_STEPS).sum())
    if float(after[1].cost.sum()) < least_of_groups:
        return found
    groups = _groups(*before)
    explained = 1.0 - float(after[1].cost.sum() / before[1].cost.sum())
    return found if groups is None or groups.explained < explained else common


def _noise(problem: Problem, adjusted: Adjusted, determined: float) -> float:
    """Variance of the residuals, normalised."""
    unknowns = int(problem.free_camera.sum()) + 6 * problem.views.n_views + determined
    return float(adjusted.cost.sum()) / max(problem.views.n_equations - unknowns, 1.0)


def _noise_of_views(problem: Problem, adjusted: Adjusted) -> float:
    """The same where every view has a camera of its own."""
    unknowns = 6 + conditions_on_views(problem.views, adjusted.state)
    own = float(free_networks(problem.views, adjusted.state).sum())
    return own / max(problem.views.n_equations - float(unknowns.sum()), 1.0)


def _can_tell(solution: Solution, choice: str, known: Target | None) -> bool:
    """Whether there are enough different views of the target."""
    problem, views = solution.problem, solution.problem.views
    points = problem.points if known is None else known.straightened(problem.points)
    given, label, point = distinct_points([points])
    repeated = repeated_poses(views, solution.state, point_residuals(views, solution.state))
    plane = planes_of(given, point) if known is None else known.plane
    if not enough_views(label, repeated.n_poses, int(plane.max()) + 1):
        return False
    # Errors that copies of a view share look like the target's.
    return choice != "auto" or not repeated.worth < _WORTH


def _is_where_it_was(found: Found, again: Solution) -> bool:
    """Whether the camera that was fitted to a target again is the one that the target was found with."""
    (problem, adjusted), new = found.fits[0], again.problem
    if problem.views.names != new.views.names or problem.distortion.model != new.distortion.model:
        return False
    same = np.array_equal(problem.points.pixels, new.points.pixels)
    cost, gained = adjusted.cost.sum(), abs(adjusted.cost.sum() - again.adjusted.cost.sum())
    return (
        same
        and np.array_equal(problem.free_camera, new.free_camera)
        and bool(gained * problem.views.n_equations < _SETTLED**2 * cost)
    )


def _found(solution: Solution, choice: str, known: Target | None) -> Found | None:
    # Only a lens that nobody named may change.
    find = find_lens_and_target if solution.model_errors is not None and known is None else find_target
    least = LEAST_GAIN if choice == "auto" else -np.inf
    return find([(solution.problem, solution.adjusted)], choice == "flat", known, least)


def _fitted_to(
    problem: Problem, target: Target, before: tuple[Solution, Rejected], options: Options
) -> tuple[Solution, Rejected] | None:
    """The camera for a target, its lens and its outliers chosen anew; None where that fails."""
    solution, rejected = before
    try:
        if len(rejected) or rejected.views:
            again, rejected = fit_robustly(problem.with_points(target.seen(problem.points)), options)
        else:
            points = target.seen(problem.points)
            again = fit_again(solution, points, options, only_from_here=True)
    except DegenerateGeometryError:
        return None
    return None if again.refusal else (again, rejected)

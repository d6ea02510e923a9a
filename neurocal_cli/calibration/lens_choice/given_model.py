"""The fit of one distortion model: other starts, the denominator of a thin prism, monotonicity.

Other starts. The minimum of a strong distortion is found only from a start near it. If the residuals of
neighbours are correlated (as a wrong distortion or a board that is not flat leaves them), or if a focal
length is poorly determined, all models are fitted from this start and from others, each model from a simpler
one. The best fit of the wanted model is the result. Wide lenses are reached from the fisheye, thin-prism and
tilted models from the rational model. With many views, a few of them are used to test whether another start
leads to a lower minimum.

Denominator. k4, k5 and k6 of a thin-prism or tilted lens are optional in OpenCV (CALIB_RATIONAL_MODEL). In an
ordinary lens they are nearly degenerate with k1, k2 and k3. So they stay 0 unless the Bayesian information
criterion decidedly favours them.

Given distortion. The networks model a pinhole. A given distortion is removed from the pixels before training
(`Problem`), and the final adjustment uses the observed pixels.

Undetermined coefficients. A model with many coefficients, of which the points determine only some, may fold
the image back or not converge. A simpler model that explains the same points shows that this is the cause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.observability import is_weak
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import farthest_angle
from neurocal_cli.adjustment.residual_correlation import independent_residuals
from neurocal_cli.adjustment.solution import Solution, is_elsewhere, of_few_views
from neurocal_cli.calibration.lens_choice.monotonic_fit import fit_monotonic, folds_back
from neurocal_cli.calibration.verdict.findings import log_odds
from neurocal_cli.camera.directions import WIDE, WITH_XI
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS, WITH_PRISM
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError

# Repeated by test_multi_start.py (slow: 200 lenses of each of five models): every local minimum there
# had a larger correlation.
WRONG_LENS = 0.15
"""Correlation of neighbouring residuals from which on another minimum or lens may be the right one."""
_FEW_VIEWS = 20  # most views with which other starts are tested, to limit the time
LOWER = 0.999
"""Ratio of squared errors below which a minimum is lower."""
DENOMINATOR = frozenset({"k4", "k5", "k6"})
_STEPS = 150  # many, because the coefficients are nearly degenerate
_STEPS_OF_SIMPLER = 60
# Repeated by test_prism_and_tilt.py (slow): 100 lenses without a denominator and with one.
DECISIVE = 10.0  # difference of the criterion: odds of 150

Starts = Callable[[Problem], Iterable[CameraState]]  # yields other starting states for a problem


def with_more_starts(solution: Solution, more_starts: Starts | None) -> Solution:
    """The better of a solution and the results of other starts, if it may be a local minimum.

    A solution without an estimated distortion, or without other starts, is returned unchanged.
    """
    problem = solution.problem
    # A fixed xi and omitted k4 to k6 were chosen for this fit, so others do not compare.
    if more_starts is None or not problem.free_distortion or problem.fixed & {"xi", *DENOMINATOR}:
        return solution
    poor = not solution.adjusted.converged or is_weak(problem, solution.state, solution.covariance)
    if not poor and solution.alike < WRONG_LENS:
        return solution
    if not may_lead_lower(solution, LOWER, more_starts):
        return solution
    return replace(solution, adjusted=_lowest(solution, more_starts))


def may_lead_lower(solution: Solution, share: float, more_starts: Starts) -> bool:
    """Whether other starts may lead below a share of the squared error; of many views, a few are tried.

    The lens of the solution is fitted from each start. That the lens of a start, often a fisheye, fits better
    by itself does not count, as it is another lens and no other minimum.
    """
    few = of_few_views(solution, _FEW_VIEWS)
    if few is solution or is_elsewhere(few, solution):
        return True
    # Imported here, because most calibrations need no other starts.
    from neurocal_cli.calibration.lens_choice.candidate_models import adjusted_to

    problem, least = few.problem, share * total_cost(few.adjusted)
    return any(total_cost(adjusted_to(problem, start)) < least for start in more_starts(problem))


def _lowest(solution: Solution, more_starts: Starts) -> Adjusted:
    """The lowest minimum of the wanted model from all starts."""
    from neurocal_cli.calibration.lens_choice.candidate_models import fit_candidates
    from neurocal_cli.camera.nearest_camera import similar_states

    problem, best = solution.problem, solution.adjusted
    wanted = problem.distortion.model
    fitted = "fisheye" if wanted in WIDE else "rational" if wanted in WITH_PRISM else wanted
    for start in (best.state, *more_starts(problem)):
        found = fit_candidates(problem, start, by_views=False, wanted=fitted).get(fitted)
        if found is None or (fitted == wanted and not found.cost < total_cost(best)):
            continue
        near, state = [found.adjusted], found.adjusted.state
        if fitted != wanted:
            similar = similar_states(state, wanted, farthest_angle(problem.views, state))
            near = [replace(found.adjusted, state=one) for one in similar]
        best = min([best, *map(problem.adjust, near)], key=total_cost)
    return best


def with_denominator_if_supported(solution: Solution) -> Solution:
    """Add k4, k5 and k6 if that explains decidedly more, or if the model is not monotonic without them."""
    problem, views = solution.problem, solution.problem.views
    if views.n_equations - problem.n_parameters < 2 * len(DENOMINATOR):
        return solution
    richer = replace(problem, fixed=problem.fixed - DENOMINATOR)
    found = richer.adjust(solution.adjusted, _STEPS)
    before, after = (max(total_cost(a), 1e-300) for a in (solution.adjusted, found))
    n = independent_residuals(views, found.state)
    told = log_odds(before, after, n, len(DENOMINATOR)) > 0.5 * DECISIVE
    better = told and folds_back(problem, found.state) is None
    if not better and folds_back(problem, solution.state) is None:
        return solution
    return replace(solution, problem=richer, adjusted=found)


def check_distortion(solution: Solution) -> Solution:
    """Restore a given distortion, and check that an estimated one is monotonic.

    An estimated distortion that is not monotonic in parts of the image without points is fitted again so that
    it is, unless the points contradict that.

    Raises DegenerateGeometryError if the estimated distortion is not monotonic among the points, or cannot be
    made so within the image.
    """
    problem = solution.problem
    distortion = problem.distortion
    if distortion.model == "none":
        return solution
    if not problem.free_distortion:
        # A given distortion may fold the image's corners, but `problem_for` has checked these points.
        problem, start = problem.as_seen(solution.state)
        adjusted = problem.adjust(replace(solution.adjusted, state=start))
        return replace(solution, problem=problem, adjusted=adjusted)
    where = folds_back(problem, solution.state)
    if where is None:
        return solution
    if where == "image" and solution.shared is None:
        # The slopes are those of polynomials; other wide models end with their image circle.
        polynomial = not distortion.wide or distortion.model == "fisheye"
        found = fit_monotonic(problem, solution.adjusted) if polynomial else None
        if found is not None:
            return replace(solution, problem=found[0], adjusted=found[1])
        if distortion.wide:  # its image circle may end within the image
            return solution
    folded = (
        f"the distortion model {distortion.model} is not monotonic (maps two directions to one pixel) inside "
        f"the {where}; choose another --distortion, or give points nearer to the image's corners"
    )
    raise DegenerateGeometryError(undetermined_coefficients(problem, solution.adjusted) or folded)


def undetermined_coefficients(problem: Problem, adjusted: Adjusted) -> str:
    """Say that the points do not determine the coefficients of the named model; empty if they may.

    `adjusted` is the best fit of `problem`, which estimates these coefficients.
    """
    simpler = _that_suffices(problem, adjusted)
    if not simpler:
        return ""
    other = "a camera without distortion" if simpler == "none" else simpler
    return (
        f"the points do not determine the coefficients of the distortion model {adjusted.state.model}, as "
        f"{other} explains them as well; choose --distortion {simpler} or auto, or give points nearer to the "
        "image's corners"
    )


def _that_suffices(problem: Problem, adjusted: Adjusted) -> str:
    """The simplest monotonic model that is better by the Bayesian information criterion; empty if none is."""
    state = adjusted.state
    n, cost = independent_residuals(problem.views, state), total_cost(adjusted)
    entries = state.entries.copy()
    if state.model in WITH_XI:
        entries[:, :3] /= 1.0 + state.k[0]  # the scale in the middle of the image
    pinhole = replace(state, model="none", k=np.zeros(0), entries=entries)
    for model in POLYNOMIAL_MODELS:
        start = pinhole.with_model(model)
        more = len(state.k) - len(start.k)
        if more <= 0:
            continue
        simpler = problem.with_model(model)
        found = simpler.adjust(start, _STEPS_OF_SIMPLER)
        as_well = log_odds(total_cost(found), max(cost, 1e-300), n, more) < 0
        if as_well and folds_back(simpler, found.state) is None:
            return model
    return ""


def total_cost(adjusted: Adjusted) -> float:
    """Squared error of all views."""
    return float(adjusted.cost.sum())

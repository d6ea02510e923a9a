"""Calibrate by one of the other methods, with the same checks, result and refusals as for the network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.common_noise import measured, weighed
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution, TrainingRecord
from neurocal_cli.calibration.calibration import Calibration, Rejected, StopReason
from neurocal_cli.calibration.lens_choice.given_model import check_distortion
from neurocal_cli.calibration.other_methods.linear import Found, linear
from neurocal_cli.calibration.other_methods.nonlinear import nonlinear
from neurocal_cli.calibration.other_methods.opencv import opencv, without_skew
from neurocal_cli.calibration.other_methods.tsai import tsai, with_known_centre
from neurocal_cli.calibration.result import calibration_of
from neurocal_cli.errors import DegenerateGeometryError

BASELINES: dict[str, Callable[[Problem], Found]] = {
    "linear": linear,
    "nonlinear": nonlinear,
    "tsai": tsai,
    "opencv": opencv,
}

_ASSUMING: dict[str, Callable[[Problem], Problem]] = {"tsai": with_known_centre, "opencv": without_skew}


def problem_for_method(method: str, problem: Problem) -> Problem:
    """The problem that a method solves; some methods take more parameters as given than the user."""
    return _ASSUMING[method](problem) if method in _ASSUMING else problem


def calibrate_by(method: str, problem: Problem, name: str = "camera") -> Calibration:
    """Solve a problem by one of `BASELINES`, with all of its points.

    The standard deviations come from the normal matrix at the solution. If the method does not minimise the
    reprojection error, they are those of a least-squares fit, and a warning says so. Raises UsageError if the
    method cannot solve this kind of problem, and InputError or DegenerateGeometryError if the points do not
    determine a solution; the message gives the reason.
    """
    found = BASELINES[method](problem_for_method(method, _unweighted(problem)))
    solution = _solution(found)
    calibration = calibration_of(solution, Rejected(), trainer="none", method=method, seed=0, name=name)
    warnings = (*found.remarks, *calibration.warnings)
    if not found.minimised:
        warnings = (
            f"the method {method} does not minimise the reprojection error; its standard deviations are "
            "those of a fit that does",
            *warnings,
        )
    reason = StopReason.CONVERGED if found.minimised else StopReason.NOT_MINIMISED
    if not found.converged:
        reason = StopReason.MAX_ITERATIONS
    return replace(
        calibration, network=None, converged=found.converged, stop_reason=reason.value, warnings=warnings
    )


def _unweighted(problem: Problem) -> Problem:
    """Remove the covariances measured by `detect`, because (3) has none and they may be wrong.

    A sigma stated by the user is kept.
    """
    covariance, views = problem.points.covariance, problem.views
    if covariance is None or not measured(covariance):
        return problem
    plain = replace(views, weights=np.ones(len(views.index)), whitening=None, across=None)
    return replace(problem, views=plain)


def _solution(found: Found) -> Solution:
    """Convert the result to a solution of the problem, with normal matrices for the measured covariances."""
    problem, state = found.problem, found.state
    residuals = point_residuals(problem.views, state) * problem.views.pixel_scale
    order = problem.views.order
    believed = weighed(problem.points, residuals if order is None else residuals[np.argsort(order)])
    views = replace(
        problem.views,
        weights=believed.weights,
        whitening=believed.whitening,
        across=believed.across,
        along=believed.along,
    )
    problem = replace(problem, views=views)
    normal, sensible = normal_blocks(problem.views.batches, state)
    if not (sensible.all() and np.isfinite(normal).all()):
        name = problem.views.names[int(np.argmin(sensible))]
        raise DegenerateGeometryError(
            f"the method finds a camera that has points of view {name!r} behind it; check that each pixel "
            "belongs to its point, or use the method neuro"
        )
    cost = normal[:, -1, -1].copy()
    adjusted = Adjusted(state, normal, cost, found.iterations, np.array([found.converged]))
    record = TrainingRecord(np.full(problem.views.n_views, 2))
    solution = Solution(problem, adjusted, record)
    return check_distortion(solution) if problem.free_distortion else solution

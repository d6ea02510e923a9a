"""Calibrate by one of the other methods, with the same checks, result and refusals as for the network.

OpenCV's `calibrateCamera`, the most widely used tool, has no skew; its distortion model is set to the
requested one. For flat boards it computes initial values in closed form. For other targets it needs an
initial camera, which is that of tutorials: with the centre in the middle of the image and a focal length
equal to the image's width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.common_noise import measured, weighed
from neurocal_cli.adjustment.observability import check_points
from neurocal_cli.adjustment.problem import Problem, normalised
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution, TrainingRecord
from neurocal_cli.calibration.calibration import Calibration, Rejected, StopReason
from neurocal_cli.calibration.lens_choice.given_model import check_distortion
from neurocal_cli.calibration.other_methods.linear import Found, linear
from neurocal_cli.calibration.other_methods.nonlinear import nonlinear
from neurocal_cli.calibration.other_methods.tsai import tsai, with_known_centre
from neurocal_cli.calibration.result import calibration_of
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError, UsageError

_EPOCHS, _EPSILON = 1000, 1e-14
_COEFFICIENTS = 8  # k1 k2 p1 p2 k3 k4 k5 k6


def without_skew(problem: Problem) -> Problem:
    """The problem that OpenCV solves: with right angles given."""
    free = problem.free.copy()
    free[1] = False
    return replace(problem, free=free, fixed=problem.fixed | {"theta"})


def opencv(problem: Problem) -> Found:
    """Calibrate by ``cv2.calibrateCamera`` (types 1 and 2); the problem comes from `without_skew`.

    Raises UsageError if the problem is of type 3 or 4, or OpenCV does not have the distortion model, and
    DegenerateGeometryError if OpenCV refuses the points, or its result is not a valid camera.
    """
    import cv2

    if problem.type not in (1, 2) or problem.distortion.wide:
        raise UsageError("OpenCV's calibrateCamera solves types 1 and 2, with the models none to rational")
    check_points(problem)
    views, points = problem.views, problem.points
    order = np.arange(len(points)) if views.order is None else views.order
    parts = np.split(order, views.first[1:])
    world = [np.ascontiguousarray(points.world[rows], dtype=np.float32) for rows in parts]
    pixels = [np.ascontiguousarray(points.pixels[rows], dtype=np.float32) for rows in parts]
    size = points.image_size or tuple(int(side) + 1 for side in points.pixels.max(axis=0))
    model = problem.distortion.model if problem.free_distortion else "none"
    flags = _flags(cv2, model)
    guess = np.array([[size[0], 0, (size[0] - 1) / 2], [0, size[0], (size[1] - 1) / 2], [0, 0, 1.0]])
    in_z = all(np.ptp(one[:, 2]) == 0 for one in world)
    if problem.type == 2:
        guess[:2, 2] = problem.entries[3:]
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT
    if not in_z or problem.type == 2:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, _EPOCHS, _EPSILON)
    try:
        found = cv2.calibrateCamera(
            world, pixels, size, guess, np.zeros(_COEFFICIENTS), flags=flags, criteria=criteria
        )
    except cv2.error as error:
        raise DegenerateGeometryError(f"OpenCV refuses these points: {error.err}") from error
    _, A, k, turns, shifts = found[:5]
    R = np.array([cv2.Rodrigues(turn)[0] for turn in turns], dtype=float)
    t = np.array([np.ravel(shift) for shift in shifts], dtype=float)
    width = len(problem.free_camera) - 5
    state = CameraState(np.array([A[ENTRIES]]), R, t, model, np.array(k, dtype=float).ravel()[:width])
    if not (np.isfinite(state.entries).all() and (state.entries[0, [0, 2]] > 0).all()):
        raise DegenerateGeometryError("OpenCV's result is not a valid camera; use the method neuro")
    remarks = ("OpenCV's calibrateCamera has no skew: theta is a right angle",)
    return Found(problem, normalised(state, views), minimised=True, remarks=remarks)


def _flags(cv2: object, model: str) -> int:
    """Flags that free only the coefficients of a model."""
    free = coefficient_names(model)
    names = [f"CALIB_FIX_K{n}" for n in range(1, 7) if f"k{n}" not in free]
    names += [] if "p1" in free else ["CALIB_ZERO_TANGENT_DIST"]
    parts = {"k4": "CALIB_RATIONAL_MODEL", "s1": "CALIB_THIN_PRISM_MODEL", "tauX": "CALIB_TILTED_MODEL"}
    names += [flag for first, flag in parts.items() if first in free]
    return sum(getattr(cv2, name) for name in names)


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

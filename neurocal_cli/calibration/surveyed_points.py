"""Calibrate a camera from surveyed points with stated standard deviations.

First, each point is weighted and tested for outliers with the sum of its pixel noise and its projected survey
error. Then camera and points are adjusted together, because all views of a point share its survey error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.board.surveyed import find_surveyed
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.adjustment.reweighting import reweighted
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.units import normalised
from neurocal_cli.calibration.calibration import Rejected
from neurocal_cli.calibration.fit import fit_again
from neurocal_cli.calibration.outlier_rejection import fit_robustly
from neurocal_cli.calibration.point_errors import places_of_views, squared_whitened
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.median import median
from neurocal_cli.network.options import Options
from neurocal_cli.observations.points import Correspondences

_MEDIAN = 1.3863  # of chi-squared of two degrees of freedom
_HALVINGS = 30
_LEAST_NOISE = 1e-3  # least pixel noise, as a share of the residuals' level


def with_survey(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options
) -> tuple[Solution, Rejected]:
    """Adjust camera and points together.

    The problem has all points, at their surveyed coordinates; the solution and the rejected points are
    calibrated as if the survey were exact. Raises `DegenerateGeometryError` if the points do not determine
    the camera, and `InputError` if a point has two different standard deviations.
    """
    again, outliers = _judged(problem, solution, rejected, options, 1.0)
    factor = 1.0 if again.target is None else again.target.sizes["stated"]
    if factor > 1.0 and len(outliers):  # the survey is worse than stated, so fewer points are outliers
        again, outliers = _judged(problem, again, outliers, options, factor)
    return again, outliers


def _judged(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, factor: float
) -> tuple[Solution, Rejected]:
    """Adjust camera and points; outliers are judged by `factor` times the stated standard deviations."""
    points = problem.points
    covariance = _with_places(solution, points, factor)
    judged = replace(points, covariance=covariance, lines=np.arange(len(points)))
    if len(rejected) or rejected.views:
        weighed, rejected = fit_robustly(problem.with_points(judged), options)
        if rejected.points is not None:
            assert rejected.points.lines is not None
            rejected = replace(rejected, points=points.select(rejected.points.lines))
    else:
        weighed = fit_again(solution, judged, options)
    kept = weighed.problem.points.lines
    assert kept is not None
    if weighed.refusal:
        return weighed, rejected
    own = weighed.problem.with_points(points.select(kept))
    if not own.free_distortion:
        own = own.with_seen_pixels()
    start = own.adjust(replace(weighed.adjusted, state=normalised(weighed.in_pixels, own.views)))
    found = find_surveyed([(own, start)])
    if found is None:
        return replace(weighed, problem=own, adjusted=start), rejected
    (own, adjusted), *_ = found.fits
    return reweighted(replace(weighed, problem=own, adjusted=adjusted, target=found.target)), rejected


def _with_places(solution: Solution, points: Correspondences, factor: float) -> Array:
    """(N, 3) covariance of the pixels, including the projected survey errors of their points [px^2].

    The level of the pixel noise follows from the median residual by bisection.
    """
    own = np.array([1.0, 0.0, 1.0]) if points.covariance is None else points.covariance
    own = np.broadcast_to(own, (len(points), 3))
    state, view = solution.in_pixels, places_of_views(solution, points)
    in_camera = (state.R[view] @ points.world[..., None])[..., 0] + state.t[view]
    J = solution.camera.project_jacobian(in_camera)[1] @ state.R[view]
    assert points.world_std is not None
    J = J * factor * points.world_std[:, None]
    place = np.stack(
        [(J[:, 0] ** 2).sum(axis=1), (J[:, 0] * J[:, 1]).sum(axis=1), (J[:, 1] ** 2).sum(axis=1)]
    )
    seen, known = predicted_pixels(state, points.world, view)
    known = known & (view >= 0) & np.isfinite(place).all(axis=0)
    r, place = seen[known] - points.pixels[known], place.T[known]

    def level(variance: float) -> float:
        return float(median(squared_whitened(r, variance * own[known] + place))) / _MEDIAN

    high = float(median(squared_whitened(r, own[known]))) / _MEDIAN
    low = high * _LEAST_NOISE**2
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if level(middle) > 1.0 else (low, middle)
    covariance = high * own
    covariance[known] += place
    return covariance

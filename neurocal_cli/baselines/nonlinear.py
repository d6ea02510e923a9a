"""Nonlinear calibration: Levenberg-Marquardt on the pixel error (3) from the linear solution.

This is the paper's second method for comparison. The descent is MINPACK's, through SciPy, with numerical
derivatives. It shares only the projection with `bundle_adjustment`, and ends at the same minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.baselines.found import Found, as_seen
from neurocal_cli.baselines.least_squares import least_squares
from neurocal_cli.baselines.linear import linear_state
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState, residuals
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import pinhole_coefficients
from neurocal_cli.geometry import Array


def nonlinear(problem: Problem) -> Found:
    """Minimise the pixel error from the linear solution, with its errors."""
    return descend(*as_seen(problem, linear_state(problem)))


def descend(problem: Problem, start: CameraState) -> Found:
    """Minimise the pixel error (3) from a normalised state; free distortion is added to a pinhole."""
    model = problem.distortion.model
    if problem.free_distortion and start.model != model:
        start = replace(start, model=model, k=pinhole_coefficients(model))
    free = np.flatnonzero(problem.free_camera if problem.free_distortion else problem.free)
    error, V, F = whitened_residuals(problem.views), len(start.R), len(free)

    def state(x: Array) -> CameraState:
        """State at steps from the start: of the camera's free parameters, then of each pose."""
        by_camera = np.zeros((1, 5 + len(start.k)))
        by_camera[0, free] = x[:F]
        by_pose = x[F:].reshape(V, 6) if problem.free_poses else np.zeros((V, 6))
        return start.moved(by_camera, by_pose)

    zero = np.zeros(F + 6 * V * problem.free_poses)
    least = least_squares(lambda x: error(state(x)), zero, view_of_residual(problem.views), F)
    return Found(problem, state(least.x), True, least.iterations, least.converged)


def whitened_residuals(views: Views) -> Callable[[CameraState], Array]:
    """Function from a state to its whitened residuals (2 N,) in normalised pixels, u and v of each point."""
    batches = views.batches
    factors = batches.whitening

    def error(state: CameraState) -> Array:
        e = residuals(batches, state)
        if factors is not None:
            e = np.stack([factors[:, 0] * e[:, 0] + factors[:, 1] * e[:, 1], factors[:, 2] * e[:, 1]], axis=1)
        return np.asarray(e.ravel())

    return error


def view_of_residual(views: Views) -> NDArray[np.intp]:
    """View (2 N,) of each residual of `whitened_residuals`."""
    return np.repeat(views.batches.view, 2 * views.batches.local.shape[2])

"""Nonlinear calibration: Levenberg-Marquardt on the pixel error (3) from the linear answer.

The paper's second method of comparison. The descent is MINPACK's, through SciPy, with derivatives by
differences: it shares no code with `bundle_adjustment` but the projection, and ends at the same minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.baselines.found import Found, as_seen
from neurocal_cli.baselines.least_squares import Parts, least_squares
from neurocal_cli.baselines.linear import linear_state
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState, residuals
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import pinhole_coefficients
from neurocal_cli.geometry import Array


def nonlinear(problem: Problem) -> Found:
    """Minimise the pixel error from the linear answer.

    Raises
    ------
    DegenerateGeometryError
        As `linear`.
    """
    return descend(*as_seen(problem, linear_state(problem)))


def descend(problem: Problem, start: CameraState) -> Found:
    """Minimise the pixel error (3) from any normalised state; a pinhole is given its distortion."""
    model = problem.distortion.model
    if problem.free_distortion and start.model != model:
        start = replace(start, model=model, k=pinhole_coefficients(model))
    free = problem.free_camera if problem.free_distortion else problem.free
    unknowns = _Unknowns(start, np.flatnonzero(free), problem.free_poses)
    error = whitened_residuals(problem.views)
    parts = None
    if problem.views.n_views > 1 and problem.free_poses:
        parts = Parts.of_views(view_of_residual(problem.views), len(unknowns.free), 6, problem.views.n_views)
    least = least_squares(lambda x: error(unknowns.state(x)), unknowns.zero, parts)
    return Found(problem, unknowns.state(least.x), True, least.iterations, least.converged)


class _Unknowns:
    """A state as a vector of what is to be added to the start: the camera's numbers, then each pose's."""

    def __init__(self, start: CameraState, free: NDArray[np.intp], free_poses: bool) -> None:
        self.start, self.free, self.free_poses = start, free, free_poses
        self.width = 5 + len(start.k)
        self.zero = np.zeros(len(free) + (6 * len(start.R) if free_poses else 0))

    def state(self, x: Array) -> CameraState:
        """The state at (n,) steps from the start, in the order of the free unknowns."""
        by_camera = np.zeros((1, self.width))
        by_camera[0, self.free] = x[: len(self.free)]
        by_pose = x[len(self.free) :].reshape(-1, 6) if self.free_poses else np.zeros((len(self.start.R), 6))
        return self.start.moved(by_camera, by_pose)


def whitened_residuals(views: Views) -> Callable[[CameraState], Array]:
    """Function from a state to its (2 N,) residuals in normalised pixels, u and v of point by point."""
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

"""Nonlinear calibration: Levenberg-Marquardt on the pixel error (3) from the linear solution.

This is the paper's second method for comparison. The descent is MINPACK's, through SciPy, with numerical
derivatives; for many views, a sparse trust region. It shares only the projection with `adjustment.adjust`,
and ends at the same minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import residuals
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.other_methods.linear import Found, linear_state
from neurocal_cli.camera.distortion import pinhole_coefficients
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

_DENSE = 150  # greatest number of unknowns for which MINPACK is faster than a sparse trust region
_TOLERANCE = 1e-12
_MOST = 200  # steps
_STEP = 1.5e-8  # relative step of forward differences


@frozen_dataclass(eq=False)
class Minimum:
    """The minimum x (n,)."""

    x: Array
    iterations: int
    converged: bool


def nonlinear(problem: Problem) -> Found:
    """Minimise the pixel error from the linear solution, with its errors."""
    return descend(*problem.as_seen(linear_state(problem)))


def descend(problem: Problem, start: CameraState) -> Found:
    """Minimise the pixel error (3) from a normalised state; free distortion is added to a pinhole."""
    model = problem.distortion.model
    if problem.free_distortion and start.model != model:
        start = replace(start, model=model, k=pinhole_coefficients(model))
    free = np.flatnonzero(problem.free_camera if problem.free_distortion else problem.free)
    V, F = len(start.R), len(free)

    def state(x: Array) -> CameraState:
        """State at steps from the start: of the camera's free parameters, then of each pose."""
        by_camera = np.zeros((1, 5 + len(start.k)))
        by_camera[0, free] = x[:F]
        by_pose = x[F:].reshape(V, 6) if problem.free_poses else np.zeros((V, 6))
        return start.moved(by_camera, by_pose)

    least = least_pixel_error(problem.views, state, np.zeros(F + 6 * V * problem.free_poses), F)
    return Found(problem, state(least.x), True, least.iterations, least.converged)


def least_pixel_error(
    views: Views, state: Callable[[Array], CameraState], start: Array, shared: int
) -> Minimum:
    """Minimise the whitened pixel error (3) over the unknowns of a state; see `least_squares`."""
    batches, factors = views.batches, views.batches.whitening

    def error(x: Array) -> Array:
        e = residuals(batches, state(x))
        if factors is not None:
            e = np.stack([factors[:, 0] * e[:, 0] + factors[:, 1] * e[:, 1], factors[:, 2] * e[:, 1]], axis=1)
        return np.asarray(e.ravel())

    return least_squares(error, start, np.repeat(batches.view, 2 * batches.local.shape[2]), shared)


def least_squares(
    residuals: Callable[[Array], Array], start: Array, view: NDArray[np.intp], shared: int
) -> Minimum:
    """Minimise a sum of squares by Levenberg-Marquardt or, for many unknowns, by a trust region.

    `residuals` maps unknowns (n,) to residuals (m,), and `view` (m,) is the view of each residual. The first
    `shared` unknowns are those that all views share; the others belong to single views, in order.
    """
    from scipy.optimize import least_squares as minimise

    def finite(x: Array) -> Array:
        return np.nan_to_num(residuals(x), nan=1e10, posinf=1e10, neginf=-1e10)

    sparse = len(start) > _DENSE
    options: dict[str, Any] = {"method": "lm"}
    if sparse:
        options = {"method": "trf", "tr_solver": "lsmr"}
        options["tr_options"] = {"atol": 1e-12, "btol": 1e-12, "maxiter": 10 * len(start)}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = minimise(
            finite, start, lambda x: _differences(finite, x, view, shared, sparse), x_scale="jac",
            xtol=_TOLERANCE, ftol=_TOLERANCE, gtol=_TOLERANCE, max_nfev=_MOST, **options,
        )  # fmt: skip
    return Minimum(found.x, int(found.njev or found.nfev), bool(found.status > 0))


def _differences(
    residuals: Callable[[Array], Array], x: Array, view: NDArray[np.intp], shared: int, sparse: bool
) -> Any:
    """Derivatives (m, n) by forward differences; the unknowns of different views are varied together."""
    at = residuals(x)
    own = np.arange(shared, len(x)).reshape(int(view.max()) + 1, -1)
    steps = _STEP * np.maximum(np.abs(x), 1.0)
    differences = []
    for together in (*np.arange(shared)[:, None], *own.T):
        moved = x.copy()
        moved[together] += steps[together]
        differences.append(residuals(moved) - at)
    columns = np.column_stack([np.tile(np.arange(shared), (len(at), 1)), own[view]])
    values = np.stack(differences, axis=1) / steps[columns]
    rows = np.repeat(np.arange(len(at)), columns.shape[1])
    if sparse:
        from scipy.sparse import csr_matrix

        return csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(len(at), len(x)))
    J = np.zeros((len(at), len(x)))
    J[rows, columns.ravel()] = values.ravel()
    return J

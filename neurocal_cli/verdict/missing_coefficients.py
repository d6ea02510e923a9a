"""Test whether the distortion model is too simple: whether more coefficients explain the residuals.

The camera is adjusted again with OpenCV's five coefficients, from the estimated parameters. If it then leaves
hardly more than noise, the missing coefficients are the cause of the error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import adjust
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import (
    correlation,
    effective_number,
    point_residuals,
)
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

_RICHEST = "plumb_bob"  # has the coefficients of all simpler models
_STEPS = 60
_ENOUGH = 60  # views: more are not needed
_DECISIVE = 10.0  # of the Bayesian information criterion, as among models by cross-validation: odds of 150


@frozen_dataclass
class MissingCoefficients:
    """Effect of the coefficients that a distortion model lacks.

    Attributes
    ----------
    explained : float
        Share of the squared error that they explain.
    focal_length : float
        Relative change of the focal length without them.
    sigmas : float
        The same in standard deviations, without sign.
    """

    explained: float
    focal_length: float
    sigmas: float


def missing_coefficients(
    views: Views, state: CameraState, normal: Array, free: NDArray[np.bool_], free_poses: bool, std: float
) -> MissingCoefficients | None:
    """Test whether the distortion model lacks coefficients; None if it lacks none, or not significantly.

    Parameters
    ----------
    views : Views
    state : CameraState
        Normalised, at the minimum.
    normal : array
        Normal matrices of the views at the state.
    free : (5 + K,) bool array
        Which of A's entries and of the distortion coefficients are estimated.
    free_poses : bool
    std : float
        Standard deviation of A11, normalised.
    """
    if not set(coefficient_names(state.model)) < set(coefficient_names(_RICHEST)):
        return None
    if views.n_views > _ENOUGH:
        some = np.linspace(0, views.n_views - 1, _ENOUGH).astype(np.intp)
        views, state = views.subset(some), replace(state, R=state.R[some], t=state.t[some])
        normal = normal[some]
    start = state.with_model(_RICHEST)
    all_free = np.concatenate([free[:5], np.ones(len(start.k), dtype=bool)])
    richer = adjust(views.batches, start, all_free, free_poses, _STEPS)
    left = float(richer.cost.sum()) / max(float(normal[:, -1, -1].sum()), 1e-300)
    n = effective_number(views.n_equations, correlation(views, point_residuals(views, richer.state)))
    more = len(start.k) - len(state.k)
    if not (left > 0 and -n * np.log(left) > more * np.log(n) + _DECISIVE):
        return None
    f, better = state.entries[0, 0], richer.state.entries[0, 0]
    return MissingCoefficients(1.0 - left, float((f - better) / better), float(abs(f - better) / std))

"""Uncertainty of a rig that comes from the uncertainty of cameras that were given for it.

The rig, a second camera and the poses follow an error d of the given cameras as they would follow these
parameters if they were estimated: with the poses eliminated, N_ff x + N_fd d = 0 for the free shared unknowns
x. With the covariance S of the given cameras, x has the additional covariance
N_ff^-1 N_fd S N_df N_ff^-1, and x and d are correlated. It does not fall with the number of points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.given_camera import entry_covariance
from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.adjustment.schur_complement import SchurCovariance, eliminate
from neurocal_cli.calibration.rig.adjust import RigProblem, RigState
from neurocal_cli.camera.geometry import Array


def covariance_by_given(
    problem: RigProblem, state: RigState, normal: Array, free: NDArray[np.bool_]
) -> SchurCovariance | None:
    """Covariance of all shared unknowns and of the poses that the given cameras cause, normalised.

    `normal` (V, D, D) is that at the state, which is a minimum, and `free` (n_shared,) are the unknowns that
    moved. None if no covariance is known.
    """
    columns = state.columns
    given = np.zeros((columns.n_shared, columns.n_shared))
    for camera, seen, place in zip(problem.calibrations, problem.observations, columns.cameras, strict=True):
        if camera.given_names:
            given[np.ix_(place, place)] = entry_covariance(
                camera.intrinsics,
                camera.distortion_model,
                camera.given_names,
                camera.given_covariance,
                seen.pixel_scale,
            )
    if not given.any():
        return None
    whole, by_shared = eliminate(normal, np.arange(columns.n_shared), columns.pose)
    whole = whole.sum(axis=0)
    follow = np.eye(columns.n_shared)
    follow[free] = -solve_scaled(whole[np.ix_(free, free)], whole[free])
    follow[np.ix_(free, free)] = 0.0  # the free unknowns themselves have no error of their own here
    shared = follow @ given @ follow.T
    by_shared = -by_shared
    cross = np.swapaxes(by_shared @ shared, 1, 2)
    return SchurCovariance(shared, by_shared @ shared @ np.swapaxes(by_shared, 1, 2), cross, 1.0)

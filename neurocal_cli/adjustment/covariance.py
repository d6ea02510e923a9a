"""Covariance of the estimated parameters: the inverse normal matrix times the residual variance.

For Gaussian noise this is the Cramer-Rao bound at the estimate. The block of the intrinsics comes from the
Schur complement over the views. The block of each pose is that of its own view plus the part propagated from
the intrinsics.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import inverse_scaled
from neurocal_cli.adjustment.reprojection import POSE, camera_columns
from neurocal_cli.adjustment.schur_complement import schur_covariance
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


@frozen_dataclass(eq=False)
class Covariance:
    """Covariances in normalised units."""

    entries: Array  # (f, f) of A's free entries and the free distortion coefficients
    poses: Array  # (V, 6, 6) of omega and tau of each view; zero if the poses are given
    smallest: float  # smallest eigenvalue of the normal matrices scaled to a unit diagonal; 0 if singular


@frozen_dataclass(eq=False)
class CovarianceBasis:
    """Input of a camera's covariance (`covariance`, `counting_views`)."""

    # (V, 12 + K, 12 + K) as from `reprojection.normal_blocks`; if the target was estimated, with the
    # efficient scores of the free camera parameters.
    normal: Array
    # (f, f) covariance of A's free entries and the free distortion coefficients, normalised, if it does not
    # follow from the normal matrices.
    shared: Array | None
    n_equations: float  # number of equations minus the effective number of estimated unknowns of the target
    # (P, f) moves of the free parameters when the views of each pose are left out and the target is estimated
    # again, given the pose (V,) of each view. None if there are many poses: then the efficient scores give
    # the same.
    moves_without: Callable[[NDArray[np.intp]], Array | None] | None = None
    # (V, 6, 6) covariance of the poses, if it does not follow from the normal matrices.
    poses: Array | None = None


def covariance(
    normal: Array, free: NDArray[np.bool_], free_pose: bool, n_residuals: float, shared: Array | None = None
) -> Covariance:
    """Invert the normal matrices (V, 12 + K, 12 + K) of a calibration, from `adjust`.

    `free` (5 + K,) tells which of A's entries and the distortion coefficients are estimated. `n_residuals` is
    the number of equations: two for most points; see `measured_directions`. If the covariance `shared` (f, f)
    of the free entries and coefficients comes from elsewhere, the poses' covariance is propagated from it.
    """
    f = camera_columns(len(free) - 5)[np.flatnonzero(free)]
    V = len(normal)
    unknowns = len(f) + (6 * V if free_pose else 0)
    variance = float(normal[:, -1, -1].sum()) / max(n_residuals - unknowns, 1)
    if not free_pose:
        if shared is not None:
            return Covariance(shared, np.zeros((V, 6, 6)), 1.0)
        U = normal[:, f[:, None], f].sum(axis=0)
        inverse, smallest = inverse_scaled(U, U)
        return Covariance(variance * inverse, np.zeros((V, 6, 6)), smallest)
    if shared is None:
        found = schur_covariance(normal, f, np.arange(POSE.start, POSE.stop))
        return Covariance(variance * found.shared, variance * found.own, found.smallest)
    B = normal[:, POSE, POSE]
    B_inverse, smallest = inverse_scaled(B, B)
    gain = normal[:, f, POSE] @ B_inverse
    return Covariance(shared, variance * B_inverse + np.swapaxes(gain, 1, 2) @ shared @ gain, smallest)

"""Cross-validation by leaving out one setting at a time, without training again.

Near the minimum the networks are linear in their weights. With K = J A^-1 J^T H and the error e_s of setting
s, the error of its prediction from all others is (I - K_ss)^-1 e_s (the PRESS formula).
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.initialisation import CalibratedSettings
from neurocal_cli.zoom_lens.joint_training import Joint
from neurocal_cli.zoom_lens.quadratic_error import inverse, with_scatter


def left_out_errors(start: CalibratedSettings, joint: Joint) -> tuple[Array, Array]:
    """Errors at settings, each predicted from all others.

    Returns
    -------
    pixels : (S,) array [px]
        Rms reprojection error.
    normalised : (S,) array
        Squared error of the local parameters over its expectation, a mean over them; about 1.
    """
    tables, variance = start.tables, start.variance
    scatter = joint.nets.local_scatter(tables.local)
    local, J = joint.nets.local_with_jacobian(start.controls)
    _, L, P = J.shape
    normal = tables.normal
    H = normal.H[:, :L, :L]
    spread = J @ joint.covariance[:P, :P] @ np.swapaxes(J, 1, 2)
    # The constants of the networks differ from those of the tables; the effect is small.
    error = local - tables.local
    K = spread @ with_scatter(normal, scatter, variance).H[:, :L, :L] / variance
    remain = np.eye(L) - K
    out = np.asarray(np.linalg.solve(remain, error[..., None]), dtype=np.float64)
    spread_out = np.linalg.solve(remain, spread)
    own = variance * inverse(H) + np.diag(scatter)
    expected = np.asarray(spread_out + own)
    normalised = (out * solve_scaled(expected, out, ROUNDING)).sum(axis=(1, 2)) / L
    squares = (np.swapaxes(out, 1, 2) @ H @ out)[:, 0, 0] + normal.cost
    counts = np.maximum(normal.H[:, 2, 2], 1.0)  # the derivative by u0 is 1, so this is the number of points
    return np.sqrt(np.maximum(squares, 0.0) / counts), np.maximum(normalised, 0.0)

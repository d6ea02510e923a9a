"""Leaving out one setting at a time, without training again.

Around the minimum the networks are linear in their weights, so a setting's influence can be taken
back: with K = J A^-1 J^T H, the prediction of setting s from all others errs by (I - K_ss)^-1 e_s,
e_s being the error with it (the formula behind PRESS).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.joint_training import Joint
from neurocal_cli.zoom_lens.quadratic_error import loosened
from neurocal_cli.zoom_lens.static_calibration import Tables

__all__ = ["LeftOut", "left_out_errors"]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors at settings that are predicted from all others.

    Attributes
    ----------
    pixels : (S,) array [px]
        Pixel error there, noise included.
    surprise : (S,) array
        Squared error over its expectation, a mean over the local parameters; about 1.
    """

    pixels: Array
    surprise: Array


def left_out_errors(x: Array, joint: Joint, tables: Tables, variance: float, scatter: Array) -> LeftOut:
    """Predict each setting from all others.

    Parameters
    ----------
    x : (S, D) array
    joint : Joint
    tables : Tables
    variance : float [px^2]
    scatter : (L,) array
        Of the local parameters from setting to setting.
    """
    local, jacobians = joint.nets.local_with_jacobians(x)
    J = np.concatenate(jacobians, axis=2)
    S, L, P = J.shape
    normal = tables.normal
    H = normal.H[:, :L, :L]
    spread = J @ joint.covariance[:P, :P] @ np.swapaxes(J, 1, 2)
    # With constants of its own, a lens may differ from the tables everywhere alike; that is small.
    error = local - tables.local
    K = spread @ loosened(normal, scatter, variance).H[:, :L, :L] / variance
    remain = np.eye(L) - K
    out = np.asarray(np.linalg.solve(remain, error[..., None]), dtype=np.float64)
    spread_out = np.linalg.solve(remain, spread)
    own = variance * solve_scaled(H, np.tile(np.eye(L), (S, 1, 1)), ROUNDING) + np.diag(scatter)
    expected = np.asarray(spread_out + own)
    surprise = (out * solve_scaled(expected, out, ROUNDING)).sum(axis=(1, 2)) / L
    squares = (np.swapaxes(out, 1, 2) @ H @ out)[:, 0, 0] + normal.cost
    counts = np.maximum(
        normal.H[:, 2, 2], 1.0
    )  # by u0: a residual moves by 1, so this is the number of points
    return LeftOut(np.sqrt(np.maximum(squares, 0.0) / counts), np.maximum(surprise, 0.0))

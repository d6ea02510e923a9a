"""Covariance of a rig whose pairs of views contradict each other by more than noise.

The normal matrix treats all points as independent. If the relative pose differs from pair to pair, only the
pairs are independent. The delete-one jackknife over the views then gives the covariance, without a model of
the differences (Efron and Stein 1981). A known change adds the square of the error that it causes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.leave_out import Quadratics
from neurocal_cli.least_squares.normal_equations import solve_scaled, unit_diagonal
from neurocal_cli.stereo.contradiction import Contradiction, is_significant
from neurocal_cli.stereo.relative_poses import RelativePoses

_LEAST_PAIRS = 3  # fewest pairs for a jackknife; with two, the covariance is multiplied by the scatter


def rig_covariance(poses: RelativePoses, used: NDArray[np.bool_], found: Contradiction) -> Array:
    """(F, F) covariance of the unknowns of the common fit of the used pairs, (P,) bool."""
    S, _ = poses.normal(used)
    model = solve_scaled(S, np.eye(len(S)))
    model = 0.5 * (model + model.T)
    if not is_significant(found.scatter**2 * found.degrees, found.degrees):
        return np.asarray(model)
    if used.sum() < _LEAST_PAIRS:
        return np.asarray(found.scatter**2 * model)
    moves = _moves(poses, used)
    spread = moves - moves.mean(axis=0)
    by_pairs = (len(moves) - 1) / len(moves) * spread.T @ spread + 0.5 * found.shift.T @ found.shift
    return not_smaller(model, by_pairs)


def _moves(poses: RelativePoses, used: NDArray[np.bool_]) -> Array:
    """Moves of the unknowns when each frame is left out."""
    frame = poses.frame[used]
    S, g, cost = poses.cameras.S.copy(), poses.cameras.g.copy(), poses.cameras.cost.copy()
    S[frame] += poses.pairs.S[used]
    g[frame] += poses.pairs.g[used]
    cost[frame] += poses.pairs.cost[used]
    # Shifted to the minimum, where the formula for leaving out holds.
    at = poses.solution(used)
    moves = Quadratics(S, g - S @ at, cost).moves_without_each()
    return np.asarray(moves[np.isfinite(moves).all(axis=1)])


def not_smaller(least: Array, other: Array) -> Array:
    """The smallest covariance that is, in the axes that both share, nowhere smaller than either.

    Examples
    --------
    >>> not_smaller(np.diag([1.0, 4.0]), np.diag([3.0, 1.0])).round(9)
    array([[3., 0.],
           [0., 4.]])
    """
    scaled, scale = unit_diagonal(least)
    values, axes = np.linalg.eigh(scaled)
    root = axes * np.sqrt(np.maximum(values, 1e-15))
    inverse = (axes / np.sqrt(np.maximum(values, 1e-15))).T
    ratio, turn = np.linalg.eigh(inverse @ (other * scale[:, None] * scale) @ inverse.T)
    joint = root @ turn
    larger = (joint * np.maximum(ratio, 1.0)) @ joint.T
    return np.asarray(larger / scale[:, None] / scale)

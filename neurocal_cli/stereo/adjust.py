"""The last step for two cameras: both, the rig and all poses together on the whitened pixel error (3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import schur_step
from neurocal_cli.stereo.reprojection import Columns, Frames, RigState, Sightings, rig_normal_blocks

__all__ = ["AdjustedRig", "adjust_rig"]

_TOLERANCE = 1e-9  # a step that would lower the error by a smaller share is the last
_FLAT_SHARE = 1e-6  # a rejected step that promised less than this share: the bottom
_LARGEST_DAMPING = 1e10
_FLOOR = 1e-13  # rms in normalised pixels that rounding alone accounts for


@dataclass(frozen=True, eq=False)
class AdjustedRig:
    """Result of `adjust_rig`.

    Attributes
    ----------
    state : RigState
    normal : (V, D, D) array
        From `pixel_error.rig_normal_blocks`.
    iterations : int
    converged : bool
    """

    state: RigState
    normal: Array
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.normal[:, -1, -1].sum())


def adjust_rig(
    frames: Frames,
    sightings: tuple[Sightings, Sightings],
    start: RigState,
    free: NDArray[np.bool_],
    max_iterations: int = 200,
) -> AdjustedRig:
    """Minimise the pixel error of both cameras from a start that is already near.

    Parameters
    ----------
    frames : Frames
    sightings : two of Sightings
    start : RigState
        With all points in front of their cameras.
    free : (n_shared,) bool array
        Which of the cameras' and the rig's unknowns move; the poses of the views always do.
    max_iterations : int
    """
    columns = Columns.of(start)
    shared = np.flatnonzero(free)
    floor = _FLOOR**2 * sum(seen.n_equations * seen.weight for seen in sightings)
    state = start
    normal, _ = rig_normal_blocks(frames, sightings, state, columns)
    cost = float(normal[:, -1, -1].sum())
    damping, growth, iterations, settled = 1e-6, 2.0, 0, cost <= floor
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        while not settled and iterations < max_iterations and damping < _LARGEST_DAMPING:
            iterations += 1
            by_shared, by_own, gain = schur_step(normal, shared, columns.pose, damping)
            step = np.zeros(columns.n_shared)
            step[shared] = by_shared
            trial = state.moved(columns, step, by_own)
            trial_normal, sensible = rig_normal_blocks(frames, sightings, trial, columns)
            after = float(trial_normal[:, -1, -1].sum())
            sensible = sensible and all(camera.entries[0, [0, 2]].min() > 0 for camera in trial.cameras)
            if sensible and after < cost:
                shrink = max(0.01, 1 - min(2 * (cost - after) / gain - 1, 2.0) ** 3)
                settled = gain < _TOLERANCE * cost or after <= floor
                state, normal, cost = trial, trial_normal, after
                damping, growth = max(damping * shrink, 1e-14), 2.0
            else:
                settled = sensible and gain < _FLAT_SHARE * cost
                damping, growth = damping * growth, 2 * growth
    return AdjustedRig(state.settled(), normal, iterations, settled)

"""Uncertainty of a rig that comes from keeping the given target although its print may be stretched.

As for a single camera (`target_shape.open_stretch`), two stretches are open unknowns of the common bundle
adjustment.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import eliminate
from neurocal_cli.stereo.adjust import RigFit
from neurocal_cli.stereo.problem import RigProblem, estimated_parameters
from neurocal_cli.stereo.reprojection import Columns, RigState, rig_jacobian
from neurocal_cli.target import is_flat
from neurocal_cli.target_shape.open_stretch import spread_of_stretch, stretched_blocks, stretches


@frozen_dataclass(eq=False)
class StretchedRig:
    """Term that an open stretch adds to the covariance of a rig.

    Attributes
    ----------
    probability : float
        That the print is stretched.
    added : (f, f) array
        For the shared unknowns that were free.
    """

    probability: float
    added: Array


def stretched_rig(fit: RigFit) -> StretchedRig | None:
    """The term that the stretch of a target adds; None if it is negligible or the target is not flat.

    Cameras that were not refined respond to the stretch as well, because they were calibrated on this target.

    Parameters
    ----------
    fit : RigFit
        For the target as given.
    """
    world = np.concatenate([calibration.points.world for calibration in fit.calibrations])
    if not is_flat(world):
        return None
    sides = [estimated_parameters(calibration) for calibration in fit.calibrations]
    estimated = np.concatenate([*sides, np.ones(6, dtype=bool)])
    columns = Columns.of(fit.adjusted.state)
    normal = _with_stretches(fit.problem, fit.adjusted.state, columns, stretches(world))
    kept = np.append(np.flatnonzero(estimated), np.arange(columns.width - 1, columns.width + 2))
    whole = eliminate(normal, kept, columns.pose)[0].sum(axis=0)
    if not fit.variance > 0:
        return None
    found = spread_of_stretch(whole[:-1, :-1], whole[:-1, -1], fit.variance)
    if found is None:
        return None
    T = found.follow[:-2][fit.free[estimated]]
    return StretchedRig(found.probability, T @ found.E @ T.T)


def _with_stretches(problem: RigProblem, state: RigState, columns: Columns, by: Array) -> Array:
    """(V, D + 2, D + 2) normal matrices with columns of two stretches before the residual's."""
    frames, D = problem.frames, columns.width
    normal = np.zeros((len(frames.scale), D + 2, D + 2))
    for side, observed in enumerate(problem.observations):
        blocks = stretched_blocks(observed.batches, state.camera_with_poses(side, frames, observed), by)
        own = rig_jacobian(frames, observed, state, columns, side)
        T = np.zeros((len(own), own.shape[1] + 2, D + 2))
        T[:, :-3, : D - 1] = own[:, :-1, :-1]
        T[:, -3:, D - 1 :] = np.eye(3)
        normal[observed.view] += observed.weight * (np.swapaxes(T, 1, 2) @ blocks @ T)
    return normal

"""What a rig is uncertain by because its target was kept as given, though the print may be stretched.

As for a camera alone (`target_shape.open_stretch`): two stretches are open unknowns of the common bundle
adjustment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Calibration
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.schur_complement import eliminate
from neurocal_cli.stereo.adjust import AdjustedRig
from neurocal_cli.stereo.problem import RigProblem, estimated_parameters
from neurocal_cli.stereo.reprojection import Columns, rig_jacobian
from neurocal_cli.target import is_flat
from neurocal_cli.target_shape.open_stretch import spread_of_stretch, stretched_blocks, stretches


@frozen_dataclass(eq=False)
class StretchedRig:
    """What an open stretch adds to the covariance of a rig.

    Attributes
    ----------
    probability : float
        That the print is stretched.
    added : (f, f) array
        For the shared unknowns that were free.
    """

    probability: float
    added: Array


def stretched_rig(
    problem: RigProblem,
    calibrations: tuple[Calibration, Calibration],
    adjusted: AdjustedRig,
    free: NDArray[np.bool_],
) -> StretchedRig | None:
    """What the stretch of a target adds; None where that is negligible, or the target is not flat.

    Cameras that were held follow the stretch as well: they were calibrated on the same target.

    Parameters
    ----------
    problem, calibrations, adjusted, free
        As they were adjusted, for the target as given.
    """
    world = np.concatenate([calibration.points.world for calibration in calibrations])
    if not is_flat(world):
        return None
    sides = [estimated_parameters(calibration) for calibration in calibrations]
    estimated = np.concatenate([*sides, np.ones(6, dtype=bool)])
    columns = Columns.of(adjusted.state)
    normal = _with_stretches(problem, adjusted, columns, stretches(world))
    kept = np.append(np.flatnonzero(estimated), np.arange(columns.width - 1, columns.width + 2))
    whole = eliminate(normal, kept, columns.pose)[0].sum(axis=0)
    equations = sum(observed.n_equations for observed in problem.observations)
    unknowns = int(free.sum()) + 6 * len(problem.frames.scale)
    variance = adjusted.cost / max(equations - unknowns, 1)
    found = spread_of_stretch(whole[:-1, :-1], whole[:-1, -1], variance) if variance > 0 else None
    if found is None:
        return None
    T = found.follow[:-2][free[estimated]]
    return StretchedRig(found.probability, T @ found.E @ T.T)


def _with_stretches(problem: RigProblem, adjusted: AdjustedRig, columns: Columns, by: Array) -> Array:
    """(V, D + 2, D + 2) normal matrices with columns of two stretches before the residual's."""
    frames, state, D = problem.frames, adjusted.state, columns.width
    normal = np.zeros((len(frames.scale), D + 2, D + 2))
    for side, observed in enumerate(problem.observations):
        blocks = stretched_blocks(observed.batches, state.camera_with_poses(side, frames, observed), by)
        own = rig_jacobian(frames, observed, state, columns, side)
        T = np.zeros((len(own), own.shape[1] + 2, D + 2))
        T[:, :-3, : D - 1] = own[:, :-1, :-1]
        T[:, -3:, D - 1 :] = np.eye(3)
        normal[observed.view] += observed.weight * (np.swapaxes(T, 1, 2) @ blocks @ T)
    return normal

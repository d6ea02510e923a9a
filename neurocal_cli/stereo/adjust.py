"""Bundle adjustment of both cameras, the rig and all poses on the whitened reprojection error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import FLOOR, OPTIONS
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.levenberg_marquardt import minimise
from neurocal_cli.least_squares.schur_complement import SharedAndOwn
from neurocal_cli.stereo.problem import RigProblem
from neurocal_cli.stereo.reprojection import RigState, rig_normal_blocks

_Linearised = tuple[RigState, Array]  # a state and its normal matrices
_DAMPING = 1e-6  # each camera was adjusted alone before, so the first step is nearly undamped


@frozen_dataclass(eq=False)
class RigFit:
    """A problem, and what the common bundle adjustment made of it.

    Attributes
    ----------
    problem : RigProblem
    free : (n_shared,) bool array
        Which parameters of the cameras and the rig moved.
    state : RigState
    normal : (V, D, D) array
        From `reprojection.rig_normal_blocks`.
    iterations : int
    converged : bool
    """

    problem: RigProblem
    free: NDArray[np.bool_]
    state: RigState
    normal: Array
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.normal[:, -1, -1].sum())

    @property
    def variance(self) -> float:
        """Of the whitened residuals; 1 where both cameras alone leave no less."""
        equations = sum(observed.n_equations for observed in self.problem.observations)
        unknowns = int(self.free.sum()) + 6 * len(self.problem.frames.scale)
        return self.cost / max(equations - unknowns, 1)


def adjust_rig(problem: RigProblem, start: RigState, free: NDArray[np.bool_]) -> RigFit:
    """Minimise the reprojection error of both cameras from a start near the minimum.

    Parameters
    ----------
    problem : RigProblem
    start : RigState
        With all points in front of their cameras.
    free : (n_shared,) bool array
        Which parameters of the cameras and the rig are free; the poses always are.
    """
    shared, columns = np.flatnonzero(free), start.columns

    def blocks(state: RigState) -> tuple[Array, bool]:
        return rig_normal_blocks(problem.frames, problem.observations, state)

    def moved(before: _Linearised, by_shared: Array, by_own: Array) -> tuple[_Linearised, bool]:
        # Valid if all points are in front of their cameras and the distortions are monotonic.
        step = np.zeros(columns.n_shared)
        step[shared] = by_shared
        state = before[0].moved(step, by_own)
        normal, sensible = blocks(state)
        positive = all(camera.entries[0, [0, 2]].min() > 0 for camera in state.cameras)
        return (state, normal), sensible and positive

    error = SharedAndOwn((start, blocks(start)[0]), lambda at: at[1], moved, shared, columns.pose)
    floor = FLOOR**2 * sum(observed.n_equations * observed.weight for observed in problem.observations)
    outcome = minimise(error, replace(OPTIONS, damping=_DAMPING), floor)
    state, normal = error.state
    iterations, settled = int(outcome.iterations[0]), bool(outcome.settled[0])
    return RigFit(problem, free, state.orthonormalised(), normal, iterations, settled)

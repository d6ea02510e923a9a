"""Bundle adjustment of both cameras, the rig and all poses on the whitened reprojection error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import FLOOR, OPTIONS
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.levenberg_marquardt import minimise
from neurocal_cli.least_squares.schur_complement import schur_step
from neurocal_cli.stereo.problem import RigProblem
from neurocal_cli.stereo.reprojection import RigState, rig_normal_blocks

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
    error = _RigReprojection(problem, start, free)
    options = replace(OPTIONS, damping=_DAMPING)
    floor = FLOOR**2 * sum(observed.n_equations * observed.weight for observed in problem.observations)
    outcome = minimise(error, options, floor)
    state, iterations = error.state.orthonormalised(), int(outcome.iterations[0])
    return RigFit(problem, free, state, error.normal, iterations, bool(outcome.settled[0]))


_Step = tuple[Array, Array]  # of the shared parameters (n_shared,) and of the poses (V, 6)
_Trial = tuple[RigState, Array]  # a state and its normal matrices


class _RigReprojection:
    """The reprojection error of both cameras as a problem of `least_squares` with one group."""

    def __init__(self, problem: RigProblem, start: RigState, free: NDArray[np.bool_]) -> None:
        self.problem, self.state, self.shared = problem, start, np.flatnonzero(free)
        self.normal, _ = self._blocks(start)

    def _blocks(self, state: RigState) -> tuple[Array, bool]:
        return rig_normal_blocks(self.problem.frames, self.problem.observations, state)

    @property
    def cost(self) -> Array:
        """(1,) sum of squares."""
        return self.normal[:, -1, -1].sum(keepdims=True)

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[_Step, Array]:
        """Steps of the shared parameters and of the poses, and the predicted gain."""
        columns = self.state.columns
        by_shared, by_own, promised = schur_step(self.normal, self.shared, columns.pose, float(damping[0]))
        step = np.zeros(columns.n_shared)
        step[self.shared] = by_shared
        return (step, by_own), np.array([promised])

    def move(self, step: _Step, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """The state after a step; valid if all points are in front and the distortion is monotonic."""
        trial = self.state.moved(*step)
        normal, sensible = self._blocks(trial)
        sensible = sensible and all(camera.entries[0, [0, 2]].min() > 0 for camera in trial.cameras)
        return (trial, normal), normal[:, -1, -1].sum(keepdims=True), np.array([sensible])

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial."""
        if better[0]:
            self.state, self.normal = trial

"""The common bundle adjustment of a rig, and how much its frames contradict each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import FLOOR, OPTIONS
from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.levenberg_marquardt import minimise
from neurocal_cli.adjustment.normal_equations import Arrowhead, SharedAndOwn
from neurocal_cli.calibration.rig.combine import cost_alone
from neurocal_cli.calibration.rig.problem import (
    RigProblem,
)
from neurocal_cli.calibration.rig.state import RigState
from neurocal_cli.calibration.verdict.findings import TOLD
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, orthonormalised

# A state, its normal equations, and those of the unknowns that move.
_Linearised = tuple[RigState, Arrowhead, Arrowhead]
_DAMPING = 1e-6  # each camera was adjusted alone before, so the first step is nearly undamped


@frozen_dataclass(eq=False)
class RigFit:
    """A problem, and what the common bundle adjustment made of it."""

    problem: RigProblem
    free: NDArray[np.bool_]  # (n_shared,) which parameters of the cameras and the rig moved
    state: RigState
    normal: Arrowhead  # of all unknowns
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        """Sum of squared whitened residuals."""
        return self.normal.cost

    @property
    def variance(self) -> float:
        """Of the whitened residuals; 1 where both cameras alone leave no less."""
        equations = sum(observed.n_equations for observed in self.problem.observations)
        unknowns = int(self.free.sum()) + 6 * len(self.problem.scale)
        return self.cost / max(equations - unknowns, 1)


def scatter(fit: RigFit) -> tuple[float, int]:
    """Sum of squares of the views' poses about one rig, over that of noise, and its degrees of freedom.

    It is what the common fit leaves beyond each camera alone.
    """
    problem = fit.problem
    alone = sum(map(cost_alone, problem.own_normal, problem.estimated))
    views = sum(len(observed.view) for observed in problem.observations)
    degrees = 6 * (views - len(problem.scale)) - problem.n_rig
    return max(fit.cost - alone, 0.0), max(degrees, 0)


def is_significant(squares: float, degrees: int) -> bool:
    """Whether a sum of squares is larger than by chance: a chi-squared test by the level of all causes.

    Examples
    --------
    >>> is_significant(70.0, 54), is_significant(100.0, 54)
    (False, True)
    """
    return degrees > 0 and bool(squares / degrees > exceeded_by_chance(degrees, TOLD))


def adjust_rig(problem: RigProblem, start: RigState, free: NDArray[np.bool_]) -> RigFit:
    """Minimise the reprojection error of both cameras from a start near the minimum.

    All points must be in front of their cameras at the start. `free` (n_shared,) are the parameters of the
    cameras and the rig that move; the poses always do.
    """
    shared, columns = np.flatnonzero(free), start.columns

    def linearised(state: RigState) -> tuple[_Linearised, bool]:
        normal, sensible = problem.normal(state)
        return (state, normal, normal.only(shared)), sensible

    def moved(before: _Linearised, by_shared: Array, by_own: Array) -> tuple[_Linearised, bool]:
        # Valid if all points are in front of their cameras and the distortions are monotonic.
        step = np.zeros(columns.n_shared)
        step[shared] = by_shared
        after, sensible = linearised(before[0].moved(step, by_own))
        positive = all(camera.entries[0, [0, 2]].min() > 0 for camera in after[0].cameras)
        return after, sensible and positive

    error = SharedAndOwn(linearised(start)[0], lambda at: at[2], moved)
    floor = FLOOR**2 * sum(observed.n_equations * observed.weight for observed in problem.observations)
    outcome = minimise(error, replace(OPTIONS, damping=_DAMPING), floor)
    state, normal, _ = error.state
    state = replace(state, R=orthonormalised(state.R), view_R=orthonormalised(state.view_R))
    return RigFit(problem, free, state, normal, int(outcome.iterations[0]), bool(outcome.settled[0]))

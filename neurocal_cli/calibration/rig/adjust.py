"""The common bundle adjustment of calibrated cameras with common frames.

`rig_problem` makes one problem of them, in which each camera has the noise that it has alone. `scatter` tells
how much the frames contradict each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import FLOOR, OPTIONS
from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.common_noise import weighed
from neurocal_cli.adjustment.levenberg_marquardt import minimise
from neurocal_cli.adjustment.normal_equations import ROUNDING, Arrowhead, SharedAndOwn, solve_scaled
from neurocal_cli.adjustment.problem import normalised
from neurocal_cli.adjustment.repeated_poses import repeated_poses
from neurocal_cli.adjustment.reprojection import (
    POSE_COLUMNS,
    free_columns,
    normal_blocks,
)
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.calibration import Calibration, estimated_parameters
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.calibration.rig.problem import (
    Frames,
    Observations,
    RigProblem,
    RigState,
)
from neurocal_cli.calibration.verdict.findings import TOLD
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median, orthonormalised
from neurocal_cli.camera.state import CameraState

# A state, its normal equations, and those of the unknowns that move.
_Linearised = tuple[RigState, Arrowhead, Arrowhead]

_DAMPING = 1e-6  # each camera was adjusted alone before, so the first step is nearly undamped


# Smaller noise, as a share of the other camera's and in normalised pixels, is rounding in data without noise;
# test_without_noise_the_truth_comes_back checks such data.
_LEAST_SHARE = 1e-3
_LEAST_NOISE = 1e-12


def rig_problem(calibrations: Sequence[Calibration], frames: Frames) -> RigProblem:
    """Combine calibrations with one world unit; the frames are numbered from 0, without gaps."""
    # Covariances of the points count as far as the residuals confirm them.
    arranged = [weighed(camera.points, evaluate_camera(camera).residuals) for camera in calibrations]
    V = 1 + max(int(frame.max()) for frame in frames)
    centre, scale = np.empty((V, 3)), np.empty(V)
    basis, extent, is_flat = np.empty((V, 3, 3)), np.empty((V, 3)), np.empty(V, dtype=bool)
    for own, frame in reversed(list(zip(arranged, frames, strict=True))):
        centre[frame], scale[frame] = own.centre, own.scale
        basis[frame], extent[frame], is_flat[frame] = own.basis, own.extent, own.nearly_flat
    sides = [
        _side(camera, own, centre[which], scale[which], which)
        for camera, own, which in zip(calibrations, arranged, frames, strict=True)
    ]
    seen, states, normals, noise = zip(*sides, strict=True)
    real = [observed.views.pixel_scale * s for observed, s in zip(seen, noise, strict=True)]
    weights = [
        1.0 / (s * max(1.0, _LEAST_SHARE * max(real) / own)) ** 2 for s, own in zip(noise, real, strict=True)
    ]
    return RigProblem(
        calibrations=tuple(calibrations),
        centre=centre,
        scale=scale,
        unit=float(median(scale)),
        observations=tuple(replace(one, weight=weight) for one, weight in zip(seen, weights, strict=True)),
        cameras=states,
        own_normal=tuple(weight * normal for weight, normal in zip(weights, normals, strict=True)),
        basis=basis,
        extent=extent,
        is_flat=is_flat,
    )


def free_parameters(calibration: Calibration) -> NDArray[np.bool_]:
    """(5 + K,) which of A's entries and the distortion coefficients a common fit may move.

    With a distortion from straight lines none is, as camera and distortion belong together.
    """
    return estimated_parameters(calibration) & (calibration.straight_lines is None)


def _side(
    calibration: Calibration, views: Views, centre: Array, scale: Array, frame: NDArray[np.intp]
) -> tuple[Observations, CameraState, Array, float]:
    """Normalised observations of one camera (without weight), its state, normal matrices and noise.

    `centre` (V_c, 3) and `scale` (V_c,) are those of the views' frames.
    """
    local = views.local * np.repeat(views.scale / scale, views.counts)[:, None]
    local += np.repeat((views.centre - centre) / scale[:, None], views.counts, axis=0)
    views = replace(views, local=local, centre=centre, scale=scale)
    state = normalised(calibration.state(views.names), views)
    normal, free = normal_blocks(views.batches, state)[0], free_parameters(calibration)
    spare = views.n_equations - int(free.sum()) - 6 * views.n_views
    noise = max(float(np.sqrt(cost_alone(normal, free) / max(spare, 1))), _LEAST_NOISE)
    return Observations(views, frame, 1.0), state, normal, noise


def cost_alone(normal: Array, free: NDArray[np.bool_]) -> float:
    """Sum of squares of one camera at its own minimum, to which one step leads.

    `normal` (V, 12 + K, 12 + K) are its `normal_blocks` in any poses near it, such as those of a common fit,
    and `free` (5 + K,) are its parameters that move.
    """
    reduced, _ = Arrowhead.of(normal, free_columns(free), POSE_COLUMNS).reduced()
    gained = reduced[-1, :-1] @ solve_scaled(reduced[:-1, :-1], reduced[:-1, -1:], ROUNDING)[:, 0]
    return max(float(reduced[-1, -1] - np.nan_to_num(gained)), 0.0)


@frozen_dataclass(eq=False)
class RigFit:
    """A problem, and what the common bundle adjustment made of it."""

    problem: RigProblem
    free: NDArray[np.bool_]  # (n_shared,) which parameters of the cameras and the rig moved
    state: RigState
    normal: Arrowhead  # of all unknowns
    iterations: int
    converged: bool

    @cached_property
    def arrow(self) -> Arrowhead:
        """Normal equations of the unknowns that moved."""
        return self.normal.only(np.flatnonzero(self.free))

    @property
    def cost(self) -> float:
        """Sum of squared whitened residuals."""
        return self.normal.cost

    @property
    def variance(self) -> float:
        """Of the whitened residuals; 1 where both cameras alone leave no less."""
        equations = sum(observed.views.n_equations for observed in self.problem.observations)
        unknowns = int(self.free.sum()) + 6 * len(self.problem.scale)
        return self.cost / max(equations - unknowns, 1)

    @cached_property
    def worth(self) -> float:
        """Effective number of independent views over the number of views: fewer if they are alike."""
        total = independent = 0.0
        for side, observed in enumerate(self.problem.observations):
            views, camera = observed.views, self.problem.camera(self.state, side)
            alike = repeated_poses(views, camera, point_residuals(views, camera))
            total += views.n_equations
            independent += views.n_equations * alike.worth
        return independent / total


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
        return (state, normal, problem.penalised(normal, state).only(shared)), sensible

    def moved(before: _Linearised, by_shared: Array, by_own: Array) -> tuple[_Linearised, bool]:
        # Valid if all points are in front of their cameras and the distortions are monotonic.
        step = np.zeros(columns.n_shared)
        step[shared] = by_shared
        after, sensible = linearised(before[0].moved(step, by_own))
        positive = all(camera.entries[0, [0, 2]].min() > 0 for camera in after[0].cameras)
        return after, sensible and positive

    error = SharedAndOwn(linearised(start)[0], lambda at: at[2], moved)
    floor = FLOOR**2 * sum(seen.views.n_equations * seen.weight for seen in problem.observations)
    outcome = minimise(error, replace(OPTIONS, damping=_DAMPING), floor)
    state, normal, _ = error.state
    state = replace(state, R=orthonormalised(state.R), view_R=orthonormalised(state.view_R))
    return RigFit(problem, free, state, normal, int(outcome.iterations[0]), bool(outcome.settled[0]))

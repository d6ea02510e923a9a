"""Result of a baseline."""

from __future__ import annotations

from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.state import CameraState


@frozen_dataclass(eq=False)
class Found:
    """Result of a baseline."""

    problem: Problem  # as solved; a method may take more parameters as given than the user
    state: CameraState  # normalised
    minimised: bool  # whether the reprojection error is at a minimum, as with least squares on (3)
    iterations: int = 0
    converged: bool = True  # False if an iteration ended early
    remarks: tuple[str, ...] = ()  # for the user


def as_seen(problem: Problem, state: CameraState) -> tuple[Problem, CameraState]:
    """Restore a given distortion, which was removed from the pixels for methods that use a pinhole."""
    distortion = problem.distortion
    if distortion.model == "none" or problem.free_distortion:
        return problem, state
    return problem.as_seen(state)

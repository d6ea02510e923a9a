"""What a baseline returns, and how it becomes a calibration."""

from __future__ import annotations

from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.frozen_dataclass import frozen_dataclass


@frozen_dataclass(eq=False)
class Found:
    """The answer of a baseline.

    Attributes
    ----------
    problem : Problem
        What was asked for; a method may take more for given than the user did.
    state : CameraState
        Normalised.
    minimised : bool
        Whether the reprojection error is at a minimum there, which only least squares on (3) promises.
    iterations : int
    converged : bool
        False where an iteration was cut short.
    remarks : tuple of str
        What the user should know.
    """

    problem: Problem
    state: CameraState
    minimised: bool
    iterations: int = 0
    converged: bool = True
    remarks: tuple[str, ...] = ()


def as_seen(problem: Problem, state: CameraState) -> tuple[Problem, CameraState]:
    """Put a given distortion back, which was taken off the pixels for a method that knows a pinhole only."""
    distortion = problem.distortion
    if distortion.model == "none" or problem.free_distortion:
        return problem, state
    return problem.as_seen(state)

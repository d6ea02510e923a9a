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
        The problem solved; a method may take more parameters as given than the user did.
    state : CameraState
        Normalised.
    minimised : bool
        Whether the state is a minimum of the reprojection error, which only least squares on (3) ensures.
    iterations : int
    converged : bool
        False where an iteration was cut short.
    remarks : tuple of str
        Warnings for the user.
    """

    problem: Problem
    state: CameraState
    minimised: bool
    iterations: int = 0
    converged: bool = True
    remarks: tuple[str, ...] = ()


def as_seen(problem: Problem, state: CameraState) -> tuple[Problem, CameraState]:
    """Restore a given distortion, which was removed from the pixels for a pinhole-only method."""
    distortion = problem.distortion
    if distortion.model == "none" or problem.free_distortion:
        return problem, state
    return problem.as_seen(state)

"""The common bundle adjustment with the cameras refined, as far as the frames allow it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.calibration.rig.adjust import RigFit, adjust_rig
from neurocal_cli.calibration.rig.combine import free_parameters
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.rig.result import non_monotonic_sides
from neurocal_cli.calibration.rig.state import RigState
from neurocal_cli.calibration.verdict.findings import CONTRADICTION

# Largest rms residual of the common fit, in units of that of both cameras alone, with which the cameras are
# refined; otherwise errors of the pairs spoil them: test_pairs_that_scatter_do_not_spoil_the_cameras.


def adjusted(
    problem: RigProblem, start: RigState, refine_cameras: bool, names: Sequence[str]
) -> tuple[RigFit, list[str]]:
    """The common bundle adjustment, and its warnings, in which the cameras have these names.

    The cameras are not refined if errors of the rig would spoil them.
    """
    moving = [refine_cameras] * len(problem.cameras)
    warnings = []
    while True:
        free = np.concatenate(
            [free_parameters(c) & moves for c, moves in zip(problem.calibrations, moving, strict=True)]
            + [np.ones(problem.n_rig, dtype=bool)]
        )
        fit = adjust_rig(problem, start, free)
        if any(moving) and np.sqrt(fit.variance) > CONTRADICTION.good:
            moving = [False] * len(moving)
            warnings = [
                "the pairs of views contradict each other, so the cameras keep the result of their own views"
            ]
            continue
        if not (not_monotonic := non_monotonic_sides(fit)):
            return fit, warnings
        for side in not_monotonic:
            moving[side] = False
            warnings.append(
                f"after the common bundle adjustment the distortion model of the {names[side]} "
                "is not monotonic (maps two directions to one pixel) inside the image, where there "
                "are no points; the result of its own views is kept; add views that show the board in the "
                "image's corners"
            )

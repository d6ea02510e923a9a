"""The end of every calibration with a distortion: on the pixels as they were seen, and monotonic.

The networks know a pinhole only. A distortion that is given is taken off the pixels before they train
(`Problem`), and bundle adjustment ends on the pixels as they were seen. A distortion that is estimated
joins in the bundle adjustment (`Problem.adjust`).
"""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.distortion.monotonic_fit import fit_monotonic, folds_back
from neurocal_cli.errors import DegenerateGeometryError


def check_distortion(solution: Solution) -> Solution:
    """Put a given distortion back, and check that the distortion is monotonic.

    One that is not, where no point is seen, is fitted so that it is, unless the points deny it. One that is
    given stays.

    Raises
    ------
    DegenerateGeometryError
        An estimated distortion that is not monotonic inside the points, or inside the image whatever one
        does.
    """
    problem = solution.problem
    distortion = problem.distortion
    if distortion.model == "none":
        return solution
    if not problem.free_distortion:
        # It may fold the image's corners: `problem_for` took these points off it.
        problem, start = problem.as_seen(solution.state)
        adjusted = problem.adjust(replace(solution.adjusted, state=start))
        return replace(solution, problem=problem, adjusted=adjusted)
    where = folds_back(problem, solution.state)
    if where is None:
        return solution
    if where == "image" and solution.shared is None:
        found = fit_monotonic(problem, solution.adjusted)
        if found is not None:
            return replace(solution, problem=found[0], adjusted=found[1])
        if distortion.wide:  # its image may end within the picture
            return solution
    raise DegenerateGeometryError(
        f"the distortion model {distortion.model} is not monotonic (maps two directions to one pixel) inside "
        f"the {where}; choose another --distortion, or give points nearer to the image's corners"
    )

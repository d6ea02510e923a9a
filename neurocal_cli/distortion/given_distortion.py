"""Final step of a calibration with distortion: observed pixels, and a monotonic model.

The networks model a pinhole. A given distortion is removed from the pixels before training (`Problem`), and
the final bundle adjustment uses the observed pixels. An estimated distortion is part of the bundle adjustment
(`Problem.adjust`).
"""

from __future__ import annotations

from dataclasses import replace

from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.distortion.monotonic_fit import fit_monotonic, folds_back
from neurocal_cli.distortion.simpler_model import undetermined_coefficients
from neurocal_cli.errors import DegenerateGeometryError


def check_distortion(solution: Solution) -> Solution:
    """Restore a given distortion, and check that an estimated one is monotonic.

    An estimated distortion that is not monotonic in parts of the image without points is fitted again so that
    it is, unless the points contradict that.

    Raises
    ------
    DegenerateGeometryError
        The estimated distortion is not monotonic among the points, or cannot be made so within the image.
    """
    problem = solution.problem
    distortion = problem.distortion
    if distortion.model == "none":
        return solution
    if not problem.free_distortion:
        # A given distortion may fold the image's corners, but `problem_for` has checked these points.
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
        if distortion.wide:  # its image circle may end within the image
            return solution
    folded = (
        f"the distortion model {distortion.model} is not monotonic (maps two directions to one pixel) inside "
        f"the {where}; choose another --distortion, or give points nearer to the image's corners"
    )
    raise DegenerateGeometryError(undetermined_coefficients(problem, solution.adjusted) or folded)

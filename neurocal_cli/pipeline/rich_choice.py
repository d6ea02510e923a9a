"""``auto`` takes a rich lens where no other lens, and no target, leaves noise.

A bent board, wrong points and a second camera bend residuals, too. So the rich lens comes last: for the
target as it is given, against the best other lens with the target that was found. Both predict the same views
left out, the rich lens with its prior in place. It is taken where it predicts decidedly better and leaves
noise. What follows the board, or single views, is no lens: it is different in views left out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.cross_validation import held_out_views
from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.repeated_poses import RepeatedPoses, repeated_poses
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.units import normalised
from neurocal_cli.calibration import Rejected
from neurocal_cli.distortion.candidate_models import as_fisheye
from neurocal_cli.distortion.model_selection import predicts_decidedly_better
from neurocal_cli.distortion.monotonic_fit import normal_part
from neurocal_cli.distortion.rich_fit import promised, with_displacement
from neurocal_cli.geometry import Array
from neurocal_cli.initialisation.options import Options
from neurocal_cli.pipeline.outlier_rejection import judged_again
from neurocal_cli.verdict.view_groups import view_groups

# Repeated by tests/test_rich_lens.py (slow): on views left out such lenses are better by 1.28 and more, with
# residuals correlated by -0.05 and less; bent boards and two cameras by 1.0 at most; photographs of a board
# that is not flat by up to 1.19, with residuals correlated by 0.5.
_FEWEST = 20  # different views
_BETTER = 1.1  # times the rms error on views left out
_PROMISED = 1.05  # likewise, before it is adjusted: it is within a percent
# Correlation of neighbours' residuals. Ordinary lenses leave 0.04 and less, a narrow bump 0.09.
_ALIKE, _NOISE = 0.05, 0.15


def with_rich_lens(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str
) -> tuple[Solution, Rejected]:
    """Take a rich lens if it predicts decidedly better.

    Parameters
    ----------
    problem : Problem
        With all points, where their file has them.
    solution, rejected
        The best of the other lenses, with the target where it was found.
    options : Options
    choice : {"auto", "given", "flat", "free"}
        How the target is found. Unless it is looked for, nobody knows whether it is bent.

    Returns
    -------
    solution, rejected
        The ones given where the lens stays as it is.
    """
    looked_for = choice == "auto" and options.distortion == "auto" and problem.points.world_std is None
    if not looked_for or solution.refusal or rejected.views or not solution.problem.free_poses:
        return solution, rejected
    views = solution.problem.views
    errors = point_residuals(views, solution.state)
    if views.n_views < _FEWEST or correlation(views, errors) < _ALIKE:
        return solution, rejected
    repeated = repeated_poses(views, solution.state, errors)
    if repeated.n_poses < _FEWEST:
        return solution, rejected
    rich = _rich(solution, repeated)
    if rich is None or not _is_the_lens(rich, solution, repeated):
        return solution, rejected
    found = {**(solution.model_errors or {}), "rich": _held_out_rms(rich, repeated)}
    if len(rejected):
        rich, rejected = judged_again(problem, rich, rejected, options)
    return replace(rich, model_errors=found), rejected


def _rich(solution: Solution, repeated: RepeatedPoses) -> Solution | None:
    """A rich lens for the target as it is given; None where it cannot be found, or promises too little."""
    problem, target = solution.problem, solution.target
    points = problem.points if target is None else target.as_given(problem.points)
    problem = problem.with_points(points)
    fisheye = as_fisheye(problem, normalised(solution.in_pixels, problem.views))
    start = replace(solution, problem=fisheye[0], adjusted=fisheye[1], target=None)
    try:
        if not promised(start, repeated).sum() * _PROMISED**2 < _lost(solution, repeated).sum():
            return None
        return with_displacement(start)
    except np.linalg.LinAlgError:
        return None


def _is_the_lens(rich: Solution, other: Solution, repeated: RepeatedPoses) -> bool:
    lost, others = _lost(rich, repeated), _lost(other, repeated)
    if not (np.isfinite(lost).all() and predicts_decidedly_better(lost, others, repeated, _BETTER)):
        return False
    views, state = rich.problem.views, rich.state
    if correlation(views, point_residuals(views, state)) > _NOISE:
        return False
    return view_groups(views, state, rich.adjusted.normal, rich.problem.free_of_prior) is None


def _held_out_rms(solution: Solution, repeated: RepeatedPoses) -> float:
    views = solution.problem.views
    return float(np.sqrt(_lost(solution, repeated).sum() / len(views.index))) * views.pixel_scale


def _lost(solution: Solution, repeated: RepeatedPoses) -> Array:
    """Squared error of each view when it is left out."""
    problem, state, free = solution.problem, solution.state, solution.problem.free_camera
    held = None if problem.restraint is None else normal_part(problem.restraint, state, free)
    return held_out_views(solution.adjusted.normal, free, True, held, repeated)

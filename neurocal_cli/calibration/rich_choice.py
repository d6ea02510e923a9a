"""``--distortion auto``: choose the rich lens if no other lens and no target shape leaves only noise.

A bent board, outliers and a second camera leave systematic residuals as well. So the rich lens is tried last:
it is fitted to the target as given and compared with the best other lens on the estimated target. Both
predict the same held-out views, the rich lens with its prior. It is chosen if it predicts decidedly better
and its residuals are noise. Errors that belong to the board or to single views do not pass this test, because
they differ in the held-out views.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.cross_validation import held_out_views
from neurocal_cli.adjustment.problem import Problem, normalised
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.calibration.calibration import Rejected
from neurocal_cli.calibration.lens_choice.candidate_models import adjusted_to
from neurocal_cli.calibration.lens_choice.given_model import WRONG_LENS
from neurocal_cli.calibration.lens_choice.model_selection import predicts_decidedly_better
from neurocal_cli.calibration.lens_choice.monotonic_fit import normal_part
from neurocal_cli.calibration.lens_choice.rich_fit import promised, with_displacement
from neurocal_cli.calibration.outlier_rejection import fit_robustly
from neurocal_cli.calibration.verdict.contest import contest
from neurocal_cli.calibration.verdict.findings import NO_WORSE
from neurocal_cli.calibration.verdict.rivals import RICHER_LENSES
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.options import Options

# Repeated by test_rich_lens.py (slow). The rms error on held-out views drops by a factor of 1.28 or
# more for such lenses (residual correlation -0.05 or less), of at most 1.0 for bent boards and two cameras,
# and of up to 1.19 for photographs of a board that is not flat (residual correlation 0.5).
_FEWEST = 20  # fewest different poses
_BETTER = 1.1  # least factor by which the rms error on held-out views must drop
# Correlation of neighbouring residuals from which on the rich lens is tried. Ordinary lenses leave 0.04 or
# less, a narrow bump 0.09.
_ALIKE = 0.05
_BETWEEN = ("two cameras", "a zoom that moves")  # that a rich lens must not leave


def with_rich_lens(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str
) -> tuple[Solution, Rejected]:
    """Choose a rich lens if it predicts decidedly better; else solution and rejected points stay.

    The problem has all points, at the world coordinates of their file. The solution has the best other lens,
    with the target if it was estimated. The choice is how; only with "auto" is it known that a bent target is
    not the cause.
    """
    looked_for = choice == "auto" and options.distortion == "auto" and problem.points.world_std is None
    if not looked_for or rejected.views or not solution.problem.free_poses:
        return solution, rejected
    rich = _rich_lens(solution)
    if rich is None:
        return solution, rejected
    found = rich.model_errors
    if len(rejected):
        try:
            named = replace(options, distortion="")
            rich, rejected = fit_robustly(problem.with_model("rich"), named)
        except DegenerateGeometryError:  # with other points there is no such lens
            return solution, rejected
    return replace(rich, model_errors=found), rejected


def _rich_lens(solution: Solution) -> Solution | None:
    """Fit a rich lens on the given target; None if it, or already its prediction, is not good enough."""
    problem, target, size = solution.problem, solution.target, solution.problem.points.image_size
    if problem.views.n_views < _FEWEST or solution.alike < _ALIKE or solution.repeated.n_groups < _FEWEST:
        return None
    repeated, held = solution.repeated, contest(solution.minimum, size)
    # What differs from view to view may be the lens: other parts of it are seen.
    if held is None or (held.of_all_views and held.causes[0].rival.cause != RICHER_LENSES[0].cause):
        return None
    problem = problem.with_points(problem.points if target is None else target.as_given(problem.points))
    fisheye = problem.with_model("fisheye")
    adjusted = adjusted_to(fisheye, normalised(solution.in_pixels, problem.views))
    start = replace(solution, problem=fisheye, adjusted=adjusted, target=None)
    try:
        others = _lost(solution, repeated)
        if not promised(start, repeated).sum() * NO_WORSE**2 < others.sum():
            return None
        rich = with_displacement(start)
    except (DegenerateGeometryError, np.linalg.LinAlgError):
        return None
    lost = _lost(rich, repeated)
    if not (np.isfinite(lost).all() and predicts_decidedly_better(lost, others, repeated, _BETTER)):
        return None
    if rich.alike > WRONG_LENS:
        return None
    odd = contest(rich.minimum, size)
    if odd is not None and any(one.rival.cause in _BETWEEN for one in odd.causes):
        return None
    views = rich.problem.views
    rms = float(np.sqrt(lost.sum() / len(views.index))) * views.pixel_scale
    return replace(rich, model_errors={**(solution.model_errors or {}), "rich": rms})


def _lost(solution: Solution, repeated: RepeatedPoses) -> Array:
    """(V,) squared error of each view when it is left out."""
    problem, state, free = solution.problem, solution.state, solution.problem.free_camera
    held = None if problem.penalty is None else normal_part(problem.penalty, state, free)
    return held_out_views(problem.minimum(solution.adjusted, repeated), held)

"""Estimate the target's shape with the camera if the data support that, and nothing else explains them.

Residuals of a bent board look like lens distortion. So the target is estimated with the lens selected for the
given target, the lens is selected again for that target, and so on until the distortion model stays the same.
The outliers are judged again as well: many of them contradict only the given target.

Bends. Besides the common target, given or estimated, each view may have a bend of its own. Two models are
compared by their evidence: bends of the given target, and bends with a target estimated together with them.

Survey. Points with stated standard deviations are first weighted and tested for outliers with the sum of
their pixel noise and their projected survey error. Then camera and points are adjusted together, because all
views of a point share its survey error.

`common_target` is that of the cameras of a rig or the settings of a zoom lens, estimated from all views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.find import (
    LEAST_GAIN,
    Found,
    Search,
    enough_views,
    find_target,
    gain_over_given,
)
from neurocal_cli.adjustment.board.surveyed import find_surveyed
from neurocal_cli.adjustment.common_noise import reweighted
from neurocal_cli.adjustment.free_networks import variance_of_views
from neurocal_cli.adjustment.problem import Problem, normalised, problem_for
from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.adjustment.solution import Solution, TrainingRecord, of_few_views
from neurocal_cli.calibration.calibration import Calibration, Rejected, fixed_intrinsics
from neurocal_cli.calibration.fit import fit, fit_again
from neurocal_cli.calibration.lens_choice.model_selection import find_lens_and_target
from neurocal_cli.calibration.other_causes import contradicts_sigma, has_other_cause
from neurocal_cli.calibration.outlier_rejection import fit_robustly
from neurocal_cli.calibration.point_errors import MEDIAN, places_of_views, rms, squared_whitened
from neurocal_cli.calibration.verdict.contest import contest
from neurocal_cli.calibration.verdict.findings import DETERMINE, NO_WORSE
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.errors import DegenerateGeometryError, NeurocalError
from neurocal_cli.network.options import Options
from neurocal_cli.observations.board import is_flat, planes_of
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import Target, distinct_points


def common_target(cameras: Sequence[Calibration], choice: str) -> Target | None:
    """Estimate the target's shape from the views of all cameras; None if the target stays as given.

    The cameras are in the same world unit. Either none holds a target, or all hold the same one, which is
    then the starting point. The choice is "auto", "given", "flat" or "free".
    """
    if choice != "given" and any(
        camera.target is not None and camera.target.stated is not None for camera in cameras
    ):
        return _common_survey(cameras)
    if not can_tell(cameras, choice):
        return None
    known = cameras[0].target
    try:
        fits = [_fit(camera) for camera in cameras]
    except NeurocalError:
        return None
    named = not all(camera.lens_choice for camera in cameras)
    found = find_shape(fits, choice, known, named)
    if found is None:
        return None
    doubtful = named and known is None and choice == "auto"
    return None if doubtful and has_other_cause(fits, found) else found.target


def _common_survey(cameras: Sequence[Calibration]) -> Target | None:
    """Surveyed points, adjusted with all cameras, starting again from the survey."""
    stated = [
        camera if camera.target is None else replace(camera, points=camera.target.as_given(camera.points))
        for camera in cameras
    ]
    try:
        found = find_surveyed([_fit(camera) for camera in stated])
    except NeurocalError:
        return None
    return None if found is None else found.target


def _fit(calibration: Calibration) -> tuple[Problem, Adjusted]:
    """The problem that a calibration solves, adjusted to its minimum."""
    given = calibration.intrinsics
    problem = problem_for(
        calibration.points,
        calibration.type,
        image_center=(given.u0, given.v0) if calibration.type == 2 else None,
        intrinsics=given if calibration.type == 3 else None,
        skew="theta" not in calibration.fixed or calibration.type == 3,
        distortion=calibration.camera.distortion,
        fix=fixed_intrinsics(calibration),
        square=calibration.square_pixels,
    ).with_seen_pixels()
    problem = replace(problem, fixed=problem.fixed | calibration.fixed)
    state = calibration.state(problem.views.names)
    return problem, problem.adjust(normalised(state, problem.views))


def solution_of(calibration: Calibration) -> Solution:
    """The solution that a calibration was made of, to start from; of the method neuro."""
    problem, adjusted = _fit(calibration)
    of, n, px = calibration.network, len(problem.points), problem.views.pixel_scale
    assert of is not None
    record = TrainingRecord(
        np.full(problem.views.n_views, of.agreed), of.starts, of.iterations,
        (of.loss / px) ** 2 * n, (of.rmse_before / px) ** 2 * n, np.array(of.curve) / px,
    )  # fmt: skip
    return Solution(problem, adjusted, record)


def find_shape(
    fits: Sequence[tuple[Problem, Adjusted]], choice: str, known: Target | None, named: bool
) -> Found | None:
    """Estimate the target as chosen, starting from a known one; only a lens that is not named may change."""
    find = find_target if named or known is not None else find_lens_and_target
    return find(fits, choice == "flat", known, LEAST_GAIN if choice == "auto" else -np.inf)


def can_tell(cameras: Sequence[Calibration], choice: str) -> bool:
    """Whether these cameras have the views and the freedom to estimate their target; see `common_target`."""
    fixed = any(camera.straight_lines is not None or camera.method != "neuro" for camera in cameras)
    if choice == "given" or fixed:
        return False
    if choice == "auto" and any(camera.type != 1 or fixed_intrinsics(camera) for camera in cameras):
        return False  # a wrong given parameter would be absorbed by the target's shape
    n_views = sum(len(camera.views) for camera in cameras)
    return views_suffice([camera.points for camera in cameras], cameras[0].target, n_views)


def views_suffice(points: Sequence[Correspondences], known: Target | None, n_different: int) -> bool:
    """Whether enough different views show most points of a target, which is known if it was estimated."""
    given, label, point = distinct_points(points)
    plane = planes_of(given, point) if known is None else known.plane
    return enough_views(label, n_different, int(plane.max()) + 1)


def on_one_target(left: Calibration, right: Calibration) -> tuple[Calibration, Calibration]:
    """Refer the points of two separately calibrated cameras to one target.

    If each camera has estimated the target by itself, the common one is the mean of both estimates. Bends of
    single views are left out, because only one of the cameras may have estimated them.
    """
    if left.target is right.target and (left.target is None or left.target.bends is None):
        return left, right
    first, second = left.target or right.target, right.target or left.target
    assert first is not None
    assert second is not None
    target = replace(first if first is second else first.joined(second), bends=None)

    def on_it(camera: Calibration) -> Calibration:
        points = camera.points if camera.target is None else camera.target.as_given(camera.points)
        return replace(camera, points=target.applied(points), target=target)

    return on_it(left), on_it(right)


_ROUNDS = 3
_WORTH = 0.8  # least effective share of the views that are asked together, where some share their errors
_SETTLED = 0.01  # standard deviations by which a camera may move and still count as the same
# Bends per view are accepted if they explain nine tenths of the excess variance between views, or leave at
# most 1.1 times the noise. With eight tenths, one half of the photographs of paper boards predicts the other
# half 3 % worse.
_SHARE, _NOISE = 0.9, 1.1
_HALVINGS = 30
_LEAST_NOISE = 1e-3  # least pixel noise, as a share of the residuals' level


def with_target(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str
) -> tuple[Solution, Rejected]:
    """Estimate the target's shape, and fit the camera to it.

    The problem has all points, at the world coordinates of their file; the solution and the rejected points
    are for the given target. They are returned unchanged if it stays. The choice is "auto", "flat" or
    "free". Raises `InputError` if a point has two different standard deviations, and, for points with any,
    `DegenerateGeometryError` if they do not determine the camera.
    """
    if problem.points.world_std is not None:
        return _with_survey(problem, solution, rejected, options)
    rich = solution.state.model == "rich"  # flexible enough to absorb a bent target
    if options.distortion == "plumb-line" or rich:
        return solution, rejected
    known = _searched(problem, solution, rejected, options, choice)
    if not _may_contradict_only_given(problem, known[1]):
        return known
    try:
        found = _searched(problem, solution.of_all or fit(problem, options), known[1], options, choice)
    except DegenerateGeometryError:
        return known
    explained = found[0].target is not None and len(found[1]) <= len(known[1])
    return found if explained and rms(found[0]) <= NO_WORSE * rms(known[0]) else known


def _may_contradict_only_given(problem: Problem, rejected: Rejected) -> bool:
    """Whether the rejected points may contradict only the given target, so all are tried again.

    A plane may stand elsewhere in the only view; in other views its points would have come back.
    """
    if not len(rejected) or problem.views.n_views > 1:
        return False
    given, _, ids = distinct_points([problem.points])
    return bool(planes_of(given, ids).any())


def _searched(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str
) -> tuple[Solution, Rejected]:
    """Alternate between target and camera as `with_target` does, from the views of one solution."""
    if not views_suffice([solution.problem.points], None, solution.repeated.n_groups):
        return solution, rejected
    kept = solution.noted(target_kept=choice == "auto")
    if choice == "auto" and not _tell_independently(solution):
        return kept, rejected
    common = _found(solution, choice, None)
    found = common if choice == "flat" else _with_bends(solution, common)
    if found is not None and choice == "auto":
        given = solution.problem, solution.adjusted
        if contradicts_sigma(solution) or has_other_cause([given], found, solution.repeated):
            return kept, rejected
    # Bends that do not last when the camera is fitted to them were none.
    for start in dict.fromkeys((found, common)):
        settled = None if start is None else _settled(problem, kept, rejected, options, choice, start)
        if settled is not None:
            return settled
    return kept, rejected


def _settled(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, choice: str, start: Found
) -> tuple[Solution, Rejected] | None:
    """Alternate from a found target until the distortion model stays the same; None if it does not last."""
    best, found = None, start
    for _ in range(_ROUNDS):
        (new, adjusted), *_ = found.fits
        lens, record = new.distortion.model, (solution if best is None else best).record
        # Views that contradicted only the given target have come back, so the record is the latest one.
        at = replace(solution, problem=new, adjusted=adjusted, record=record)
        again = _fitted_to(problem, found.target, at, rejected, options)
        if again is None:
            break
        fitted, outliers = again
        if not _is_where_it_was(found, fitted):
            refound = _found(fitted, choice, found.target)
            if refound is None:
                break
            found = refound
        (new, adjusted), *_ = found.fits
        best = replace(fitted, problem=new, adjusted=adjusted, target=found.target)
        rejected = outliers
        if new.distortion.model == lens:
            break
    return None if best is None else (best, rejected)


def _tell_independently(solution: Solution) -> bool:
    """Whether views with errors of their own, if not all have, show a target of another shape.

    Errors that views share look like errors of the target.
    """
    if not solution.repeated.worth < _WORTH:
        return True
    few = of_few_views(solution, solution.repeated.n_groups)
    fits = [(few.problem, few.adjusted)]
    found = find_shape(fits, "auto", None, solution.model_errors is None)
    return found is not None and not has_other_cause(fits, found)


def _found(solution: Solution, choice: str, known: Target | None) -> Found | None:
    return find_shape([(solution.problem, solution.adjusted)], choice, known, solution.model_errors is None)


def _fitted_to(
    problem: Problem, target: Target, solution: Solution, rejected: Rejected, options: Options
) -> tuple[Solution, Rejected] | None:
    """Fit the camera to a target, with lens and outliers selected again; None if that fails."""
    try:
        if len(rejected):
            seen = problem.with_points(target.seen(problem.points))
            again, rejected = fit_robustly(seen, options, (solution, rejected))
        else:  # the solution has all points, where the target has them
            again = fit_again(solution, solution.problem.points, options, only_from_here=True)
    except DegenerateGeometryError:
        return None
    return again, rejected


def _is_where_it_was(found: Found, again: Solution) -> bool:
    """Whether fitting the camera to the found target left it where it was when the target was found."""
    (problem, adjusted), new = found.fits[0], again.problem
    if problem.views.names != new.views.names or problem.distortion.model != new.distortion.model:
        return False
    if not np.array_equal(problem.points.pixels, new.points.pixels):
        return False
    cost, gained = adjusted.cost.sum(), abs(adjusted.cost.sum() - again.adjusted.cost.sum())
    stays = bool(gained * problem.views.n_equations < _SETTLED**2 * cost)
    return stays and np.array_equal(problem.free_camera, new.free_camera)


def _with_bends(solution: Solution, common: Found | None) -> Found | None:
    """Add a bend to each view if that explains why the views contradict each other.

    If another cause is more probable, the common target stays.
    """
    given = solution.problem, solution.adjusted
    found = _find_bends(given, common)
    if found is None or found.target.bends is None:
        return found
    before, after = given if common is None else common.fits[0], found.fits[0]
    least, flat = variance_of_views(after[0].views, after[1].state), _noise(*before, 0.0)
    bent = _noise(*after, found.target.bends.determined(found.target.bends.coefficients))
    if bent > _NOISE * least and flat - bent < _SHARE * (flat - least):
        return common
    gain = gain_over_given(found, [given]) if common is None else found.evidence - common.evidence
    m = before[0].minimum(before[1], solution.repeated)
    held = contest(m, solution.problem.points.image_size, shaped=common is not None)
    return common if held is not None and held.instead_of_target() > gain else found


def _find_bends(fit: tuple[Problem, Adjusted], common: Found | None) -> Found | None:
    """Estimate the bend of the board in each view, for a camera at its minimum for the given board.

    `common` is the estimated common shape of the board, if there is one. It is returned if the evidence for
    bends is not clear.
    """
    known = None if common is None else common.target
    if not _may_bend(fit[0], known):
        return common
    # The common points and the camera take in some of the bends, with few views most of them, so all are
    # estimated together.
    least = -np.inf if common is None else common.evidence + LEAST_GAIN
    only = Search([fit], False, None, bending=True, still=True).result(LEAST_GAIN, least)
    start = only if common is None else common
    if start is None:
        return None
    both = Search(start.fits, False, start.target, bending=True).result(LEAST_GAIN, least)
    return max(filter(None, (only, both)), key=lambda found: found.evidence, default=common)


def _may_bend(problem: Problem, known: Target | None) -> bool:
    """Whether there are enough views of a single plane, without measured distances.

    `known` is the estimated target, if there is one.
    """
    if not problem.free_poses or problem.views.n_views < DETERMINE or problem.points.distances:
        return False
    if known is not None:
        return is_flat(known.given) and not known.plane.any()
    given, _, ids = distinct_points([problem.points])
    return is_flat(given) and not planes_of(given, ids).any()


def _noise(problem: Problem, adjusted: Adjusted, determined: float) -> float:
    """Residual variance, normalised; `determined` unknowns are counted besides camera and poses."""
    unknowns = int(problem.free_camera.sum()) + 6 * problem.views.n_views + determined
    return float(adjusted.cost.sum()) / max(problem.views.n_equations - unknowns, 1.0)


def _with_survey(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options
) -> tuple[Solution, Rejected]:
    """Adjust camera and surveyed points together; the solution given takes the survey for exact."""
    again, outliers = _surveyed(problem, solution, rejected, options, 1.0)
    factor = 1.0 if again.target is None else again.target.sizes["stated"]
    if factor > 1.0 and len(outliers):  # the survey is worse than stated, so fewer points are outliers
        again, outliers = _surveyed(problem, again, outliers, options, factor)
    return again, outliers


def _surveyed(
    problem: Problem, solution: Solution, rejected: Rejected, options: Options, factor: float
) -> tuple[Solution, Rejected]:
    """Adjust camera and points; outliers are judged by `factor` times the stated standard deviations."""
    points = problem.points
    judged = replace(points, covariance=_with_places(solution, points, factor))
    if len(rejected):
        weighed, rejected = fit_robustly(problem.with_points(judged), options)
        if len(rejected):
            rejected = replace(rejected, points=points.select(rejected.rows))
    else:
        weighed = fit_again(solution, judged, options)
    own = weighed.problem.with_points(points.select(np.delete(np.arange(len(points)), rejected.rows)))
    if not own.free_distortion:
        own = own.with_seen_pixels()
    start = own.adjust(replace(weighed.adjusted, state=normalised(weighed.in_pixels, own.views)))
    found = find_surveyed([(own, start)])
    if found is None:
        return replace(weighed, problem=own, adjusted=start), rejected
    (own, adjusted), *_ = found.fits
    return reweighted(replace(weighed, problem=own, adjusted=adjusted, target=found.target)), rejected


def _with_places(solution: Solution, points: Correspondences, factor: float) -> Array:
    """(N, 3) covariance of the pixels, including the projected survey errors of their points [px^2].

    The level of the pixel noise follows from the median residual by bisection.
    """
    own = np.array([1.0, 0.0, 1.0]) if points.covariance is None else points.covariance
    own = np.broadcast_to(own, (len(points), 3))
    state, view = solution.in_pixels, places_of_views(solution, points)
    in_camera = (state.R[view] @ points.world[..., None])[..., 0] + state.t[view]
    J = solution.camera.project_jacobian(in_camera)[1] @ state.R[view]
    assert points.world_std is not None
    J = J * factor * points.world_std[:, None]
    place = np.stack(
        [(J[:, 0] ** 2).sum(axis=1), (J[:, 0] * J[:, 1]).sum(axis=1), (J[:, 1] ** 2).sum(axis=1)]
    )
    seen, known = predicted_pixels(state, points.world, view)
    known = known & (view >= 0) & np.isfinite(place).all(axis=0)
    r, place = seen[known] - points.pixels[known], place.T[known]

    def level(variance: float) -> float:
        return float(median(squared_whitened(r, variance * own[known] + place))) / MEDIAN**2

    high = float(median(squared_whitened(r, own[known]))) / MEDIAN**2
    low = high * _LEAST_NOISE**2
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if level(middle) > 1.0 else (low, middle)
    covariance = high * own
    covariance[known] += place
    return covariance

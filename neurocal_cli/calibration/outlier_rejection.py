"""Outlier rejection: find outlying points and whole views, leave them out, and report them.

If all residuals look like normal noise, nothing is left out: good data give the same calibration to the last
bit with and without this module. If a cause that all views share explains most of the error, such as a cut
through the image, a point is an outlier only if it is one beside that cause. Otherwise

1. each view's network is trained again robustly (`consensus`); points far from it are left out, and so are
   views whose points do not agree on any network;
2. the rest is calibrated, and views that fit a network of their own but not the common camera are left out
   (`odd_view`);
3. the camera judges every point, including those left out before. Points whose error exceeds the largest
   expected of so many normal errors are left out, and the rest is calibrated again, until nothing changes.

Few points fit better without some of them whether these are wrong or not, up to an exact fit. So where few
equations are left, the evidence decides. For s spare equations with the squared error c, its logarithm is
log Gamma(s / 2) - s / 2 log(pi c), with the noise level integrated out (Jeffreys' prior). Each of k outliers
is anywhere in the image, of area F, and any k of n points may be those: - k log F - log(n over k).
It is asked with the lens of all points first, or k1 where outliers hide that there is one. The lens is
selected again only where that favours outliers.

A large error that agrees with normal noise begins the search as well, because it may hide outliers. They are
left out only if the error falls to less than half without them, which trimming noise does not reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from math import comb, lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.solution import Solution, restarted
from neurocal_cli.adjustment.views import Views, arrange
from neurocal_cli.calibration.calibration import Rejected
from neurocal_cli.calibration.fit import fit, fit_again
from neurocal_cli.calibration.other_causes import contradicts_sigma, odd_view
from neurocal_cli.calibration.point_errors import (
    FLOOR,
    PointErrors,
    largest_expected,
    point_errors,
    rms,
    whitened_errors,
)
from neurocal_cli.calibration.verdict.contest import contest
from neurocal_cli.calibration.verdict.findings import MISFIT, NO_WORSE, TOLD, pixel_spread
from neurocal_cli.calibration.verdict.mistakes import error_of_view, located, why_odd
from neurocal_cli.calibration.verdict.rivals import ANOTHER_LENS, RICHER_LENSES
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.consensus import (
    FEWEST_OF_PLANE,
    Consensus,
    find_consensus,
    find_consensus_through_wide_lens,
)
from neurocal_cli.network.options import Options
from neurocal_cli.network.radial_networks import middle_of_image
from neurocal_cli.observations.board import planes_of
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.observations.target import distinct_points

# Repeated by test_outlier_rejection.py (slow: 200 scenes with a fifth of the points wrong, 105 sets
# with one wrong view; clean data are the same to the last bit with and without) and
# test_wrong_inputs.py.
_ROUGH = 0.005  # of the pixels' spread: an rms error this large may hide any outlier
_PASSES = 12
_LITTLE = 0.05  # share of the points that can change without another minimum being the lowest
_MAJORITY = 0.5  # share of the points that must be left
_LOOKS = 2  # consensus passes through the lens: outliers may still bias the first
_FEW = 30.0  # spare equations below which points are left out only if the evidence favours it
_FEW_EACH = 3.0  # the same for each unknown, as in views of four to twelve points (test_few_views.py)
_FALLS = 0.5  # factor on the rms error without outliers that noise hid; without half of the noise it is 0.55
_BACKWARDS = (0.0, 0.0, -1.0)  # stands for the ray of a pixel that the lens cannot have produced


class _NoConsensusError(DegenerateGeometryError):
    """No view has points that agree on a network."""


@frozen_dataclass(eq=False)
class _Kept:
    """What the search has kept so far."""

    mask: NDArray[np.bool_]  # (N,) which points are kept
    wrong_views: Mapping[str, str]  # left out as a whole, each with the reason


def fit_robustly(
    problem: Problem, options: Options, known: tuple[Solution, Rejected] | None = None
) -> tuple[Solution, Rejected]:
    """Fit a camera, leaving outliers out.

    `known` is the result for the same points on nearly the same target, from which it starts.

    Raises `DegenerateGeometryError` if the points do not determine the camera (the message says why), or if
    at least half of them are outliers.
    """
    if known is not None and len(known[1]):
        before, rejected = known
        kept = _Kept(~np.isin(np.arange(len(problem.points)), rejected.rows), rejected.views)
        start = fit_again(before, problem.points.select(kept.mask), options, only_from_here=True)
        kept, solution = _searched(problem.points, options, kept, start)
        return solution, _rejected(problem.points, kept, solution)
    try:
        first = fit(problem, options, known and known[0])
    except DegenerateGeometryError as failure:
        kept, solution = _searched(problem.points, options, *_agreeing(problem, options, None, failure))
        if solution.spare_equations <= 0:
            raise
        return solution, _rejected(problem.points, kept, solution)
    errors = point_errors(first, problem.points)
    whole = np.ones(len(problem.points), dtype=bool)
    contradicts = not _near(errors, whole, problem.points).all() or odd_view(first) is not None
    # So large errors may hide outliers.
    rough = errors.rms > _ROUGH * pixel_spread(problem.points)
    if not (contradicts or rough):
        return first, Rejected()
    if (found := _with_common_cause(first, options)) is not None:
        kept, solution = found
        return solution.noted(of_all=first), _rejected(problem.points, kept, solution)
    if options.distortion == "auto" and _has_few_spare_equations(first):
        with suppress(DegenerateGeometryError):
            named = first.problem.with_model("k1") if first.state.model == "none" else first.problem
            one_lens = replace(options, distortion=named.distortion.model)
            found = _agreeing(named, one_lens, first, None)
            if not _is_more_probable(*_searched(problem.points, one_lens, *found), first):
                return first, Rejected()
    try:
        kept, solution = _searched(problem.points, options, *_agreeing(problem, options, first, None))
    except _NoConsensusError:  # the networks know less than the camera of all points
        if contradicts or rms(first) > MISFIT * pixel_spread(problem.points):
            raise
        return first, Rejected()
    except DegenerateGeometryError:  # of few points, what agrees best may be less than half
        if rough or not _has_few_spare_equations(first):
            raise
        return first, Rejected()
    if _has_few_spare_equations(solution):
        better = _is_more_probable(kept, solution, first)
    else:
        better = contradicts or rms(solution) < _FALLS * rms(first)
    if not better:
        return first, Rejected()
    return solution.noted(of_all=first), _rejected(problem.points, kept, solution)


def _searched(
    points: Correspondences, options: Options, kept: _Kept, solution: Solution
) -> tuple[_Kept, Solution]:
    """The steps after the first one, from the fit of the points that agree."""
    kept, solution = _without_outlier_views(points, options, kept, solution)
    kept, solution = _all_judged(points, options, kept, solution)
    return _with_fitting_views(points, options, kept, solution)


def _has_few_spare_equations(solution: Solution) -> bool:
    return solution.spare_equations < max(_FEW, _FEW_EACH * solution.problem.n_parameters)


def _is_more_probable(kept: _Kept, solution: Solution, first: Solution) -> bool:
    """Whether the evidence of the fit of the points kept is larger than that of all points."""
    points = first.problem.points
    n, k = len(points), int((~kept.mask).sum())
    if not k:
        return True
    area = float(np.prod(points.image_size or np.ptp(points.pixels, axis=0)))
    gain = _evidence(solution) - k * log(area) - log(comb(n, k)) - _evidence(first)
    return solution.spare_equations > 0 and gain > 0


def _evidence(solution: Solution) -> float:
    """Log evidence of the fit of some points; see the module."""
    half = 0.5 * max(solution.spare_equations, 1e-9)
    floor = (FLOOR * pixel_spread(solution.problem.points)) ** 2
    return lgamma(half) - half * log(pi * (solution.squared_error + floor))


def _is_of(points: Correspondences, view: str) -> NDArray[np.bool_]:
    """(N,) which points are of a view."""
    return points.view_index == points.view_names.index(view)


def _with_common_cause(first: Solution, options: Options) -> tuple[_Kept, Solution] | None:
    """The points that are no outliers beside a cause that all views share, which explains most of the error.

    None without such a cause, or if more than a few points are left out. A lens that is too simple displaces
    points far beyond the linear range: if it was named, no point is an outlier because of it.
    """
    points, solution = first.problem.points, first
    mask = np.ones(len(points), dtype=bool)
    while mask.mean() > 1.0 - _LITTLE:
        some, held = solution.problem.points, contest(solution.minimum, points.image_size)
        common = held if held is not None and held.of_all_views else None
        of_lens = common is not None and common.causes[0].rival in (*RICHER_LENSES, ANOTHER_LENS)
        if of_lens and options.distortion == "auto":
            return None
        if common is None:
            errors = point_errors(solution, some)
        else:
            errors = whitened_errors(common.left * solution.problem.views.pixel_scale, some)
        near = _near(errors, np.ones(len(some), dtype=bool), some)
        if of_lens or near.all():
            if common is None:
                return None
            if solution is not first:
                solution = fit_again(solution, some, options, only_from_here=True)
            return _Kept(mask, {}), solution
        mask[mask] = near
        if len(np.unique(points.view_index[mask])) < points.n_views:
            return None
        solution = restarted(solution, points.select(mask))
    return None


def _near(errors: PointErrors, kept: NDArray[np.bool_], points: Correspondences) -> NDArray[np.bool_]:
    """(N,) which points are nearer to their predictions than the largest error expected."""
    return np.asarray(errors.length < largest_expected(errors, kept, points)[points.view_index])


def _agreeing(
    problem: Problem, options: Options, first: Solution | None, failure: DegenerateGeometryError | None
) -> tuple[_Kept, Solution]:
    """Keep the points that agree with a robust network of their view, and fit the camera to them.

    `first` is the fit of all points, or `failure` the reason why there is none.

    A lens may displace points by more than outliers do. So once it is known, the consensus is repeated on
    rays.
    """
    points = problem.points
    views = arrange(_by_plane(points))
    rng = np.random.default_rng(options.seed)
    consensus = find_consensus(views, rng)
    if options.distortion == "auto" or problem.distortion.wide:
        middle = (middle_of_image(problem) - views.pixel_centre) / views.pixel_scale
        consensus = find_consensus_through_wide_lens(consensus, views, middle, rng)
    kept = _kept_by(consensus, views, points)
    if kept.mask.all():
        if first is None:
            assert failure is not None
            raise failure
        return kept, first
    _refuse_few(points, kept, failure)
    try:
        solution = fit(problem.with_points(points.select(kept.mask)), options)
    except DegenerateGeometryError:
        if failure is not None:
            raise failure from None
        raise
    for _ in range(_LOOKS):
        rays = solution.camera.unproject(points.pixels)
        rays = np.where(np.isfinite(rays), rays, _BACKWARDS)
        again = find_consensus(replace(views, rays=rays if views.order is None else rays[views.order]), rng)
        if again.hopeless.sum() > consensus.hopeless.sum() or not again.looseness < consensus.looseness:
            break
        kept, consensus = _kept_by(again, views, points), again
        solution = fit(problem.with_points(points.select(kept.mask)), options)
    return kept, solution


def _by_plane(points: Correspondences) -> Correspondences:
    """The points, with a view for each plane of a folded target, which may be set up wrongly.

    Views in which a plane has too few points for a search stay whole.
    """
    given, label, ids = distinct_points([points])
    planes, views = planes_of(given, ids)[label], points.view_index
    if not planes.any():
        return points
    first = views * (planes.max() + 1)
    few = np.bincount(first + planes)[first + planes] < FEWEST_OF_PLANE
    whole = np.isin(views, views[few])
    return replace(points, view=np.where(whole, first, first + planes))


def _kept_by(consensus: Consensus, views: Views, points: Correspondences) -> _Kept:
    """The points that agree; views without any of them are wrong."""
    mask = np.empty(len(points), dtype=bool)
    mask[slice(None) if views.order is None else views.order] = (
        consensus.kept & ~consensus.hopeless[views.index]
    )
    left = np.bincount(points.view_index, mask, points.n_views)
    wrong = [points.view_names[view] for view in np.flatnonzero(left == 0)]
    return _Kept(mask, dict.fromkeys(wrong, "its pixels do not match its points"))


def _refuse_few(points: Correspondences, kept: _Kept, failure: DegenerateGeometryError | None = None) -> None:
    """Refuse to calibrate from a minority of the points, with the error of the fit of all of them, if any."""
    share = kept.mask.mean()
    if share > _MAJORITY:
        return
    if failure is not None:
        raise failure
    if len(kept.wrong_views) == points.n_views:
        raise _NoConsensusError(
            "the pixels do not match the points in any view; check that each pixel belongs to its point, "
            "and the order of the columns"
        )
    raise DegenerateGeometryError(
        f"{100 * (1 - share):.0f} % of the points are outliers"
        + (f" ({', '.join(map(repr, kept.wrong_views))} as whole views)" if kept.wrong_views else "")
        + "; check that each pixel belongs to its point, and that all views are of one camera"
    )


def _without_outlier_views(
    points: Correspondences, options: Options, kept: _Kept, solution: Solution
) -> tuple[_Kept, Solution]:
    """Leave out views of another camera, or of another target than their points say, one by one.

    At most a third of the views are left out.
    """
    most = (points.n_views - 1) // 3
    while len(kept.wrong_views) < most and (odd := odd_view(solution)) is not None:
        wrong = {**kept.wrong_views, odd: "it contradicts the camera of the other views"}
        kept = _Kept(kept.mask & ~_is_of(points, odd), wrong)
        solution = fit_again(solution, points.select(kept.mask), options, only_from_here=True)
    return kept, solution


def _all_judged(
    points: Correspondences, options: Options, kept: _Kept, solution: Solution
) -> tuple[_Kept, Solution]:
    """Judge all points, also those left out before, by the camera and fit again, until nothing changes."""
    known = {kept.mask.tobytes()}
    for _ in range(_PASSES):
        last, kept = kept, _judged(points, kept, solution)
        if (kept.mask == last.mask).all():
            break
        _refuse_few(points, kept)
        near = int((last.mask & ~kept.mask).sum()) <= _LITTLE * int(last.mask.sum())
        solution = fit_again(solution, points.select(kept.mask), options, only_from_here=near)
        if kept.mask.tobytes() in known:  # a cycle: a point near the limit is alternately kept and rejected
            break
        known.add(kept.mask.tobytes())
    return kept, solution


def _with_fitting_views(
    points: Correspondences, options: Options, kept: _Kept, solution: Solution
) -> tuple[_Kept, Solution]:
    """Take back the views that fit the final camera: their networks, or an earlier camera, knew less."""
    if not solution.problem.free_poses:  # another pose than the given one is none of them
        return kept, solution
    usual, fitting = rms(solution) ** 2, []
    for name in kept.wrong_views:
        one = points.select(_is_of(points, name))
        chance = 1 + TOLD * np.sqrt(2.0 / max(2 * len(one) - 6, 1))
        if error_of_view(one, solution.camera) ** 2 <= chance * usual:
            fitting.append(name)
    mask = kept.mask | np.isin(points.view_index, [points.view_names.index(name) for name in fitting])
    posed = located(points.select(mask), solution.camera) if fitting else None
    if posed is None:
        return kept, solution
    wrong = {name: why for name, why in kept.wrong_views.items() if name not in fitting}
    start = Solution(solution.problem.with_points(posed.problem.points), posed.adjusted, posed.record)
    try:
        more = fit_again(start, points.select(mask), options, only_from_here=True)
        found = _all_judged(points, options, _Kept(mask, wrong), more)
    except DegenerateGeometryError:
        return kept, solution
    return found if rms(found[1]) <= NO_WORSE * rms(solution) else (kept, solution)


def _judged(points: Correspondences, kept: _Kept, solution: Solution) -> _Kept:
    """Keep the points near their predictions, in views of which these are most."""
    errors, index = point_errors(solution, points), points.view_index
    near = _near(errors, kept.mask, points)
    share = np.bincount(index, near, points.n_views) / np.bincount(index)
    reasons = dict(kept.wrong_views)
    for view in np.flatnonzero(share <= _MAJORITY):
        reasons.setdefault(points.view_names[view], "most of its points are outliers")
    return _Kept(near & (share > _MAJORITY)[index], reasons)


def _rejected(points: Correspondences, kept: _Kept, solution: Solution) -> Rejected:
    """What is left out, each view with a diagnosis, unless wrong sigmas may be why it is."""
    reasons = dict(kept.wrong_views)
    if not contradicts_sigma(solution):
        for name, reason in reasons.items():
            plain = replace(points.select(_is_of(points, name)), covariance=None, across=None)
            posed = solution.problem.free_poses
            reasons[name] = why_odd(plain, solution.camera, rms(solution), reason, posed)
    rows = np.flatnonzero(~kept.mask)
    if not rows.size:
        return Rejected(views=reasons)
    error = point_errors(solution, points).length[rows]
    return Rejected(points.select(rows), np.where(np.isfinite(error), error, np.nan), reasons, rows)

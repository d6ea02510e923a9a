"""Causes of errors on the given target other than its shape: of all views, and of one that is odd.

All views. Wrong stated sigmas and the rivals of the contest (`verdict.rivals`) leave residuals that a target
of another shape explains in part. The more probable one is the cause.

One view of a flat target. Each hypothesis about why it contradicts the camera of the other views changes its
pixels, its world points or its camera. Its pose is then estimated as in a problem of type 3 and adjusted. A
mistake in its rows, another zoom or another image centre is named if its error then matches that of the other
views and its odds beat those of a bent target by the `LEVEL` of all causes: seen from afar, a turned image or
one of another size looks nearly like the same target in another pose. If nothing matches, the view keeps the
reason for which it was left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import NEARBY, Adjusted, adjust
from neurocal_cli.adjustment.board.find import Found, counted_again, gain_over_given, views_for_target
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.free_networks import (
    conditions_on_views,
    free_networks,
    least_of_free_networks,
)
from neurocal_cli.adjustment.problem import Problem, problem_for
from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.fit import fit
from neurocal_cli.calibration.lens_choice.model_selection import richer_lens_is_better
from neurocal_cli.calibration.point_errors import places_of_views, rms
from neurocal_cli.calibration.verdict.contest import Contest, contest
from neurocal_cli.calibration.verdict.effects import BENDS
from neurocal_cli.calibration.verdict.findings import LEVEL, log_odds, pixel_spread
from neurocal_cli.calibration.verdict.noise import stated_noise
from neurocal_cli.calibration.verdict.rival import causes_among
from neurocal_cli.calibration.verdict.rivals import SHAPES
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.errors import NeurocalError
from neurocal_cli.network.options import options_for
from neurocal_cli.observations.points import Correspondences

_TELL_BENDS = 3  # views that tell bent planes from distortion (test_cli_stereo.py)

# Of one view. Repeated by test_outlier_rejection.py (slow: 105 sets with one wrong view, all found; 200 clean
# ones, none blamed) and test_multi_start.py (1000 clean sets under strong distortion, no view blamed).
_FEWEST = 4  # fewest views, so that the others outvote one
OUTLIER = 25.0
"""Least contradiction of an odd view, times that which noise causes, and that of the other views."""
_OWN_STEPS = 60
_HOLDS = 2.0  # times the rms error of the other views
_STARTS = 20
_BLURRED = 0.08  # of the pixels' spread: up to this rms error points are badly measured, not mixed up
_ALIKE = 0.01  # largest relative difference between the scale changes along u and v that a zoom makes
_FOCAL, _CENTRE = (0, 2), (3, 4)  # places among A's entries


def has_other_cause(
    fits: Sequence[tuple[Problem, Adjusted]], found: Found, named_lens: bool, worth: float = 1.0
) -> bool:
    """Whether the errors on the given target have another cause than the shape that was found.

    Each camera is at its minimum for the given target. `worth` is the effective share of the views if they
    repeat poses.
    """
    # One or two views of planes that bend and were set up by hand show distortion as another target.
    n_views = sum(problem.views.n_views for problem, _ in fits)
    if named_lens and n_views < _TELL_BENDS and richer_lens_is_better(found):
        return True
    fits = views_for_target(fits)
    held = [_contest_at(fit, named_lens, worth) for fit in fits]
    # An equation of the contest, which is on the given target, may count less on the found one.
    counted = min(counted_again(found, fits), 1.0)
    others = sum(one.instead_of_target(counted) for one in held if one is not None)
    return others > gain_over_given(found, fits)


def contradicts_sigma(solution: Solution) -> bool:
    """Whether the residuals contradict the stated standard deviations of the pixels."""
    problem, points = solution.problem, solution.problem.points
    if points.covariance is None:
        return False
    predicted, _ = predicted_pixels(solution.in_pixels, points.world, places_of_views(solution, points))
    alike = correlation(problem.views, point_residuals(problem.views, solution.state))
    return any(grade for grade, *_ in stated_noise(points, predicted - points.pixels, alike))


def contest_of(
    solution: Solution, fit: tuple[Problem, Adjusted] | None = None, shaped: bool = False
) -> Contest | None:
    """The contest at a fit, by default that of the solution, whose target's shape was estimated or not."""
    fit = fit or (solution.problem, solution.adjusted)
    return _contest_at(fit, solution.has_named_lens, solution.repeated.worth, shaped)


def _contest_at(
    fit: tuple[Problem, Adjusted], named_lens: bool, worth: float, shaped: bool = False
) -> Contest | None:
    problem, adjusted = fit
    return contest(
        problem.views, adjusted.state, problem.free_camera, problem.free_poses, problem.points.image_size,
        named_lens=named_lens, worth=worth, shaped=shaped,
    )  # fmt: skip


def odd_view(solution: Solution) -> str | None:
    """The view that contradicts the others most, or None if no view is odd.

    Something that differs between views has to be among the causes of the contest, which does not tell how
    much a view spoils. The contradiction of a view is the drop in squared error if it had its own camera, per
    condition that the common camera imposes on it. On real boards, which are not quite flat, every view has
    some tens of that of noise; an odd view has to stand out from the others.
    """
    problem, adjusted = solution.problem, solution.adjusted
    views, free = problem.views, problem.free_of_prior
    if views.n_views < _FEWEST or problem.type == 3 or not problem.free_poses:
        return None
    conditions = conditions_on_views(views, adjusted.state)
    spare = views.equations - 6 - conditions
    if spare.min() <= 0:
        return None

    def against_others(own: Array) -> tuple[Array, float]:
        """The contradictions over the variance of the noise, and this, for such errors of the views alone."""
        variance = float(median(own / spare)) + 1e-24
        return _contradictions(adjusted.normal, free, own) / conditions / variance, variance

    # To first order, so that clean data hardly take time.
    if not against_others(least_of_free_networks(adjusted.normal))[0].max() > OUTLIER:
        return None
    own = free_networks(views, adjusted.state, _OWN_STEPS)
    contradiction, variance = against_others(own)
    view = int(np.argmax(contradiction))
    rest = np.delete(np.arange(views.n_views), view)
    others = adjust(views.subset(rest).batches, adjusted.state.of_views(rest), free, True, _OWN_STEPS)
    left = _contradictions(others.normal, free, own[rest]) / conditions[rest] / variance
    if not contradiction[view] > OUTLIER * max(float(median(left)), 1.0):
        return None
    held = contest_of(solution)
    differs = held is not None and any(one.pattern != "all" for one in held.causes)
    return views.names[view] if differs else None


def _contradictions(normal: Array, free: NDArray[np.bool_], own: Array) -> Array:
    """(V,) drop in squared error if each view had its own camera, whose squared errors are given."""
    q = reduced(normal, free, True)
    with np.errstate(invalid="ignore"):
        spared = q.cost.sum() - q.cost_without_each() - own
    return np.asarray(np.where(np.isfinite(spared), spared, 0.0))


def why_odd(points: Correspondences, camera: Camera, rmse_px: float, otherwise: str) -> str:
    """Explain why one view, of which these are the points, contradicts the others.

    The camera is calibrated from the other views, and `rmse_px` is their rms error [px]. A reason is "its u
    and v are exchanged", for example; it is `otherwise` if no hypothesis fits.
    """
    if not arrange(points).nearly_flat.all() or len(points) < 6:
        return otherwise
    limit, plain = _HOLDS * rmse_px, _posed(points, camera)
    mistakes = [(reason, error_of_view(changed, camera), scale) for reason, changed, scale in _mended(points)]
    if plain is None:
        return next((reason for reason, error, _ in mistakes if error < limit), otherwise)
    own = rms(plain)

    def odds(error: float, unknowns: int = 0) -> float:
        """Errors below the other views' do not count."""
        before, after = (max(one, rmse_px) ** 2 for one in (own, error))
        return log_odds(before, after, 2 * len(points) - 6, unknowns) if np.isfinite(error) else -np.inf

    # A turned image needs no unknowns, so it is more probable than a crop that looks the same by chance.
    known = [(error, odds(error / scale), reason) for reason, error, scale in mistakes]
    (zoomed, a), (moved, b) = (_with_free(plain, some) for some in (_FOCAL, _CENTRE))
    times = a[[0, 2]] / np.array(camera.entries)[[0, 2]]
    if abs(times[0] / times[1] - 1) < _ALIKE:
        how = f"it fits another zoom or focus: a focal length of {a[0]:.5g} px"
        known.append((zoomed, odds(zoomed, 2), how))
    how = f"it fits another camera or crop: the image centre ({b[3]:.0f}, {b[4]:.0f})"
    known.append((moved, odds(moved, 2), how))
    shapes = causes_among(SHAPES, plain.problem, plain.state)
    bent = own * float(np.sqrt(1.0 - max((one.explained for one in shapes), default=0.0)))
    least = LEVEL + max(odds(bent, len(BENDS)), 0.0)
    likely = [(evidence, reason) for error, evidence, reason in known if error < limit and evidence > least]
    if likely:
        return max(likely)[1]
    free, _ = _with_free(plain, (*_FOCAL, *_CENTRE))
    if free > _BLURRED * pixel_spread(points):
        return otherwise
    if own < _HOLDS * free:
        ratio = f"{own / rmse_px:.2g} times that of the others"
        return f"its rms error is {own:.2g} px, {ratio}: blurred, or bent"
    return "its points do not lie as in the other views: another target, a bent one, or another lens"


def error_of_view(points: Correspondences, camera: Camera) -> float:
    """Rms error [px] of one view's points with their pose fitted; infinite if that fails."""
    posed = _posed(replace(points, covariance=None, across=None), camera)
    return np.inf if posed is None else rms(posed)


def _mended(points: Correspondences) -> Iterator[tuple[str, Correspondences, float]]:
    """Mistakes in a view's rows, each with the rows mended, and the size of a given pixel in these."""
    pixels, world = points.pixels, points.world
    yield "its u and v are exchanged", replace(points, pixels=pixels[:, ::-1]), 1.0
    if points.image_size is not None:
        yield (
            "its image is turned by 180 degrees against the others",
            replace(points, pixels=np.array(points.image_size) - 1 - pixels),
            1.0,
        )
    for scale, name in ((2.0, "half"), (0.5, "twice")):
        yield f"its image is of {name} the size", replace(points, pixels=(pixels + 0.5) * scale - 0.5), scale
    for factors, name in (([2.0, 1.0], "u"), ([1.0, 2.0], "v")):
        stretched = replace(points, pixels=pixels * factors)
        yield f"its {name} is of half resolution, as in interlaced images", stretched, float(np.sqrt(2))
    for shift in (1, -1):
        shifted = replace(points, world=np.roll(world, shift, axis=0))
        yield "its rows are shifted by one against its pixels", shifted, 1.0


def _posed(points: Correspondences, camera: Camera) -> Solution | None:
    """The view's pose with the camera; None if it cannot be estimated."""
    try:
        problem = problem_for(points, 3, intrinsics=camera.intrinsics, distortion=camera.distortion)
        return fit(problem, options_for("lm", _STARTS, 0))
    except NeurocalError:  # a camera that cannot have seen these pixels is no explanation
        return None


def _with_free(plain: Solution, free: tuple[int, ...]) -> tuple[float, Array]:
    """The rms error [px], and the entries (5,) of A [px], with some of them free; infinite if that fails."""
    problem, views = plain.problem, plain.problem.views
    moving = np.isin(np.arange(len(problem.free_camera)), free)
    try:
        adjusted = adjust(views.batches, plain.state, moving, True, NEARBY)
    except (np.linalg.LinAlgError, FloatingPointError):
        return np.inf, np.full(5, np.nan)
    rmse = float(np.sqrt(adjusted.cost.sum() / len(problem.points))) * views.pixel_scale
    entries = views.pixel_scale * adjusted.state.entries[0] + np.array([0, 0, 0, *views.pixel_centre])
    return rmse if np.isfinite(rmse) else np.inf, entries

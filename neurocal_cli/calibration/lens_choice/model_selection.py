"""``--distortion auto``: select the simplest distortion model that the data support, and lens with target.

The models from `none` to `rational` and the fisheye are fitted, each starting from a simpler one. The
Bayesian information criterion (Schwarz 1978) decides, n log E + p log n, where n is the effective number of
residuals: it accounts for the correlation of neighbours and for views that repeat a pose (`repeated_poses`).

Excluded are models that did not converge, have too few points, or are not monotonic (`monotonic_fit`). Models
whose coefficients are strongly correlated must lower the cross-validation error over several views by 5 %.
Models of wide lenses (`WIDE`) are candidates only if points lie far from the axis and the criterion decidedly
favours them over all ordinary models, because near the axis all lenses are alike.

Lens with target. Distortion and a bent board leave similar residuals, so both are selected together. Starting
from the lens selected for the given target, the next richer model is tried as long as it raises the evidence
enough. If none does, the next simpler one is tried as long as it hardly lowers it.
"""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.find import Found, find_target
from neurocal_cli.adjustment.cross_validation import FOLDS, held_out_views
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses, repeated_poses
from neurocal_cli.adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import Views
from neurocal_cli.calibration.lens_choice.candidate_models import (
    Candidate,
    falls_short,
    fit_candidates,
    judged_again,
    worth,
)
from neurocal_cli.calibration.lens_choice.given_model import (
    DECISIVE,
    LOWER,
    WRONG_LENS,
    Starts,
    may_lead_lower,
)
from neurocal_cli.calibration.lens_choice.monotonic_fit import TIE
from neurocal_cli.calibration.verdict.findings import LEVEL, NO_WORSE
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.distortion import MODELS, POLYNOMIAL_MODELS
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.target import Target

# Repeated by test_model_selection.py (slow: 200 lenses of each of six models; the true one in 85 to
# 99 %, never more than two coefficients too many, 1 % of the best error on new views) and
# test_rendered_sets.py.
# "Decidedly better" means by this number of standard errors over the five folds, and by a factor.
_CERTAIN = 2.0
_FAR_BETTER = 1.25  # factor by which a decentred wide lens must lower the rms error of ordinary ones
_MOST_ORDINARY = 5  # coefficients of an ordinary lens; a rational model with eight also fits wide lenses
_SIMPLER = -1.0  # least gain in log evidence for a simpler model
# Nested models: each has the coefficients of the previous one and more.
_PLACES = {model: place for place, model in enumerate(POLYNOMIAL_MODELS)}


def select_model(
    solution: Solution, more_starts: Starts | None = None, preferred: str = "", determined: bool = False
) -> Solution:
    """Fit all models, starting from a solution with any of them, and select one.

    `more_starts` are tried in case the first one leads to a local minimum. The `preferred` model is selected
    unless another predicts decidedly better. If it is to be `determined`, models whose coefficients the
    points do not determine are selected only if there is no other. The result has the cross-validation errors
    of all fitted models.
    """
    problem, views = solution.problem, solution.problem.views
    by_views = _views_can_spare_any(solution)
    fitted = fit_candidates(problem, solution.state, by_views)
    if more_starts is not None:
        fitted = _with_other_starts(fitted, solution, more_starts, by_views)
    if not fitted:  # not even the pinhole converged
        return replace(solution, model_errors={})
    fitted = {model: fitted[model] for model in MODELS if model in fitted}  # the simplest first
    closest = min(fitted.values(), key=lambda c: c.cost).adjusted.state
    repeated = repeated_poses(views, closest, point_residuals(views, closest))
    if not repeated.none:
        by_views = _views_can_spare_any(solution, repeated)
        fitted = judged_again(fitted, by_views, repeated) or fitted
    told = {model: c for model, c in fitted.items() if c.determined} if determined else {}
    name, good = _best(told or fitted, views, repeated)
    chosen = fitted[preferred if preferred in good else name]
    n, px = len(views.index), views.pixel_scale
    iterations = solution.adjusted.iterations + chosen.adjusted.iterations
    return replace(
        solution,
        problem=chosen.problem,
        adjusted=replace(chosen.adjusted, iterations=iterations),
        model_errors={name: float(np.sqrt(c.held_out / n)) * px for name, c in fitted.items()},
    )


def _with_other_starts(
    fitted: dict[str, Candidate], solution: Solution, more_starts: Starts, by_views: bool
) -> dict[str, Candidate]:
    """Fit from other starts if the present fits may be local minima; the best of all fits of each model."""
    limit = _limit(fitted)
    if limit == 0:
        return fitted
    closest = min(fitted.values(), key=lambda c: c.cost)
    whole = replace(solution, problem=closest.problem, adjusted=closest.adjusted)
    if np.isfinite(limit) and not may_lead_lower(whole, limit / closest.cost, more_starts):
        return fitted
    for start in more_starts(solution.problem):
        others = fit_candidates(solution.problem, start, by_views)
        if min((c.cost for c in others.values()), default=np.inf) < limit:
            better = {m: c for m, c in others.items() if m not in fitted or c.cost < fitted[m].cost}
            fitted = fitted | better
        if (limit := _limit(fitted)) == 0:
            break
    return fitted


def _limit(fitted: dict[str, Candidate]) -> float:
    """Squared error below which the result of another start is accepted; 0: no other start is needed.

    It is infinite if free networks fit far better, no model is sound, or only wide lenses are found and leave
    more than noise. If a focal length is poorly determined, another start must be better.
    """
    closest = min(fitted.values(), key=lambda c: c.cost)
    if closest.problem.distortion.wide and not any(
        fitted[m].sound for m in POLYNOMIAL_MODELS[1:] if m in fitted
    ):
        views = closest.problem.views
        if correlation(views, point_residuals(views, closest.adjusted.state)) > WRONG_LENS:
            return np.inf
    if not any(c.sound for c in fitted.values()) or falls_short(fitted.values()):
        return np.inf
    return LOWER * closest.cost if closest.weak else 0.0


def _views_can_spare_any(solution: Solution, repeated: RepeatedPoses | None = None) -> bool:
    """Whether the views determine the camera without any of them, so that views can be held out."""
    problem, adjusted = solution.problem, solution.adjusted
    if problem.views.n_views == 1 or not problem.free_camera.any():
        return False
    return bool(np.isfinite(held_out_views(problem.minimum(adjusted, repeated))).all())


def _best(
    fitted: dict[str, Candidate], views: Views, repeated: RepeatedPoses
) -> tuple[str, AbstractSet[str]]:
    """The model with the lowest criterion, and all that no other one predicts decidedly better than.

    Simpler ones that are far less probable are not among the latter.
    """
    eligible = _eligible(fitted, views.n_views > 1)
    n = worth(views, eligible.values()) * repeated.worth
    sound = _eligible(_without_wide(fitted, n), views.n_views > 1)
    finite = {name: candidate for name, candidate in sound.items() if np.isfinite(candidate.lost).all()}
    if not finite:
        return next(iter(sound)), set()  # cross-validation is impossible, so the simplest
    name = min(finite, key=lambda name: finite[name].criterion(n))
    chosen, best = finite[name], min(finite.values(), key=lambda c: c.held_out)
    good = {
        other
        for other, candidate in eligible.items()
        if np.isfinite(candidate.lost).all()
        and (
            candidate.coefficients > chosen.coefficients
            or candidate.criterion(n) < chosen.criterion(n) + DECISIVE
        )
        and not predicts_decidedly_better(best.lost, candidate.lost, repeated, NO_WORSE)
    }
    return name, good


def _without_wide(fitted: dict[str, Candidate], n: float) -> dict[str, Candidate]:
    """Exclude models of wide lenses if ordinary ones are nearly as good, even ones that are not sound.

    Where no ordinary lens determines the focal length, a wide one does so by its formula, not by the points:
    parallel boards near and far look alike. So there it has to be far better.
    """
    ordinary = [c for name, c in fitted.items() if name not in WIDE and c.coefficients <= _MOST_ORDINARY]
    ordinary = [c for c in ordinary if c.not_monotonic is None and np.isfinite(c.lost).all()]
    if not ordinary:
        return fitted
    lowest, least = min(c.criterion(n) for c in ordinary), min(c.held_out for c in ordinary)
    kept = {
        name: c
        for name, c in fitted.items()
        if name not in WIDE or (c.criterion(n) < lowest - DECISIVE and c.held_out <= (1 + 2 * TIE) * least)
    }
    far = min(c.cost for c in ordinary) / _FAR_BETTER**2
    if not any(c.determined for c in ordinary):
        kept = {name: c for name, c in kept.items() if name not in WIDE or c.cost < far}
    # Ordinary lenses may be decentred as well.
    return {name: c for name, c in kept.items() if name != "omnidir" or "fisheye" in kept or c.cost < far}


def predicts_decidedly_better(lost: Array, others: Array, repeated: RepeatedPoses, enough: float) -> bool:
    """Whether a fit predicts held-out data better than another by a given factor, and significantly.

    `lost` and `others` are the squared errors of each part of the data when it is held out, `enough` the
    least ratio of the other's rms error to this one's. The significance is that of the mean log ratio over
    the folds, so that no single fold dominates.
    """
    by_fold = [np.maximum(_by_fold(array, repeated), 1e-300) for array in (lost, others)]
    if not by_fold[1].sum() > enough**2 * by_fold[0].sum():
        return False
    ratio = np.log(by_fold[1] / by_fold[0])
    return bool(ratio.sum() > _CERTAIN * np.sqrt(len(ratio)) * ratio.std())


def _by_fold(lost: Array, repeated: RepeatedPoses) -> Array:
    """Sum the held-out errors of views or parts of points by fold."""
    if len(lost) == len(repeated.group):
        return np.asarray(np.bincount(repeated.folds(FOLDS), lost))
    if len(lost) <= FOLDS:
        return lost
    return np.array([lost[fold::FOLDS].sum() for fold in range(FOLDS)])


def _eligible(fitted: dict[str, Candidate], several: bool) -> dict[str, Candidate]:
    """Sound models; the other monotonic ones as well if they predict much better.

    A single view cannot tell that, because errors of the target are common to all of its folds. Nor can views
    if a focal length is given: large coefficients that cancel each other take in that it is wrong.
    """
    monotonic = {
        name: c
        for name, c in fitted.items()
        if c.not_monotonic is None and not (c.noise and c.problem.fixed & {"alpha_u", "alpha_v"})
    } or fitted
    sound = {name: c for name, c in monotonic.items() if c.sound}
    if not sound or not several:
        return sound or monotonic
    lowest = [min(c.held_out for c in some.values()) for some in (sound, monotonic)]
    return sound if lowest[0] < NO_WORSE**2 * lowest[1] else monotonic


def find_lens_and_target(
    fits: Sequence[tuple[Problem, Adjusted]],
    flat: bool = False,
    known: Target | None = None,
    least_gain: float = -np.inf,
) -> Found | None:
    """Estimate the positions of the target's points and select the distortion model; see `find_target`."""
    best = find_target(fits, flat, known, least_gain)
    if best is None:
        return None
    for step, least in ((1, LEVEL), (-1, _SIMPLER)):
        moved = False
        while (other := with_other_lens(best, step, flat, best.evidence + least)) is not None:
            best, moved = other, True
        if moved:
            break
    return best


def with_other_lens(found: Found, step: int, flat: bool, least: float) -> Found | None:
    """Estimate the target with every camera's next distortion model, by a step of 1 or -1 coefficients.

    None at the end of the chain, or if the log evidence is not larger than `least`.
    """
    fits = []
    for problem, adjusted in found.fits:
        place = _PLACES.get(adjusted.state.model, -2) + step
        if not 0 <= place < len(POLYNOMIAL_MODELS) or problem.type == 3:
            return None
        other = problem.with_model(POLYNOMIAL_MODELS[place])
        fits.append((other, other.adjust(adjusted.state.with_model(POLYNOMIAL_MODELS[place]))))
    return find_target(fits, flat, found.target, least=least)

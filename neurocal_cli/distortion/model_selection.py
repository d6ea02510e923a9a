"""``auto``: the simplest lens model that the data supports.

Every model is fitted, each from the one before it. A model's held-out error decides: five folds of
the views, or of the points of a single view. Models whose held-out rms error is within 0.9 % of the
lowest are as good as each other; so are those within what chance does to five folds, for a single view
or where the criterion is decidedly for them. Among them the Bayesian information criterion (Schwarz
1978) chooses, n log E + p log n, n being what the number of residuals is worth when neighbours are
alike; no model with more than two coefficients beyond what it alone would choose takes part. Neither do
models that did not settle, that there are too few points for, or that fold the image back and cannot
do without (`unfolding`), and models whose coefficients are noise only where their error over several
views is 5 % below that of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.bundle_adjustment.cross_validation import FOLDS, held_out_views
from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import correlation, point_residuals
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import MODELS
from neurocal_cli.distortion.candidate_models import Candidate, falls_short, fit_candidates, worth
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["LensChoice", "choose_lens"]

_TIE = 0.009  # of the rms error
_FAR_WORSE = 2.0  # times the rms error of a model that folds back
_WORTH = 1.05  # times the rms error: what coefficients that cancel each other must be better by
_CHANCE = 4.6  # standard errors, of five folds, that chance exceeds in one case of a hundred
_MORE = 2  # coefficients
_DECISIVE = 10.0  # of the criterion: odds of 150
_ALIKE = 0.3  # correlation of neighbours' residuals
_MUCH_BETTER = 0.8  # times the squared error
_FAR_BELOW = 2.0  # times the squared error of the pinhole


@dataclass(frozen=True)
class LensChoice:
    """What `auto` chose, and from what.

    Attributes
    ----------
    job : Job
        With the model that was chosen.
    solution : Solution
    held_out_px : dict of float by model [px]
        Rms error on data left out; of the models that could be fitted.
    refusal : str
        Why there is no answer, if so.
    """

    job: Job
    solution: Solution
    held_out_px: dict[str, float]
    refusal: str = ""


def choose_lens(
    job: Job,
    solution: Solution,
    points: Correspondences,
    more_starts: Callable[[], Iterable[CameraState]] = tuple,
) -> LensChoice:
    """Fit all models, from a solution with any of them, and choose.

    Parameters
    ----------
    job : Job
    solution : Solution
    points : Correspondences
    more_starts : callable
        Other states to begin with, where the first leads to nothing that explains the points.

    Returns
    -------
    LensChoice
        With a refusal where the lens bends strongly, and what fits folds back inside the image.
    """
    views, by_views = job.views, _views_can_spare_any(job, solution)
    fitted = fit_candidates(job, solution.adjusted.state, points, by_views)
    limit = _limit(views, fitted)
    if limit > 0:
        for start in more_starts():
            _join(fitted, fit_candidates(job, start, points, by_views), limit)
    if not fitted:  # not even the pinhole settled: as it is
        return LensChoice(job, solution, {})
    fitted = {model: fitted[model] for model in MODELS if model in fitted}  # the simplest first
    if "none" in fitted and not fitted["none"].determined and _is_enough(fitted["none"], views, fitted):
        fitted = {"none": fitted["none"]}  # a lens would only hide that the points leave the camera open
    chosen = fitted[_best(fitted, views)]
    job.tally.refinements += chosen.adjusted.iterations
    n, px = len(views.index), views.pixel_scale
    table = {name: float(np.sqrt(c.lost.sum() / n)) * px for name, c in fitted.items()}
    adjusted = Solution(chosen.adjusted, job.tally)
    job = replace(job, known=chosen.known, restraint=chosen.restraint)
    return LensChoice(job, adjusted, table, _refusal(fitted, chosen))


def _limit(views: Views, fitted: dict[str, Candidate]) -> float:
    """Squared error below which what another start leads to is of interest; 0: no start is.

    Where every view by itself fits far better, any is; where neighbours err alike, as they do on a board that
    is not flat too, one that explains much more.
    """
    if not fitted or falls_short(views, fitted.values()):
        return np.inf
    closest = min(fitted.values(), key=lambda c: c.cost)
    alike = correlation(views, point_residuals(views, closest.adjusted.state)) > _ALIKE
    return _MUCH_BETTER * closest.cost if alike else 0.0


def _join(fitted: dict[str, Candidate], others: dict[str, Candidate], limit: float) -> None:
    """Take over what fits better, if any of the others is below the limit."""
    if min((c.cost for c in others.values()), default=np.inf) >= limit:
        return
    for model, candidate in others.items():
        if model not in fitted or candidate.cost < fitted[model].cost:
            fitted[model] = candidate


def _views_can_spare_any(job: Job, solution: Solution) -> bool:
    known, adjusted = job.known, solution.adjusted
    if job.views.n_views == 1 or not known.free_camera.any():
        return False
    free = known.free_camera if adjusted.state.lens == known.lens.model else known.free
    return bool(np.isfinite(held_out_views(adjusted.normal, free, known.free_poses)).all())


def _is_enough(pinhole: Candidate, views: Views, fitted: dict[str, Candidate]) -> bool:
    """Whether neither a lens nor a camera for each view explains far more."""
    lowest = min(candidate.cost for candidate in fitted.values())
    return pinhole.cost <= _FAR_BELOW * lowest + 1e-20 and not falls_short(views, [pinhole])


def _best(fitted: dict[str, Candidate], views: Views) -> str:
    """Of the models whose held-out error is as low as any, the one with the lowest criterion.

    What is held out may ask for two coefficients more than the criterion does, but not for more: a few
    folds tell the better of two models, but among many models one is better than it should be by chance.
    """
    sound = _eligible(fitted, views.n_views > 1)
    n = worth(views, sound.values())
    criterion = {name: candidate.criterion(n) for name, candidate in sound.items()}
    most = sound[min(criterion, key=lambda name: criterion[name])].coefficients + _MORE
    pool = {
        name: candidate
        for name, candidate in sound.items()
        if candidate.coefficients <= most and np.isfinite(candidate.lost).all()
    }
    if not pool:
        return next(iter(sound))  # the simplest: nothing can be left out
    best = min(pool, key=lambda name: _lost(pool[name]))
    tied = []
    for name, candidate in pool.items():
        excess = _by_fold(candidate.lost - pool[best].lost)
        chance = _CHANCE * np.sqrt(len(excess)) * excess.std()
        # Folds of views tell models apart, unless all the data are decidedly of another opinion.
        close = views.n_views == 1 or criterion[name] < criterion[best] - _DECISIVE
        if excess.sum() <= max(2 * _TIE * _lost(pool[best]), chance if close else 0.0):
            tied.append(name)
    return min(tied, key=lambda name: criterion[name])


def _lost(candidate: Candidate) -> float:
    return float(candidate.lost.sum())


def _by_fold(lost: Array) -> Array:
    """Sums of what each view or fold of points has lost, of those that were left out together."""
    if len(lost) <= FOLDS:
        return lost
    return np.array([lost[fold::FOLDS].sum() for fold in range(FOLDS)])


def _eligible(fitted: dict[str, Candidate], several: bool) -> dict[str, Candidate]:
    """Sound models; the others too when they alone predict, which a single view cannot tell.

    What is wrong with the target is alike in all the folds of one view.
    """
    fit_monotonic = {name: c for name, c in fitted.items() if c.folds is None} or fitted
    sound = {name: c for name, c in fit_monotonic.items() if c.sound}
    if not sound or not several:
        return sound or fit_monotonic
    lowest = [min(float(c.lost.sum()) for c in some.values()) for some in (sound, fit_monotonic)]
    return sound if lowest[0] < _WORTH**2 * lowest[1] else fit_monotonic


def _refusal(fitted: dict[str, Candidate], chosen: Candidate) -> str:
    """Say so where a simpler model was taken only because the one that fits folds back."""
    for model, candidate in fitted.items():
        folds = candidate.folds is not None and not candidate.noise
        if folds and chosen.lost.sum() > _FAR_WORSE**2 * candidate.lost.sum():
            return (
                f"the lens bends strongly, and the distortion {model} that fits the points folds back inside "
                f"the {candidate.folds}; give points nearer to the image's corners, or choose a --distortion"
            )
    return ""

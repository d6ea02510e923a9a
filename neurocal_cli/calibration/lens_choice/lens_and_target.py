"""Select distortion model and target together: distortion and a bent board leave similar residuals.

Starting from the lens selected for the given target, the next richer model is tried as long as it raises the
evidence enough. If none does, the next simpler one is tried as long as it hardly lowers it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.board.find import Found, evidence_of_views, find_target, views_for_target
from neurocal_cli.adjustment.open_coefficients import log_prior, radius
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import camera_columns, normal_blocks
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS, coefficient_names
from neurocal_cli.observations.target import Target

# Nested models: each has the coefficients of the previous one and more.
_RICHER = 4.0  # least gain in log evidence for a richer model: odds of about fifty
_SIMPLER = -1.0  # and for a simpler one
_PLACES = {model: place for place, model in enumerate(POLYNOMIAL_MODELS)}


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
    for step, least in ((1, _RICHER), (-1, _SIMPLER)):
        moved = False
        while (other := _with_other_lens(best, step, flat, best.evidence + least)) is not None:
            best, moved = other, True
        if moved:
            break
    return best


def _with_other_lens(found: Found, step: int, flat: bool, least: float) -> Found | None:
    """Estimate the target with every camera's next distortion model.

    None at the end of the chain, or if the log evidence is not larger than `least`.
    """
    fits = []
    for problem, adjusted in found.fits:
        place = _PLACES.get(adjusted.state.model, -2) + step
        if not 0 <= place < len(POLYNOMIAL_MODELS) or problem.type == 3:
            return None
        fits.append(_adjusted_with(problem, adjusted, POLYNOMIAL_MODELS[place]))
    return find_target(fits, flat, found.target, least=least)


def richer_lens_is_better(found: Found) -> bool:
    """Whether one more distortion coefficient, with another target, explains the data decidedly better."""
    return _with_other_lens(found, 1, found.target.flat, found.evidence + _RICHER) is not None


def named_lens_is_too_simple(fits: Sequence[tuple[Problem, Adjusted]], found: Found) -> bool:
    """Whether more distortion coefficients and the given target fit better than the found target.

    Each camera is at its minimum for the given target, and `found` has the same lenses.
    """
    fits, end = views_for_target(fits), len(POLYNOMIAL_MODELS)
    places = [_PLACES.get(a.state.model, end) if problem.free[0] else end for problem, a in fits]
    if min(places) >= end - 1:
        return False
    least = 0.5 * (evidence_of_views(fits) + found.evidence)
    richest = [
        _linearised_with(*fit, POLYNOMIAL_MODELS[-1]) if own < end else fit
        for fit, own in zip(fits, places, strict=True)
    ]
    for place in range(min(places) + 1, end):
        model = POLYNOMIAL_MODELS[place]
        richer = [
            _without_last(*linearised, model) if own < place else fit
            for fit, linearised, own in zip(fits, richest, places, strict=True)
        ]
        # A linear prediction that reaches less than half of the found target's gain settles it.
        if not evidence_of_views(richer) + _log_prior_of_added(fits, richer) > least:
            continue
        richer = [
            _adjusted_with(*fit, model) if own < place else fit for fit, own in zip(fits, places, strict=True)
        ]
        if evidence_of_views(richer) + _log_prior_of_added(fits, richer) > found.evidence:
            return True
    return False


def _log_prior_of_added(
    fits: Sequence[tuple[Problem, Adjusted]], richer: Sequence[tuple[Problem, Adjusted]]
) -> float:
    return sum(
        log_prior(after.state, len(before.state.k), radius(problem.views, before.state))
        for (_, before), (problem, after) in zip(fits, richer, strict=True)
    )


def _adjusted_with(problem: Problem, adjusted: Adjusted, model: str) -> tuple[Problem, Adjusted]:
    new = problem.with_model(model)
    return new, new.adjust(adjusted.state.with_model(model))


def _linearised_with(problem: Problem, adjusted: Adjusted, model: str) -> tuple[Problem, Adjusted]:
    state = adjusted.state.with_model(model)
    normal, _ = normal_blocks(problem.views.batches, state)
    return problem.with_model(model), replace(adjusted, state=state, normal=normal)


def _without_last(problem: Problem, adjusted: Adjusted, model: str) -> tuple[Problem, Adjusted]:
    """A simpler model's linearisation from that of a richer one, whose last coefficients are left out."""
    n = len(coefficient_names(model))
    kept = np.append(np.arange(camera_columns(n)[-1] + 1), -1)
    state = replace(adjusted.state, model=model, k=adjusted.state.k[:n])
    normal = adjusted.normal[:, kept[:, None], kept]
    return problem.with_model(model), replace(adjusted, state=state, normal=normal)

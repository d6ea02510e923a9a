"""The simplest distortion model that explains the points as well as one that the user named.

A model with many coefficients, of which the points determine only some, may fold the image back or not
converge. A simpler model that explains the same points shows that this is the cause.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.calibration.lens_choice.monotonic_fit import folds_back
from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import POLYNOMIAL_MODELS

_STEPS = 60


def undetermined_coefficients(problem: Problem, adjusted: Adjusted) -> str:
    """Say that the points do not determine the coefficients of the named model; empty if they may.

    `adjusted` is the best fit of `problem`, which estimates these coefficients.
    """
    simpler = _that_suffices(problem, adjusted)
    if not simpler:
        return ""
    other = "a camera without distortion" if simpler == "none" else simpler
    return (
        f"the points do not determine the coefficients of the distortion model {adjusted.state.model}, as "
        f"{other} explains them as well; choose --distortion {simpler} or auto, or give points nearer to the "
        "image's corners"
    )


def _that_suffices(problem: Problem, adjusted: Adjusted) -> str:
    """The simplest monotonic model that is better by the Bayesian information criterion; empty if none is."""
    state, views = adjusted.state, problem.views
    alike = correlation(views, point_residuals(views, state))
    n, cost = effective_number(views.n_equations, alike), float(adjusted.cost.sum())
    entries = state.entries.copy()
    if state.model in WITH_XI:
        entries[:, :3] /= 1.0 + state.k[0]  # the scale in the middle of the image
    pinhole = replace(state, model="none", k=np.zeros(0), entries=entries)
    for model in POLYNOMIAL_MODELS:
        start = pinhole.with_model(model)
        more = len(state.k) - len(start.k)
        if more <= 0:
            continue
        simpler = problem.with_model(model)
        found = simpler.adjust(start, _STEPS)
        as_well = n * np.log(float(found.cost.sum()) / max(cost, 1e-300)) < more * np.log(n)
        if as_well and folds_back(simpler, found.state) is None:
            return model
    return ""

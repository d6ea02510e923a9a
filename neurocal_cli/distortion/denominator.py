"""k4, k5 and k6 of a thin-prism or tilted lens: estimated only if the points support them.

In OpenCV they are optional (CALIB_RATIONAL_MODEL). In an ordinary lens they are nearly degenerate with k1, k2
and k3. So they stay 0 unless the Bayesian information criterion decidedly favours them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.distortion.monotonic_fit import folds_back

DENOMINATOR = frozenset({"k4", "k5", "k6"})
_STEPS = 150  # many, because the coefficients are nearly degenerate
# Repeated by tests/test_prism_and_tilt.py (slow): 100 lenses without a denominator and with one.
_DECISIVE = 10.0  # difference of the criterion: odds of 150


def with_denominator_if_supported(solution: Solution) -> Solution:
    """Add k4, k5 and k6 if that explains decidedly more, or if the model is not monotonic without them."""
    problem, views = solution.problem, solution.problem.views
    if views.n_equations - problem.n_parameters < 2 * len(DENOMINATOR):
        return solution
    richer = replace(problem, fixed=problem.fixed - DENOMINATOR)
    found = richer.adjust(solution.adjusted, _STEPS)
    alike = correlation(views, point_residuals(views, found.state))
    n = effective_number(views.n_equations, alike)
    before, after = (max(float(a.cost.sum()), 1e-300) for a in (solution.adjusted, found))
    told = n * np.log(before / after) > len(DENOMINATOR) * np.log(n) + _DECISIVE
    better = told and folds_back(problem, found.state) is None
    if not better and folds_back(problem, solution.state) is None:
        return solution
    return replace(solution, problem=richer, adjusted=found)

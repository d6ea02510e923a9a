"""k4, k5 and k6 of a lens with a prism or a tilted sensor: estimated only where the points tell them.

In OpenCV they are a choice of their own (CALIB_RATIONAL_MODEL): beside an ordinary lens's k1, k2 and k3 they
all but compensate each other. So they stay 0 unless the Bayesian information criterion is decidedly for them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.distortion.monotonic_fit import folds_back

DENOMINATOR = frozenset({"k4", "k5", "k6"})
_STEPS = 150  # the coefficients all but compensate each other
# Repeated by tests/test_prism_and_tilt.py (slow): 100 lenses without a denominator and with one.
_DECISIVE = 10.0  # of the criterion: odds of 150


def with_denominator_if_told(solution: Solution) -> Solution:
    """The solution with k4, k5 and k6 too, if that explains decidedly more, or nothing else is monotonic."""
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

"""Whether the points show that the image axes are not at right angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.residual_correlation import correlation, effective_number, point_residuals
from neurocal_cli.adjustment.solution import Solution

_SKEW = 1  # place of A12 among A's entries
_LEVEL = 6.0  # log odds, as of any cause of errors


def shows_skew(solution: Solution) -> bool:
    """Whether theta, which the solution holds at 90 degrees, has evidence: log odds above six.

    The log odds of one more unknown are n/2 log(c / c') - log(n)/2, for squared errors c and c' without and
    with it, and n independent equations, fewer where neighbouring residuals are alike.
    """
    problem = solution.problem
    free = problem.free.copy()
    free[_SKEW] = True
    skewed = replace(problem, free=free, fixed=problem.fixed - {"theta"})
    cost, with_it = float(solution.adjusted.cost.sum()), float(skewed.adjust(solution.adjusted).cost.sum())
    if not 0 < with_it < cost:
        return False
    alike = correlation(problem.views, point_residuals(problem.views, solution.state))
    n = effective_number(max(problem.views.n_equations - skewed.n_parameters, 1.0), alike)
    return bool(0.5 * n * np.log(cost / with_it) - 0.5 * np.log(n) > _LEVEL)

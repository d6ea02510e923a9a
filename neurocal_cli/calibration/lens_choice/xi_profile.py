"""Profile likelihood of xi: all local minima of models with xi, and the weight of each value of xi.

In a unified or double-sphere model xi is strongly correlated with the other parameters, so several values of
xi may fit about equally well; near xi = 0 a double sphere depends only on the square of xi. So each xi of a
grid is tried, starting from the most similar lens, with all other parameters adjusted. The lowest minimum is
the result. If others are nearly as low, the grid is refined until the weight of each value is known
(`Ambiguity`). The prior is uniform in the logarithm of the scale; that of xi and of the relative change of
the radius by k1, k2, p1 and p2 of omnidir has the spread of published cameras.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from neurocal_cli.adjustment.adjust import Adjusted
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.normal_equations import ROUNDING, unit_diagonal
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import farthest_angle
from neurocal_cli.adjustment.solution import Ambiguity, Solution
from neurocal_cli.calibration.lens_choice.given_model import total_cost
from neurocal_cli.camera.directions import WITH_XI, xi_is_flat
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.nearest_camera import similar_states
from neurocal_cli.camera.state import CameraState

# Repeated by test_wide_lenses.py (slow: a thousand cameras): all at the lowest minimum, their errors
# as large as their standard deviations.
_GRID = {"omnidir": np.linspace(0.0, 3.0, 31), "double_sphere": np.linspace(-0.6, 1.0, 33)}
_SAME = 1e-6
_STEPS = 30
_NEAR = 1e4  # largest excess of chi^2 over the best from which a lower minimum may still be reached
_POSSIBLE = 25.0  # largest excess of chi^2 over the best of a possible camera
_AS_A_PARABOLA = 0.6  # largest deviation of the profile from a parabola, in standard deviations
_LARGEST_MASS = 0.08  # largest share of the probability in one interval of xi
_MOST = 60  # most values of xi
# A dozen published omnidir cameras have xi from 0.7 to 2.6: the prior is uniform over the grid. Their k1, k2
# and p1, p2 change the farthest radius by shares of -0.19 to 0.05, -0.04 to 0.22 and up to 0.0013. Here are
# the powers of the radius, and the prior std of these shares. Seven published double spheres have xi from
# -0.27 to 0.18.
_POWERS, _SHARES = np.array([2, 4, 1, 1]), np.array([0.15, 0.1, 0.0015, 0.0015])
_SIZE_OF_XI = 0.25  # prior std of xi of a double sphere


def with_xi_held_if_flat(problem: Problem, adjusted: Adjusted) -> tuple[Problem, Adjusted]:
    """Fix xi of a double sphere at 0 if it is nearly 0, because then nothing depends on it to first order."""
    state = adjusted.state
    if not xi_is_flat(state.model, state.k):
        return problem, adjusted
    problem = replace(problem, fixed=problem.fixed | {"xi"})
    return problem, problem.adjust(replace(adjusted, state=replace(state, k=state.k * [0.0, 1.0])))


def with_all_minima(solution: Solution) -> Solution:
    """The lowest minimum of a lens with xi, with its ambiguity; solutions of other models are unchanged."""
    problem = solution.problem
    if problem.distortion.model not in WITH_XI or not problem.free_distortion:
        return solution
    problem = replace(problem, fixed=problem.fixed - {"xi"})
    freedom = problem.views.n_equations - problem.n_parameters
    variance = max(total_cost(solution.adjusted), 1e-300) / max(freedom, 1)
    profile, at_the_end = _Profile(problem, solution.adjusted, variance, []).on_grid().descended()
    best, ambiguity = profile.best, profile.ambiguity()
    if best is solution.adjusted:
        return replace(solution, ambiguity=ambiguity)
    if any(best is one for one in at_the_end):
        problem = profile.held
    else:
        problem, best = with_xi_held_if_flat(problem, best)
    return replace(solution, problem=problem, adjusted=best, ambiguity=ambiguity)


@frozen_dataclass(eq=False)
class _Profile:
    """Cameras with given xi and all other parameters adjusted, and the best camera of any xi."""

    problem: Problem  # with free xi
    best: Adjusted
    variance: float  # of the residuals
    tried: list[Adjusted]  # with given xi, in its order

    @cached_property
    def held(self) -> Problem:
        """The problem with given xi."""
        return replace(self.problem, fixed=self.problem.fixed | {"xi"})

    def on_grid(self) -> _Profile:
        """Try each xi of the grid."""
        views, state, grid = self.problem.views, self.best.state, _GRID[self.problem.distortion.model]
        starts = similar_states(state, state.model, farthest_angle(views, state), grid)
        tried = (self.held.adjust(start, _STEPS) for start in starts)
        return replace(self, tried=[a for a in tried if a.converged and _is_lens(a)])

    def descended(self) -> tuple[_Profile, list[Adjusted]]:
        """Descend from the lowest points of the grid to the minima.

        If the lowest valley leads out of the model's range, the last cameras within it count as minima. They
        are the second result, with given xi.
        """
        costs = [np.inf, *map(total_cost, self.tried), np.inf]
        minima = []
        for n, start in enumerate(self.tried):
            if costs[n + 1] > min(costs[n], costs[n + 2]) or self._excess(start) > _NEAR:
                continue
            found = self.problem.adjust(start)
            if found.converged and _is_lens(found):
                minima.append(found)
        if _is_lens(self.best):
            minima.append(self.best)
        lowest = min((total_cost(a) for a in minima), default=np.inf)
        at_the_end = [a for a in self.tried if total_cost(a) < (1 - _SAME) * lowest]
        minima = [*minima, *at_the_end] or [self.best]
        best = min(minima, key=total_cost)
        return replace(self, best=best, tried=_merged(self.tried, minima)), at_the_end

    def _excess(self, adjusted: Adjusted) -> float:
        """Excess of chi^2 over the best camera."""
        return float(adjusted.cost.sum() - self.best.cost.sum()) / self.variance

    def ambiguity(self) -> Ambiguity | None:
        """The ambiguity; None if the covariance at the best minimum describes all possible cameras."""
        if self._is_parabola():
            return None
        tried = self.tried
        while len(tried) < _MOST:
            logarithm = np.array([self._volume(a) - 0.5 * self._excess(a) for a in tried])
            weights = np.exp(logarithm - logarithm.max())
            xi = np.array([_xi(a) for a in tried])
            mass = np.diff(xi) * np.maximum(weights[1:], weights[:-1])
            n = int(np.argmax(mass))
            if mass[n] <= _LARGEST_MASS * mass.sum():
                break
            side = tried[n + int(weights[n + 1] > weights[n])]
            between = self.held.adjust(_moved(side.state, 0.5 * (xi[n] + xi[n + 1])), _STEPS)
            tried = _merged(tried, [between])
        centre = _camera(self.best.state)
        return Ambiguity(
            np.array([_xi(a) for a in tried]),
            np.array([_camera(a.state) - centre for a in tried]),
            np.array([self._excess(a) for a in tried]),
            np.array([self._volume(a) for a in tried]),
        )

    def _volume(self, adjusted: Adjusted) -> float:
        """Log posterior volume around a camera with fixed xi (Laplace approximation), up to a constant."""
        state, free = adjusted.state, self.held.free_camera
        S = reduced(adjusted.normal, free, self.held.free_poses).S.sum(axis=0) / self.variance
        known = _known(state, farthest_angle(self.held.views, state))
        share = 0.5 * (np.log(known[known > 0]).sum() - (known * state.k**2).sum())
        scaled, scale = unit_diagonal(S + np.diag(np.concatenate([np.zeros(5), known])[free]))
        width = np.log(scale).sum() - 0.5 * np.linalg.slogdet(scaled + ROUNDING * np.eye(len(S)))[1]
        return float(share + width - free[:3].sum() * np.log(state.entries[0, 0]))

    def _is_parabola(self) -> bool:
        """Whether the profile over all possible xi agrees with the covariance at the best minimum."""
        problem, best = self.problem, self.best
        free = problem.free_camera
        cov = problem.minimum(best).covariance(problem.views.n_equations)
        variance = float(cov.shared[int(free[:5].sum()), int(free[:5].sum())])
        if not variance > 0 or not cov.smallest > 1e-12:
            return False
        for one in self.tried:
            expected = abs(_xi(one) - _xi(best)) / np.sqrt(variance)
            found = np.sqrt(max(self._excess(one), 0))
            possible = min(expected, found) < np.sqrt(_POSSIBLE)
            if possible and abs(expected - found) > _AS_A_PARABOLA * max(1.0, 0.3 * expected):
                return False
        return True


def _merged(tried: list[Adjusted], more: list[Adjusted]) -> list[Adjusted]:
    """Cameras in the order of xi, one for each value."""
    known = sorted([*tried, *more], key=_xi)
    return known[:1] + [b for a, b in pairwise(known) if _xi(b) - _xi(a) > _SAME]


def _known(state: CameraState, farthest: float) -> Array:
    """(K,) prior inverse variances of the coefficients; 0 for a uniform prior."""
    if state.model == "double_sphere":
        return np.array([_SIZE_OF_XI**-2, 0.0])
    radius = np.sin(farthest) / (np.cos(farthest) + state.k[0])
    return np.concatenate([[0.0], (radius**_POWERS / _SHARES) ** 2])


def _is_lens(adjusted: Adjusted) -> bool:
    """Whether the coefficients are in the model's range; a double sphere needs alpha from 0 to 1."""
    state = adjusted.state
    low, high = _GRID[state.model][[0, -1]]
    return bool(low <= state.k[0] <= high and (state.model != "double_sphere" or 0 <= state.k[1] <= 1))


def _xi(adjusted: Adjusted) -> float:
    return float(adjusted.state.k[0])


def _camera(state: CameraState) -> Array:
    return np.concatenate([state.entries[0], state.k])


def _moved(state: CameraState, xi: float) -> CameraState:
    """Change xi, keeping the scale in the image centre."""
    entries, k = state.entries.copy(), state.k.copy()
    entries[:, :3] *= (1 + xi) / (1 + k[0])
    k[0] = xi
    return replace(state, entries=entries, k=k)

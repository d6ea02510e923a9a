"""The Levenberg-Marquardt solver of the package, independent of cameras.

Around a state p the sum of squares is approximately E(p + d) = c - 2 g.d + d.H d, with H = J^T J and
g = J^T r. Far from the minimum this model holds only near p, so each step is damped (Marquardt 1963):

    (H + lambda D) d = g,  D = diag H.

This is a Gauss-Newton step for small lambda and a short gradient step for large lambda. Its predicted gain is
2 g.d - d.H d = d.(g + lambda D d). The ratio of the actual to the predicted gain tells how well the model
holds and controls lambda (Nielsen 1999; Madsen, Nielsen and Tingleff 2004, section 3.2):

    rho = (E(p) - E(p + d)) / (2 g.d - d.H d)
    a step that lowers E is accepted:  lambda <- lambda max(shrink, 1 - (2 rho - 1)^3),  nu <- 2
    any other is rejected:             lambda <- lambda nu,                              nu <- 2 nu

Nielsen's smallest factor is 1/3. Here it is an option, because starts near the minimum can drop the damping
quickly. 2 rho - 1 is limited to 2, because the model does not hold either if a step gains far more than
predicted.

Near the minimum the gains shrink by a constant factor or faster, so two of them foretell the next. The
descent ends with a step whose own gain is negligible, or after which the next one certainly is.

Groups are independent problems solved side by side. They share no unknowns; each has its own lambda and its
own end. A single problem is one group.

Marquardt, An algorithm for least-squares estimation of nonlinear parameters, J. SIAM 11 (1963).
Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05, DTU (1999).
Madsen, Nielsen, Tingleff, Methods for non-linear least squares problems, 2nd ed., IMM, DTU (2004).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

# Share of a negligible gain that the next gain may be foretold to reach. test_adjust.py takes one more
# step from where descents end.
_FORETOLD = 0.1

Step = TypeVar("Step")
Trial = TypeVar("Trial")


class LeastSquaresProblem(Protocol[Step, Trial]):
    """Interface of a problem with G groups, each a sum of squares with its current state.

    `active` (A,) are the groups that still descend, in ascending order; the others must stay unchanged. All
    arrays hold only these groups. A problem of one group may ignore it.
    """

    @property
    def cost(self) -> Array:
        """(G,) sums of squares at the start."""
        ...

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Step, Array]:
        """Damped step from the current state, and its predicted gain (A,)."""
        ...

    def move(self, step: Step, active: NDArray[np.intp]) -> tuple[Trial, Array, NDArray[np.bool_]]:
        """Try a step: the trial, its cost (A,), and whether it is a valid state (A,)."""
        ...

    def accept(self, trial: Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial in the groups (A,) that improved, and linearise there."""
        ...


@frozen_dataclass
class DescentOptions:
    """Damping and stopping criteria."""

    damping: float = 1e-4  # initial lambda
    shrink: float = 0.01  # smallest factor of lambda after an accepted step
    # Whether that factor follows rho. Otherwise it is `shrink` after every accepted step, as in Marquardt's
    # paper: bolder, for many random starts of which some may fail.
    by_ratio: bool = True
    least_damping: float = 1e-14  # lower limit of lambda
    largest_damping: float = 1e10  # lambda above which the descent counts as stuck
    tolerance: float = 1e-9  # converged when an accepted step gains less than this share of the cost
    negligible: float = 0.0  # likewise as an absolute gain, added to that share
    # Whether this gain is the predicted or the actual one. Near the minimum both are equal. Far from it, a
    # small actual gain may be accidental, and a small predicted gain a saddle point.
    by_promise: bool = True
    # The minimum is reached when a rejected step had predicted a gain of less than this share of the cost: it
    # failed by rounding only.
    flat: float = 1e-6
    max_iterations: int = 200


class Stop(IntEnum):
    """How the descent of a group ended."""

    LIMIT = 0  # limit of iterations
    STUCK = 1  # no step of any length lowers the sum of squares
    CONVERGED = 2  # the last step had a negligible gain
    FLAT = 3  # the last step had a negligible predicted gain and failed
    EXACT = 4  # the remaining sum of squares is rounding


@frozen_dataclass(eq=False)
class Outcome:
    """How the descent of each group ended; the problem holds the state itself."""

    iterations: NDArray[np.int64]  # (G,) number of steps tried
    stop: NDArray[np.int8]  # (G,) values of `Stop`

    @property
    def settled(self) -> NDArray[np.bool_]:
        """(G,) whether each group reached a minimum."""
        return np.asarray(self.stop >= Stop.CONVERGED)


def minimise(
    problem: LeastSquaresProblem[Any, Any], options: DescentOptions | None = None, floor: float | Array = 0.0
) -> Outcome:
    """Descend in all groups until each has stopped; the problem is then at its minimum.

    `floor`, a number or (G,), is the cost that rounding alone can cause.
    """
    descent = LevenbergMarquardt(problem, options or DescentOptions(), floor)
    descent.run()
    return descent.outcome


class LevenbergMarquardt:
    """The descent step by step, for callers that act between steps.

    `limit` (G,) are the iterations of each group, instead of the options' `max_iterations`; `floor` is as for
    `minimise`. `active` (A,) are the groups that still descend, `cost` and `damping` (A,) are theirs, and
    `outcome` is that of the groups that have stopped.
    """

    def __init__(
        self,
        problem: LeastSquaresProblem[Any, Any],
        options: DescentOptions,
        floor: float | Array = 0.0,
        limit: NDArray[np.int64] | None = None,
    ) -> None:
        self.problem, self.options, self.cost = problem, options, problem.cost.copy()
        G = len(self.cost)
        self.active = np.arange(G)
        self.damping, self.growth = np.full(G, options.damping), np.full(G, 2.0)
        self.gain = np.full(G, np.nan)  # of the last step, nan if it failed
        self.floor = np.zeros(G) + floor
        self.limit = np.full(G, options.max_iterations) if limit is None else limit
        self.soonest = int(self.limit.min(initial=options.max_iterations))  # first iteration at a limit
        self.iteration = 0
        self.outcome = Outcome(np.zeros(G, dtype=np.int64), np.zeros(G, dtype=np.int8))
        exact, out = self.cost <= self.floor, self.limit <= 0
        if exact.any() or out.any():
            self._retire(exact | out, np.where(exact, Stop.EXACT, Stop.LIMIT).astype(np.int8))

    def run(self) -> None:
        """Step until every group has stopped."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            while self.active.size:
                self.step()

    def step(self) -> None:
        """Try one step in each active group, and accept it where it lowers the cost."""
        problem, options, active, before = self.problem, self.options, self.active, self.cost
        step, promised = problem.solve(self.damping, active)
        trial, after, sensible = problem.move(step, active)
        better = sensible & (after < before)
        problem.accept(trial, better, active)
        del trial, step  # frees large arrays before the next ones are allocated
        self.iteration += 1
        gained = before - after
        factor: float | Array = options.shrink
        if options.by_ratio:
            excess = np.minimum(2 * (gained / promised) - 1, 2.0)
            factor = np.maximum(factor, 1 - excess * excess * excess)
        failed = not better.all()
        if failed:
            factor = np.where(better, factor, self.growth)
            after = np.where(better, after, before)
        self.damping = np.maximum(self.damping * factor, options.least_damping)
        self.growth = np.where(better, 2.0, 2 * self.growth)
        self.cost = after
        exact = self.cost <= self.floor
        negligible = options.tolerance * before + options.negligible
        gain = promised if options.by_promise else gained
        next_gain = gain * (gain / self.gain)  # nan after a failed step
        converged = better & ((gain < negligible) | (next_gain < _FORETOLD * negligible))
        self.gain = np.where(better, gain, np.nan) if failed else gain
        done = exact | converged
        if self.iteration >= self.soonest:
            done |= self.limit <= self.iteration
        if failed:
            flat = ~better & sensible & (np.abs(promised) < options.flat * before)
            stuck = ~better & (self.damping > options.largest_damping)
            done |= flat | stuck
        if done.any():
            stop = np.zeros(len(done), dtype=np.int8)
            if failed:
                stop[stuck], stop[flat] = Stop.STUCK, Stop.FLAT
            stop[converged], stop[exact] = Stop.CONVERGED, Stop.EXACT
            self._retire(done, stop)

    def renew(self) -> None:
        """Read the costs again after the problem has changed; all groups must be active.

        Damping above its initial value is reset.
        """
        self.cost = self.problem.cost.copy()
        self.damping = np.minimum(self.damping, self.options.damping)
        self.growth, self.gain = np.full(len(self.cost), 2.0), np.full(len(self.cost), np.nan)

    def _retire(self, done: NDArray[np.bool_], stop: NDArray[np.int8]) -> None:
        """Record the groups that have stopped, and remove them from the active ones."""
        ended, going = self.active[done], ~done
        self.outcome.iterations[ended], self.outcome.stop[ended] = self.iteration, stop[done]
        self.active, self.cost, self.floor = self.active[going], self.cost[going], self.floor[going]
        self.damping, self.growth = self.damping[going], self.growth[going]
        self.limit, self.gain = self.limit[going], self.gain[going]

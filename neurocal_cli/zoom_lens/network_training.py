"""Training of one parameter's networks on targets: least squares with Bayesian regularisation.

    E = 1/2 sum_s (y(x_s) - d_s)^2 / (c_s + tau^2) + 1/2 sum_g a_g |w_g|^2

Each kind of weights has a zero-mean prior of its own, whose precision follows from the effective
number of its weights, gamma_g = n_g - a_g tr_g A^-1 and a_g = gamma_g / |w_g|^2 (MacKay 1992;
Foresee and Hagan 1997): the data decide how much network they need. c_s is a target's variance and
tau^2 a scatter from setting to setting beyond it, which is 0 unless the networks cannot follow.
The evidence compares starts and topologies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.levenberg_marquardt import DescentOptions, LevenbergMarquardt
from neurocal_cli.zoom_lens.mlfn import Topology, respond_with_jacobian

__all__ = ["Schedule", "Trained", "followed", "prior_precision", "sparse_controls", "train"]

_FLAT = 1e-4  # precision of the weights that are free: a std of 100 spreads of the targets
_MOST = 1e4  # precision of a prior
_LEAST, _LEAST_SPARSE, _LEAST_TILT = 0.03, 1.0, 1.0
_ENOUGH_VALUES = 4
# A network never stops by itself: its priors follow the data until the schedule ends.
_OPTIONS = DescentOptions(
    damping=1e-2, shrink=0.2, least_damping=1e-10, largest_damping=np.inf,
    tolerance=0.0, flat=0.0, max_iterations=1_000_000,
)  # fmt: skip


@dataclass(frozen=True)
class Schedule:
    """How long to train.

    Parameters
    ----------
    iterations : int
    warm : int
        Iterations before the priors begin to follow the data.
    settle : int
        Iterations before a scatter is allowed for.
    period : int
        Iterations from one update of the priors to the next.
    """

    iterations: int = 300
    warm: int = 40
    settle: int = 160
    period: int = 4


@dataclass(frozen=True, eq=False)
class Trained:
    """A stack of trained networks.

    Attributes
    ----------
    topology : Topology
    weights : (B, P) array
    precision : (B, G) array
        Of each kind of weights' prior.
    scatter : (B,) array
        tau^2, in squared units of the targets.
    evidence : (B,) array
        Logarithm of the probability of the targets, up to a constant that all topologies share.
    """

    topology: Topology
    weights: Array
    precision: Array
    scatter: Array
    evidence: Array


def sparse_controls(x: Array) -> NDArray[np.bool_]:
    """(D,) which controls have too few different values in the settings (S, D) to tell how they bend."""
    return np.array([len(np.unique(column)) < _ENOUGH_VALUES for column in x.T])


def followed(effective: Array, squares: Array, x: Array) -> Array:
    """Precision that MacKay's rule gives each prior (..., G), within limits.

    Data that leave a direction open do not shrink weights along it. So priors stay narrower than 6
    standard units; and those of weights from a control of three values than 1, or a unit could turn
    between two of them, seen by nobody; and that of the bows' weights a, as tanh(a) reaches no farther.
    It stays as wide where a control has three values, which tell a bow but not its tilt.
    """
    D, sparse = x.shape[1], sparse_controls(x)
    least, most = np.full(effective.shape[-1], _LEAST), np.full(effective.shape[-1], _MOST)
    least[2 : 2 + D][sparse] = _LEAST_SPARSE
    least[6 + D] = _LEAST_TILT
    if sparse.any():
        most[6 + D] = _LEAST_TILT
    return np.clip(effective / squares, least, most)


def prior_precision(topology: Topology, precision: Array) -> Array:
    """Precision of each weight's prior, (..., G) -> (..., P)."""
    group = topology.groups
    return np.where(group < 0, _FLAT, np.asarray(precision)[..., np.maximum(group, 0)])


def train(
    topology: Topology,
    x: Array,
    targets: Array,
    variance: Array,
    weights: Array,
    schedule: Schedule | None = None,
    include: NDArray[np.bool_] | None = None,
    precision: Array | None = None,
    scatter: Array | None = None,
) -> Trained:
    """Train a stack of networks, all at once.

    Parameters
    ----------
    topology : Topology
    x : (n, D) array
        Controls, scaled to about [-1, 1].
    targets : (n,) array
        Centred and scaled to a spread of about 1.
    variance : (n,) array
        Of the targets; 0 where unknown, the scatter then tells the noise.
    weights : (B, P) array
        To start from.
    schedule : Schedule, optional
    include : (B, n) bool array, optional
        Which settings each network sees; default all.
    precision, scatter : (B, G), (B,) arrays, optional
        Priors to begin with; where given with a schedule whose `warm` is never reached, to keep.
    """
    learner = _Learner(topology, x, targets, variance, weights, include)
    learner.begin(precision, scatter)
    schedule = schedule or Schedule()
    descent = LevenbergMarquardt(learner, _OPTIONS, floor=-1.0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for iteration in range(schedule.iterations):
            if iteration >= schedule.warm and iteration % schedule.period == 0:
                learner.follow(allow_scatter=iteration >= schedule.settle)
                descent.renew()
            descent.step()
    return learner.result()


_Trial = tuple[Array, Array, Array, Array]  # weights, outputs, their derivatives, the cost


class _Learner:
    """A stack in training, as `least_squares` sees it: each network is a group of cost 2 E."""

    def __init__(
        self,
        topology: Topology,
        x: Array,
        targets: Array,
        variance: Array,
        weights: Array,
        include: NDArray[np.bool_] | None,
    ) -> None:
        self.topology, self.x, self.targets, self.variance = topology, x, targets, variance
        self.w = weights
        B, n = len(weights), len(x)
        self.include = np.ones((B, n)) if include is None else include.astype(float)
        self.count = self.include.sum(axis=1)
        self.kinds = (topology.groups[None] == np.arange(topology.n_groups)[:, None]).astype(float)
        self.sizes = self.kinds.sum(axis=1)
        self.diagonal = range(topology.n_weights)

    def begin(self, precision: Array | None, scatter: Array | None) -> None:
        B = len(self.w)
        self.a = np.full((B, self.topology.n_groups), 0.3) if precision is None else precision
        # Of targets without a variance, a thousandth of their spread until the noise is told.
        unknown = 1e-6 if not self.variance.any() else 0.0
        self.tau2 = np.full(B, unknown) if scatter is None else scatter
        self.y, self.J = respond_with_jacobian(self.topology, self.w, self.x)
        self._weigh()

    def _weigh(self) -> None:
        """Take over new priors and scatter."""
        self.prior = prior_precision(self.topology, self.a)
        self.weight = self.include / (self.variance + self.tau2[:, None])
        self.cost = self._cost(self.w, self.y)

    def _cost(self, w: Array, y: Array) -> Array:
        return (self.weight * (y - self.targets) ** 2).sum(axis=1) + (self.prior * w * w).sum(axis=1)

    def _normal(self) -> Array:
        A = (np.swapaxes(self.J, 1, 2) * self.weight[:, None]) @ self.J
        A[:, self.diagonal, self.diagonal] += self.prior
        return A

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step of each network's weights, and what it promises."""
        pull = (self.weight * (self.targets - self.y))[:, None] @ self.J
        downhill = pull[:, 0] - self.prior * self.w
        A = self._normal()
        ridge = damping[:, None] * np.diagonal(A, axis1=1, axis2=2)
        A[:, self.diagonal, self.diagonal] += ridge
        # Regular by the priors, so not scaled.
        step = np.asarray(np.linalg.solve(A, downhill[..., None])[..., 0], dtype=float)
        return step, (step * (downhill + ridge * step)).sum(axis=1)

    def move(self, step: Array, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """The networks after a step; any weights are sensible."""
        w = self.w + step
        y, J = respond_with_jacobian(self.topology, w, self.x)
        cost = self._cost(w, y)
        return (w, y, J, cost), cost, np.ones(len(w), dtype=bool)

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Take over the networks that became better."""
        w, y, J, cost = trial
        self.w = np.where(better[:, None], w, self.w)
        self.y = np.where(better[:, None], y, self.y)
        self.J = np.where(better[:, None, None], J, self.J)
        self.cost = np.where(better, cost, self.cost)

    def follow(self, allow_scatter: bool) -> None:
        """Let the priors, and the scatter, follow the data; half the way on a logarithmic scale."""
        leverage = np.diagonal(np.linalg.inv(self._normal()), axis1=1, axis2=2)
        effective = np.maximum(self.sizes - self.a * (leverage @ self.kinds.T), 1e-3)
        squares = np.maximum((self.w * self.w) @ self.kinds.T, 1e-12)
        self.a = np.sqrt(self.a * followed(effective, squares, self.x))
        if allow_scatter:
            gamma = self.topology.n_weights - (self.prior * leverage).sum(axis=1)
            self._follow_scatter(np.maximum(self.count - gamma, 0.05 * self.count))
        self._weigh()

    def _follow_scatter(self, freedom: Array) -> None:
        """tau^2 for which the squared errors are as large as expected; 0 if they are small already."""
        squares = self.include * (self.y - self.targets) ** 2
        total = self.variance + self.tau2[:, None]
        ratio = (squares / total).sum(axis=1) / freedom
        known = self.variance.any()
        least = 1e-4 * float(np.median(self.variance)) if known else 1e-8
        seed = np.where(self.tau2 > 0, self.tau2, np.median(self.variance) * np.maximum(ratio - 1, 0))
        self.tau2 = seed * np.clip(ratio, 0.1, 10.0)
        self.tau2 = np.where(self.tau2 < least, 0.0 if known else least, self.tau2)

    def result(self) -> Trained:
        sign, volume = np.linalg.slogdet(self._normal())
        volume = np.where(sign > 0, volume, np.inf)
        log_prior = 0.5 * np.log(self.prior).sum(axis=1)
        noise = (self.include * np.log(self.variance + self.tau2[:, None])).sum(axis=1)
        # Mirror images of the weights are not counted: an idle unit has none, and would count as many.
        evidence = -0.5 * self.cost - 0.5 * volume + log_prior - 0.5 * noise
        return Trained(
            self.topology, self.w, self.a, self.tau2, np.where(np.isfinite(evidence), evidence, -np.inf)
        )

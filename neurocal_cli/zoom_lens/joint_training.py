"""Step 3: all networks and the constants together, on the reprojection error over all settings.

    E = sum_s |r_s(p(x_s; w), q)|^2 / (2 sigma^2) + 1/2 sum_g a_g |w_g|^2

with p the networks' outputs at setting s, which are weights of the calibrating net there, and q the
constants. All weights move at once. A setting enters through its normal matrix (`quadratic_error`), so a
step costs a millisecond; the matrices are renewed until nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.levenberg_marquardt import DescentOptions
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.network_training import followed
from neurocal_cli.zoom_lens.parameter_networks import LensNets
from neurocal_cli.zoom_lens.quadratic_error import QuadraticError, gauss_newton, loosened
from neurocal_cli.zoom_lens.setting_normals import Constants, Normal, PixelData

__all__ = ["NEARLY", "Joint", "JointLearner", "posterior", "train_joint"]

_ROUNDS = 16  # of normal matrices
_SETTLED = 0.5  # of 2 E, a quarter of a standard deviation: a round that gains less is the last
NEARLY = 1e-3  # share of 2 E: what gains less than this in the last round has converged
# On one set of matrices. A step that gains less than 0.02 of 2 E, a seventh of a standard deviation, is
# the last.
_OPTIONS = DescentOptions(
    damping=1e-4, shrink=0.1, least_damping=1e-12, largest_damping=1e8,
    tolerance=0.0, negligible=0.02, by_promise=False, flat=0.0, max_iterations=25,
)  # fmt: skip
_FIRST = 4  # rounds in which the priors follow the data


@dataclass(frozen=True, eq=False)
class Joint:
    """A lens that has learnt.

    Attributes
    ----------
    nets : LensNets
    constants : Constants
    cost : float
        Sum of squared residuals over sigma^2, plus the priors' part: 2 E.
    covariance : (P + Q, P + Q) array
        Of all weights and the constants.
    evidence : float
        Logarithm of the probability of the data, up to a constant.
    converged : bool
    """

    nets: LensNets
    constants: Constants
    cost: float
    covariance: Array
    evidence: float
    converged: bool


def train_joint(
    data: PixelData,
    x: Array,
    nets: LensNets,
    constants: Constants,
    variance: float,
    scatter: Array,
    report: Callable[[float], None] | None = None,
) -> Joint:
    """Minimise E from networks that were fitted one at a time.

    Parameters
    ----------
    data : PixelData
    x : (S, D) array
        Scaled controls of the settings.
    nets : LensNets
    constants : Constants
    variance : float [px^2]
        Of the noise of one coordinate.
    scatter : (L,) array
        Variance of each local parameter from setting to setting.
    """
    learner = JointLearner(data, x, nets, constants, variance, scatter)
    converged = False
    for round_ in range(_ROUNDS):
        if report is not None:
            report(round_ / _ROUNDS)
        before = learner.linearise()
        if round_ < _FIRST:
            learner.follow_priors()
        after = learner.descend()
        converged = before - after < NEARLY * after
        if before - after < _SETTLED and round_ >= _FIRST:
            break
    learner.linearise()
    return learner.result(converged)


class JointLearner:
    """The state of a lens that learns: its networks, its constants and the settings' normal matrices."""

    def __init__(
        self, data: PixelData, x: Array, nets: LensNets, constants: Constants, variance: float, scatter: Array
    ) -> None:
        self.data, self.x, self.variance, self.scatter = data, x, variance, scatter
        self.nets, self.constants = nets, constants

    def linearise(self) -> float:
        """Renew the normal matrices where the networks are; 2 E."""
        self.reference = self.nets.local(self.x)
        normal, self.constants = self.data.linearise(self.reference, self.constants)
        self.normal = loosened(normal, self.scatter, self.variance)
        self.error = QuadraticError(self.x, self.reference, self.normal, self.variance)
        self.shared = np.zeros(self.data.n_shared)
        return self.cost(self.nets, self.shared)

    def cost(self, nets: LensNets, shared: Array) -> float:
        """2 E on the present normal matrices, the constants a step `shared` from where they were."""
        return self.error.cost(nets, shared)

    def system(self) -> tuple[Array, Array]:
        """Gauss-Newton matrix and downhill direction of E over all weights and the constants."""
        return self.error.system(self.nets, self.shared)

    def descend(self) -> float:
        """Levenberg-Marquardt on the present normal matrices; 2 E at the end."""
        nets, shared, cost = self.error.minimum(self.nets, self.shared, _OPTIONS)
        self.accept(nets, shared)
        return cost

    def accept(self, nets: LensNets, shared: Array) -> None:
        """Take over networks and a step of the constants."""
        self.nets, self.constants = nets, self.constants.moved(shared)

    def follow_priors(self) -> None:
        """Let the priors follow the data: MacKay's rule, half the way on a logarithmic scale."""
        N, _ = self.system()
        leverage = np.diagonal(_inverse(N))
        nets, start = [], 0
        for net in self.nets.nets:
            P, group = net.topology.n_weights, net.topology.groups
            kinds = (group[None] == np.arange(net.topology.n_groups)[:, None]).astype(float)
            here = leverage[start : start + P]
            effective = np.maximum(kinds.sum(axis=1) - net.precision * (kinds @ here), 1e-3)
            squares = np.maximum(kinds @ net.weights**2, 1e-12)
            target = followed(effective, squares, self.x)
            nets.append(replace(net, precision=np.sqrt(net.precision * target)))
            start += P
        self.nets = replace(self.nets, nets=tuple(nets))

    def result(self, converged: bool) -> Joint:
        """What has been learnt; `linearise` comes before."""
        N, _ = self.system()
        cost = self.cost(self.nets, self.shared)
        _, volume = np.linalg.slogdet(N)
        evidence = -0.5 * cost - 0.5 * volume + 0.5 * float(np.log(self.nets.prior).sum())
        return Joint(self.nets, self.constants, cost, _inverse(N), float(evidence), converged)


def posterior(x: Array, nets: LensNets, normal: Normal, variance: float, scatter: Array) -> Array:
    """Covariance of all weights and the constants (P + Q, P + Q), from normal matrices of the settings."""
    J = np.concatenate(nets.local_with_jacobians(x)[1], axis=2)
    return _inverse(gauss_newton(J, loosened(normal, scatter, variance).H / variance, nets.prior))


def _inverse(N: Array) -> Array:
    return solve_scaled(N, np.eye(len(N)), ROUNDING)

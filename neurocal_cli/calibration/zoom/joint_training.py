"""Step 3: training of all networks and the constants on the reprojection error of all settings.

    E = sum_s |r_s(p(x_s; w), q)|^2 / (2 sigma^2) + 1/2 sum_g a_g |w_g|^2

with p the networks' outputs at setting s, which are the weights of the calibrating network there, and q the
constants. A setting enters through its normal matrix (`quadratic_error`), so a step costs a millisecond. The
matrices are recomputed until nothing changes.

On one set of matrices all weights take Levenberg-Marquardt steps together, or the calibrating network and the
parameters' networks take turns, as the paper describes it. At each setting the networks predict the weights
of the calibrating network. This network takes a step on the points of the setting. Its new weights are the
targets of the other networks, which are trained on them for one iteration. With

    p' = p + eta g / h        g = J^T r, h = diag(J^T J): the step,
    w' = argmin sum_s (h_s / eta) (y(x_s; w) - p'_s)^2 / sigma^2 + sum_g a_g |w_g|^2    (one iteration)

the gradient of a network's error is that of the pixel error, so alternating training converges to the same
minimum, more slowly. All settings take their turn at once. The rate eta keeps the networks from all
correcting the same error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions
from neurocal_cli.adjustment.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.calibration.zoom.mlfn import updated_precision
from neurocal_cli.calibration.zoom.parameter_networks import LensNets, outputs_to_local
from neurocal_cli.calibration.zoom.quadratic_error import QuadraticError, inverse, with_scatter
from neurocal_cli.calibration.zoom.settings import Constants, PixelData
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

# 2 E is chi-squared: a change of 1 is one standard deviation of a single parameter. The training stops far
# below that; test_alternating_ends_where_joint_training_ends checks that its end does not depend on the way.
_ROUNDS = 16  # most sets of normal matrices
_SMALL_GAIN = 0.5  # of 2 E: a round that gains less is the last
_CONVERGED = 1e-3  # share of 2 E: training has converged when its last round gains less
# On one set of matrices a step that gains less than 0.02 of 2 E is the last.
_OPTIONS = DescentOptions(
    damping=1e-4, shrink=0.1, least_damping=1e-12, largest_damping=1e8,
    tolerance=0.0, negligible=0.02, by_promise=False, flat=0.0, max_iterations=25,
)  # fmt: skip
_PRIOR_ROUNDS = 4  # the first rounds, which update the priors
# test_alternating_ends_where_joint_training_ends in test_zoom_lens_networks.py checks both.
_RATE = 0.35  # eta: below 2 / (number of parameters that compensate for each other)
_EPOCHS = 150  # most turns on one set of normal matrices


@frozen_dataclass(eq=False)
class Joint:
    """Networks and constants after training."""

    nets: LensNets
    constants: Constants
    cost: float  # sum of squared residuals over sigma^2, plus the priors' part: 2 E
    covariance: Array  # (P + Q, P + Q) of all weights and the constants
    evidence: float  # logarithm of the probability of the data, up to a constant
    converged: bool


def train_joint(
    learner: JointLearner, descend: Callable[[JointLearner], float], report: Callable[[float], None]
) -> Joint:
    """Minimise E, starting from networks that were fitted one at a time.

    `descend` lowers 2 E on the present normal matrices and returns it: `JointLearner.descend`, or
    `take_turns`. `report` is called with the share that is done.
    """
    converged = False
    for round_ in range(_ROUNDS):
        report(round_ / _ROUNDS)
        before = learner.linearise()
        if round_ < _PRIOR_ROUNDS:
            learner.update_priors()
        after = descend(learner)
        converged = before - after < _CONVERGED * after
        if before - after < _SMALL_GAIN and round_ >= _PRIOR_ROUNDS:
            break
    learner.linearise()
    return learner.result(converged)


class JointLearner:
    """Networks and constants in training, with the normal matrices of the settings.

    `x` (S, D) are the scaled controls, `variance` [px^2] is that of the noise of one coordinate, and
    `scatter` (L,) that of each local parameter from setting to setting.
    """

    def __init__(
        self, data: PixelData, x: Array, nets: LensNets, constants: Constants, variance: float, scatter: Array
    ) -> None:
        self.data, self.x, self.variance, self.scatter = data, x, variance, scatter
        self.nets, self.constants = nets, constants

    def linearise(self) -> float:
        """Recompute the normal matrices at the present networks; 2 E."""
        reference = self.nets.local(self.x)
        normal, self.constants = self.data.linearise(reference, self.constants)
        normal = with_scatter(normal, self.scatter, self.variance)
        self.error = QuadraticError(self.x, reference, normal, self.variance)
        self.shared = np.zeros(self.data.n_shared)
        return self.error.cost(self.nets, self.shared)

    def descend(self) -> float:
        """Levenberg-Marquardt on the present normal matrices; 2 E at the end."""
        nets, shared, cost = self.error.minimum(self.nets, self.shared, _OPTIONS)
        self.accept(nets, shared)
        return cost

    def accept(self, nets: LensNets, shared: Array) -> None:
        """Accept networks and a step of the constants."""
        self.nets, self.constants = nets, self.constants.moved(shared)

    def update_priors(self) -> None:
        """Update the priors of all networks."""
        leverage = np.diagonal(inverse(self.error.system(self.nets, self.shared)[0]))
        nets = [
            replace(net, precision=updated_precision(net.topology, net.precision, own, net.weights, self.x))
            for net, own in zip(self.nets.nets, self.nets.split(leverage[: -len(self.shared)]), strict=True)
        ]
        self.nets = replace(self.nets, nets=tuple(nets))

    def result(self, converged: bool) -> Joint:
        """Result of the training; call `linearise` before."""
        N, _ = self.error.system(self.nets, self.shared)
        cost = self.error.cost(self.nets, self.shared)
        _, volume = np.linalg.slogdet(N)
        evidence = -0.5 * cost - 0.5 * volume + 0.5 * float(np.log(self.nets.prior).sum())
        return Joint(self.nets, self.constants, cost, inverse(N), float(evidence), converged)


def take_turns(learner: JointLearner) -> float:
    """Lower 2 E on the present normal matrices, network by network; an argument of `train_joint`."""
    nets, shared = learner.nets, learner.shared
    best = (nets, shared, learner.error.cost(nets, shared))
    rate = _RATE
    for _ in range(_EPOCHS):
        nets, shared = _turn(learner, nets, shared, rate)
        cost = learner.error.cost(nets, shared)
        if cost < best[2]:
            best = (nets, shared, cost)
        else:  # the step was too long: restart at the best state with half the rate
            nets, shared = best[:2]
            rate *= 0.5
            if rate < 1e-3 * _RATE:
                break
    learner.accept(*best[:2])
    return best[2]


def _turn(learner: JointLearner, nets: LensNets, shared: Array, rate: float) -> tuple[LensNets, Array]:
    """One step of the calibrating network at every setting and one iteration of each other network."""
    normal, local = learner.error.normal, nets.local(learner.x)
    L = local.shape[1]
    pull = normal.g - learner.error.offset(local, shared)[1]
    _, by_output = outputs_to_local(nets.scale, np.column_stack([net.output(learner.x) for net in nets.nets]))
    # On the scales of the networks' outputs: gradients, second derivatives, and the step.
    gradient = (np.swapaxes(by_output, 1, 2) @ pull[:, :L, None])[..., 0] / learner.variance
    curvature = np.einsum("sia,sij,sja->sa", by_output, normal.H[:, :L, :L], by_output) / learner.variance
    step = rate * gradient / np.maximum(curvature, 1e-300)
    trained = []
    for j, net in enumerate(nets.nets):
        _, J = net.output_with_jacobian(learner.x)
        weight = curvature[:, j] / rate
        A = (J.T * weight) @ J + np.diag(net.prior)
        rhs = J.T @ (weight * step[:, j]) - net.prior * net.weights
        trained.append(replace(net, weights=net.weights + solve_scaled(A, rhs[:, None], ROUNDING)[:, 0]))
    total = normal.H[:, L:, L:].sum(axis=0)
    constants = rate * solve_scaled(total, pull[:, L:].sum(axis=0)[:, None], ROUNDING)[:, 0]
    return replace(nets, nets=tuple(trained)), shared + constants

"""Step 3 as the paper describes it: the calibrating network and the parameters' networks take turns.

At each setting the networks predict the weights of the calibrating network. This network takes a step on the
points of the setting. Its new weights are the targets of the other networks, which are trained on them for
one iteration. With

    p' = p + eta g / h        g = J^T r, h = diag(J^T J): the step,
    w' = argmin sum_s (h_s / eta) (y(x_s; w) - p'_s)^2 / sigma^2 + sum_g a_g |w_g|^2    (one iteration)

the gradient of a network's error is that of the pixel error, so alternating training converges to the minimum
of `joint_training`, more slowly. All settings take their turn at once. The rate eta keeps the networks from
all correcting the same error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.joint_training import JointLearner
from neurocal_cli.zoom_lens.parameter_networks import LensNets, outputs_to_local

# test_alternating_ends_where_joint_training_ends in tests/test_zoom_lens_networks.py checks both.
_RATE = 0.35  # eta: below 2 / (number of parameters that compensate for each other)
_EPOCHS = 150  # most turns on one set of normal matrices


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
    normal, local = learner.normal, nets.local(learner.x)
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

"""Step 3 as the paper describes it: the calibrating net and the parameters' networks take turns.

At each setting the networks give the calibrating net its weights; it takes a step on the points of
that setting; its new weights are what the networks are to give, and each learns them for one
iteration. With

    p' = p + eta g / h        g = J^T r, h = diag(J^T J): the calibrating net's step,
    w' = argmin sum_s (h_s / eta) (y(x_s; w) - p'_s)^2 / sigma^2 + sum_g a_g |w_g|^2    (one iteration)

the gradient of a network's error is that of the pixel error, so where nothing moves any more the
pixel error of all networks together is at a minimum: the same as that of `joint`, approached more
slowly. All settings take their turn at once; the rate eta makes up for networks that would all
correct the same error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.joint_training import NEARLY, Joint, JointLearner
from neurocal_cli.zoom_lens.parameter_networks import LensNets, outputs_to_local
from neurocal_cli.zoom_lens.setting_normals import Constants, Normal, PixelData

__all__ = ["train_alternating"]

_RATE = 0.35  # eta: below 2 / (number of parameters that can make up for each other)
_ROUNDS = 16  # of normal matrices
_EPOCHS = 150  # on one set of them
_SETTLED = 0.5  # of 2 E: a round that gains less is the last


def train_alternating(
    data: PixelData,
    x: Array,
    nets: LensNets,
    constants: Constants,
    variance: float,
    scatter: Array,
    report: Callable[[float], None] | None = None,
) -> Joint:
    """Minimise what `joint.train_joint` minimises, network by network; the same arguments."""
    learner = JointLearner(data, x, nets, constants, variance, scatter)
    converged = False
    for round_ in range(_ROUNDS):
        if report is not None:
            report(round_ / _ROUNDS)
        before = learner.linearise()
        if round_ < 4:
            learner.follow_priors()
        nets, shared, after = _take_turns(learner)
        learner.accept(nets, shared)
        converged = before - after < NEARLY * after
        if before - after < _SETTLED and round_ >= 4:
            break
    learner.linearise()
    return learner.result(converged)


def _take_turns(learner: JointLearner) -> tuple[LensNets, Array, float]:
    """Some hundred turns on the present normal matrices; the best state met."""
    nets, shared = learner.nets, learner.shared
    best = (nets, shared, learner.cost(nets, shared))
    rate = _RATE
    for _ in range(_EPOCHS):
        nets, shared = _turn(learner, nets, shared, rate)
        cost = learner.cost(nets, shared)
        if cost < best[2]:
            best = (nets, shared, cost)
        else:  # too long a step: back to the best, more carefully
            nets, shared = best[:2]
            rate *= 0.5
            if rate < 1e-3 * _RATE:
                break
    return best


def _turn(learner: JointLearner, nets: LensNets, shared: Array, rate: float) -> tuple[LensNets, Array]:
    """One turn of the calibrating net at every setting and one iteration of each network."""
    normal: Normal = learner.normal
    local = nets.local(learner.x)
    L = local.shape[1]
    d = np.column_stack([local - learner.reference, np.broadcast_to(shared, (len(local), len(shared)))])
    pull = normal.g - (normal.H @ d[..., None])[..., 0]
    _, by_output = outputs_to_local(nets.scale, np.column_stack([net.output(learner.x) for net in nets.nets]))
    # On the networks' own scales: gradients, second derivatives, and the calibrating net's targets.
    gradient = (np.swapaxes(by_output, 1, 2) @ pull[:, :L, None])[..., 0] / learner.variance
    curvature = np.einsum("sia,sij,sja->sa", by_output, normal.H[:, :L, :L], by_output) / learner.variance
    step = rate * gradient / np.maximum(curvature, 1e-300)
    learnt = []
    for j, net in enumerate(nets.nets):
        _, J = net.output_with_jacobian(learner.x)
        weight = curvature[:, j] / rate
        A = (J.T * weight) @ J + np.diag(net.prior)
        rhs = J.T @ (weight * step[:, j]) - net.prior * net.weights
        learnt.append(replace(net, weights=net.weights + solve_scaled(A, rhs[:, None], ROUNDING)[:, 0]))
    total = normal.H[:, L:, L:].sum(axis=0)
    constants = rate * solve_scaled(total, pull[:, L:].sum(axis=0)[:, None], ROUNDING)[:, 0]
    return replace(nets, nets=tuple(learnt)), shared + constants

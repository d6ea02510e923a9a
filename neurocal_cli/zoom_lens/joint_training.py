"""Step 3: all networks and the constants together, on the pixel error over all settings.

    E = sum_s |r_s(p(x_s; w), q)|^2 / (2 sigma^2) + 1/2 sum_g a_g |w_g|^2

with p the networks' outputs at setting s, which are weights of the calibrating net there, and q the
constants. Levenberg-Marquardt over all weights at once. A setting enters through its normal matrix
(`blocks`), so a step costs a millisecond; the matrices are renewed until nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.zoom_lens.network_training import followed
from neurocal_cli.zoom_lens.parameter_networks import LensNets
from neurocal_cli.zoom_lens.setting_normals import Constants, Normal, PixelData
from neurocal_cli.zoom_lens.static_calibration import scaled_solve

__all__ = ["Joint", "JointLearner", "gauss_newton", "loosened", "posterior", "train_joint"]

_ROUNDS = 16  # of normal matrices
_STEPS = 25  # of Levenberg-Marquardt on one set of them
_SETTLED = 0.5  # of 2 E, a quarter of a standard deviation: a round that gains less is the last
NEARLY = 1e-3  # share of 2 E: what gains less than this in the last round has converged
_SMALL = 0.02  # of 2 E: a step that gains less is the last on a set of matrices
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


def loosened(normal: Normal, scatter: Array, variance: float) -> Normal:
    """Normal matrices that allow local parameters a scatter from setting to setting.

    Each setting's local parameters are the networks' plus an offset of variance `scatter` (L,), which
    is eliminated.
    """
    if not scatter.any():
        return normal
    some = np.flatnonzero(scatter)
    B = normal.H[:, some[:, None], some] + variance * np.diag(1 / scatter[some])
    cross = normal.H[:, some]
    gain = np.swapaxes(scaled_solve(B, cross), 1, 2)
    pull = normal.g[:, some]
    solved = scaled_solve(B, pull[..., None])[..., 0]
    return replace(
        normal,
        H=normal.H - gain @ cross,
        g=normal.g - (gain @ pull[..., None])[..., 0],
        cost=normal.cost - (solved * pull).sum(axis=1),
    )


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
        self.damping = 1e-4

    def linearise(self) -> float:
        """Renew the normal matrices where the networks are; 2 E."""
        self.reference = self.nets.local(self.x)
        normal, self.constants = self.data.linearise(self.reference, self.constants)
        self.normal = loosened(normal, self.scatter, self.variance)
        self.shared = np.zeros(self.data.n_shared)
        return self.cost(self.nets, self.shared)

    def _offset(self, nets: LensNets, shared: Array) -> Array:
        local = nets.local(self.x) - self.reference
        return np.column_stack([local, np.broadcast_to(shared, (len(local), len(shared)))])

    def cost(self, nets: LensNets, shared: Array) -> float:
        """2 E on the present normal matrices, the constants a step `shared` from where they were."""
        d, normal = self._offset(nets, shared), self.normal
        Hd = (normal.H @ d[..., None])[..., 0]
        fit = normal.cost.sum() + ((Hd - 2 * normal.g) * d).sum()
        prior = sum(float((net.prior * net.weights**2).sum()) for net in nets.nets)
        return float(fit / self.variance + prior)

    def system(self) -> tuple[Array, Array]:
        """Gauss-Newton matrix and downhill direction of E over all weights and the constants."""
        J = np.concatenate(self.nets.local_with_jacobians(self.x)[1], axis=2)
        d = self._offset(self.nets, self.shared)
        pull = (self.normal.g - (self.normal.H @ d[..., None])[..., 0]) / self.variance
        L, P = J.shape[1:]
        weights, prior = self.nets.weights, self.nets.prior
        rhs = np.empty(P + pull.shape[1] - L)
        rhs[:P] = J.reshape(-1, P).T @ pull[:, :L].ravel() - prior * weights
        rhs[P:] = pull[:, L:].sum(axis=0)
        return gauss_newton(J, self.normal.H / self.variance, prior), rhs

    def descend(self) -> float:
        """Levenberg-Marquardt on the present normal matrices; 2 E at the end."""
        cost = self.cost(self.nets, self.shared)
        P = len(self.nets.weights)
        for _ in range(_STEPS):
            N, rhs = self.system()
            damped = N + self.damping * np.diag(np.diagonal(N))
            step = scaled_solve(damped[None], rhs[None, :, None])[0, :, 0]
            nets, shared = self.nets.moved(step[:P]), self.shared + step[P:]
            after = self.cost(nets, shared)
            if after < cost:
                gained = cost - after
                self.nets, self.shared, cost = nets, shared, after
                self.damping = max(0.2 * self.damping, 1e-12)
                if gained < _SMALL:
                    break
            else:
                self.damping *= 5
                if self.damping > 1e8:
                    break
        self.damping = float(np.clip(self.damping, 1e-8, 1e-2))
        self.accept(self.nets, self.shared)
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


def gauss_newton(J: Array, H: Array, prior: Array) -> Array:
    """Second derivatives of E (P + Q, P + Q), given those of the settings (S, L + Q, L + Q).

    J (S, L, P) are the derivatives of the local parameters by the weights, prior (P,) the precisions
    of the weights.
    """
    L, P = J.shape[1:]
    Q = H.shape[1] - L
    N, flat = np.empty((P + Q, P + Q)), J.reshape(-1, P)
    N[:P, :P] = flat.T @ (H[:, :L, :L] @ J).reshape(-1, P)
    N[:P, P:] = flat.T @ H[:, :L, L:].reshape(len(flat), Q)
    N[P:, :P] = N[:P, P:].T
    N[P:, P:] = H[:, L:, L:].sum(axis=0)
    N[range(P), range(P)] += prior
    return N


def posterior(x: Array, nets: LensNets, normal: Normal, variance: float, scatter: Array) -> Array:
    """Covariance of all weights and the constants (P + Q, P + Q), from normal matrices of the settings."""
    J = np.concatenate(nets.local_with_jacobians(x)[1], axis=2)
    return _inverse(gauss_newton(J, loosened(normal, scatter, variance).H / variance, nets.prior))


def _inverse(N: Array) -> Array:
    return scaled_solve(N[None], np.eye(len(N))[None])[0]

"""A multi-layer feed-forward network (the paper's MLFN) from zoom and focus to one camera parameter.

The network has two hidden layers and a linear output. The first layer has one rational unit for each control
and tanh units of single controls. The tanh units of the second layer take the controls and the first layer.
The output takes all of them by direct connections, and products of two controls or their units of the first
layer (sigma-pi units). A network whose weights under a prior are 0 is a plane:

    h(x) = (1 - x^2) / (1 + tilt x),   tilt = 0.99 tanh(a),
    r = (x, h(x), tanh(s x + c)),   g = tanh(U r + b),
    y = v.g + q.r + r'M r / 2 + o,   M = 0 but between two controls

The rational unit is made for optics. By Newton's formula, image distances and focal lengths are homographic
functions (A x + B) / (1 + C x) of the positions of groups of glass and of the object's distance. They rise
steeply towards a pole beyond the end of the range, at close focus or at the long end of a zoom. Tanh units
would need many settings there. Plane and rational unit together are all such functions, with the pole at
-1 / tilt, and all parabolas (tilt 0). The rational unit is 0 at both ends of the range. Beyond them x in its
denominator stays -1 or 1, so that extrapolation does not reach the pole. At four
values of a control, a hyperbola passes for any wave; there the image centre, to which no optics gives a pole,
has parabolas alone beside its tanh units.

B networks of one topology are computed together: weights are (B, P).

`train` fits them to the targets d_s of one parameter, by least squares with Bayesian regularisation:

    E = 1/2 sum_s (y(x_s) - d_s)^2 / (c_s + tau^2) + 1/2 sum_g a_g |w_g|^2

Each kind of weights has a zero-mean prior. Its precision is estimated from the effective number of these
weights, gamma_g = n_g - a_g tr_g A^-1 and a_g = gamma_g / |w_g|^2 (MacKay 1992; Foresee and Hagan 1997). c_s
is the variance of a target. tau^2 is an additional scatter from setting to setting, which is 0 unless the
errors are larger than c_s explains. The evidence compares starts and topologies.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.levenberg_marquardt import DescentOptions, LevenbergMarquardt
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

# Keeps the pole 1 % of half the range outside it or farther. The poles of
# test_plane_and_rational_unit_are_any_homographic_function come as near as 2 %.
_LARGEST_TILT = 0.99
# Precisions of priors in units of the targets' spread; see `updated_precision`. The training tests in
# test_zoom_lens_networks.py and the tests of lenses with three values of a control repeat their effect.
_FLAT = 1e-4  # of free weights: a standard deviation of 100
_MOST = 1e4
_HELD = 1e12  # of weights that stay 0
_LEAST, _LEAST_FEW, _LEAST_SPARSE, _LEAST_TILT = 0.03, 0.3, 1.0, 1.0
_ENOUGH_VALUES = 4
# The descent has no criterion to stop: the priors are updated until the schedule ends.
_OPTIONS = DescentOptions(
    damping=1e-2, shrink=0.2, least_damping=1e-10, largest_damping=np.inf,
    tolerance=0.0, flat=0.0, max_iterations=1_000_000,
)  # fmt: skip

_Trial = tuple[Array, Array, Array, Array]  # weights, outputs, their derivatives, the cost


@frozen_dataclass
class Topology:
    """Numbers of units of a network."""

    controls: int  # inputs, D
    own: int  # tanh units of the first hidden layer for each control, beside its rational unit
    hidden: int  # units of the second hidden layer, H
    rich: bool = True  # whether tanh units have products, too

    @property
    def width(self) -> int:
        """R: inputs of the second layer and of the output."""
        return self.controls * (2 + self.own)

    @cached_property
    def source(self) -> NDArray[np.int64]:
        """(R,) number of the control of each unit in r."""
        D = self.controls
        return np.concatenate([np.arange(D), np.arange(D), np.repeat(np.arange(D), self.own)])

    @cached_property
    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices in r of the two factors of each product."""
        units = self.width if self.rich else 2 * self.controls
        pairs = [(i, j) for i in range(units) for j in range(i) if self.source[i] != self.source[j]]
        first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        return first, second

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Slices of a, s, c, U, b, v, q, m (the weights in M), o among the weights."""
        D, own, R, H = self.controls, self.controls * self.own, self.width, self.hidden
        counts = {"a": D, "s": own, "c": own, "U": H * R, "b": H, "v": H, "q": R}
        counts |= {"m": len(self.pairs[0]), "o": 1}
        ends = np.cumsum(list(counts.values())).tolist()
        return {name: slice(end - counts[name], end) for name, end in zip(counts, ends, strict=True)}

    @property
    def n_weights(self) -> int:
        """P."""
        return self.parts["o"].stop

    @cached_property
    def groups(self) -> NDArray[np.int64]:
        """(P,) number of the prior of each weight; -1: the plane, which has none.

        Weights of one kind share a prior: s, c, the weights in U from each control, b, v, q from tanh
        units, q from rational units, a, and m.
        """
        D, R, H = self.controls, self.width, self.hidden
        group = np.full(self.n_weights, -1)
        group[self.parts["s"]], group[self.parts["c"]] = 0, 1
        group[self.parts["U"]] = np.tile(2 + self.source, H)
        group[self.parts["b"]], group[self.parts["v"]] = 2 + D, 3 + D
        group[self.parts["q"]] = np.repeat([-1, 5 + D, 4 + D], [D, D, R - 2 * D])
        group[self.parts["a"]], group[self.parts["m"]] = 6 + D, 7 + D
        return group

    @property
    def n_groups(self) -> int:
        """Number of priors."""
        return 8 + self.controls

    @cached_property
    def membership(self) -> Array:
        """(n_groups, P) 1 where a weight has a prior, else 0."""
        return (self.groups[None] == np.arange(self.n_groups)[:, None]).astype(float)

    def random_weights(self, count: int, rng: np.random.Generator) -> Array:
        """(count, P) initial weights: random hidden units with small outgoing weights."""
        weights = rng.normal(size=(count, self.n_weights))
        for outgoing in ("v", "q", "m"):
            weights[:, self.parts[outgoing]] *= 0.3
        weights[:, self.parts["o"]] = 0.0
        return weights


def respond(topology: Topology, weights: Array, x: Array) -> Array:
    """Outputs (B, n) of a stack of networks (B, P) at controls (n, D), scaled to about [-1, 1]."""
    return _layers(topology, weights, x)[0]


def respond_with_jacobian(topology: Topology, weights: Array, x: Array) -> tuple[Array, Array]:
    """Outputs (B, n) and their derivatives by the weights (B, n, P)."""
    y, r, through, g = _layers(topology, weights, x)
    part, D = topology.parts, topology.controls
    B, n, H = len(weights), len(x), topology.hidden
    rational, own_units = r[:, :, D : 2 * D], r[:, :, 2 * D :]
    U = weights[:, part["U"]].reshape(B, H, topology.width)
    by_sum = (1 - g * g) * weights[:, None, part["v"]]  # by the argument of each second-layer unit
    by_r = by_sum @ U + weights[:, None, part["q"]] + through
    by_argument = by_r[:, :, 2 * D :] * (1 - own_units * own_units)
    squashed, inside = np.tanh(weights[:, None, part["a"]]), np.clip(x, -1, 1)
    by_tilt = by_r[:, :, D : 2 * D] * rational * -inside / (1 + _LARGEST_TILT * squashed * inside)
    first, second = topology.pairs
    J = np.empty((B, n, topology.n_weights))
    J[:, :, part["a"]] = by_tilt * _LARGEST_TILT * (1 - squashed * squashed)
    J[:, :, part["s"]] = by_argument * np.repeat(x, topology.own, axis=1)
    J[:, :, part["c"]] = by_argument
    J[:, :, part["U"]] = (by_sum[..., None] * r[:, :, None]).reshape(B, n, -1)
    J[:, :, part["b"]], J[:, :, part["v"]], J[:, :, part["q"]], J[:, :, part["o"]] = by_sum, g, r, 1.0
    J[:, :, part["m"]] = r[:, :, first] * r[:, :, second]
    return y, J


def _layers(topology: Topology, weights: Array, x: Array) -> tuple[Array, Array, Array, Array]:
    """Output (B, n), controls and first hidden layer r and M r (B, n, R), second hidden layer (B, n, H)."""
    part = topology.parts
    B, n, D = len(weights), *x.shape
    tilt = _LARGEST_TILT * np.tanh(weights[:, None, part["a"]])
    rational = (1 - x * x) / (1 + tilt * np.clip(x, -1, 1))
    own_units = np.tanh(
        weights[:, None, part["s"]] * np.repeat(x, topology.own, axis=1) + weights[:, None, part["c"]]
    )
    r = np.concatenate([np.broadcast_to(x, (B, n, D)), rational, own_units], axis=2)
    U = weights[:, part["U"]].reshape(B, topology.hidden, topology.width)
    g = np.tanh(r @ np.swapaxes(U, 1, 2) + weights[:, None, part["b"]])
    M = np.zeros((B, topology.width, topology.width))
    first, second = topology.pairs
    M[:, first, second] = M[:, second, first] = weights[:, part["m"]]
    through = r @ M
    y = (g @ weights[:, part["v"], None] + r @ weights[:, part["q"], None])[..., 0] + weights[:, part["o"]]
    return y + 0.5 * (through * r).sum(axis=2), r, through, g


@frozen_dataclass
class Schedule:
    """Numbers of iterations."""

    iterations: int = 300
    warm: int = 40  # before the first update of the priors
    settle: int = 160  # before the first update of the scatter
    period: int = 4  # from one update of the priors to the next


@frozen_dataclass(eq=False)
class TrainedNets:
    """A stack of trained networks of one topology."""

    weights: Array  # (B, P)
    precision: Array  # (B, G) of the prior of each kind of weights
    scatter: Array  # (B,) tau^2, in squared units of the targets
    evidence: Array  # (B,) log of the probability of the targets, up to a constant of all topologies


def train(
    topology: Topology,
    x: Array,
    targets: Array,
    variance: Array,
    weights: Array,
    schedule: Schedule | None = None,
    poles: NDArray[np.bool_] | None = None,
) -> TrainedNets:
    """Train a stack of networks, all at once, from initial weights (B, P).

    The controls x (n, D) are scaled to about [-1, 1], the targets (n,) or (B, n) centred and scaled to a
    spread of about 1. Their variances, likewise, are 0 where unknown, so that the scatter is the noise.
    `poles` (B,) tells which networks may have one, by default all.
    """
    without = np.zeros(len(weights), dtype=bool) if poles is None else ~poles
    learner = _NetworkStack(topology, x, targets, variance, weights, without)
    schedule = schedule or Schedule()
    descent = LevenbergMarquardt(learner, _OPTIONS, floor=-1.0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for iteration in range(schedule.iterations):
            if iteration >= schedule.warm and iteration % schedule.period == 0:
                learner.update_priors(allow_scatter=iteration >= schedule.settle)
                descent.renew()
            descent.step()
    return learner.result()


class _NetworkStack:
    """Networks in training as a problem of `LevenbergMarquardt`: each network is a group of cost 2 E."""

    def __init__(
        self,
        topology: Topology,
        x: Array,
        targets: Array,
        variance: Array,
        weights: Array,
        without_pole: NDArray[np.bool_],
    ) -> None:
        self.topology, self.x, self.targets, self.variance = topology, x, targets, variance
        self.w, self.diagonal = weights.copy(), range(topology.n_weights)
        self.a = np.full((len(weights), topology.n_groups), 0.3)
        self.w[without_pole, topology.parts["a"]] = 0.0
        self.a[without_pole, 6 + topology.controls] = _HELD
        # For targets without a variance, a thousandth of their spread until the noise is estimated.
        self.tau2 = np.full(len(weights), 0.0 if variance.any() else 1e-6)
        self.y, self.J = respond_with_jacobian(topology, self.w, x)
        self._weigh()

    def _weigh(self) -> None:
        """Apply new priors and scatter."""
        self.prior = prior_precision(self.topology, self.a)
        self.weight = 1 / (self.variance + self.tau2[:, None])
        self.cost = self._cost(self.w, self.y)

    def _cost(self, w: Array, y: Array) -> Array:
        return (self.weight * (y - self.targets) ** 2).sum(axis=1) + (self.prior * w * w).sum(axis=1)

    def _normal(self) -> Array:
        A = (np.swapaxes(self.J, 1, 2) * self.weight[:, None]) @ self.J
        A[:, self.diagonal, self.diagonal] += self.prior
        return A

    def solve(self, damping: Array, active: NDArray[np.intp]) -> tuple[Array, Array]:
        """Damped step of each network's weights, and the predicted gain."""
        pull = (self.weight * (self.targets - self.y))[:, None] @ self.J
        downhill = pull[:, 0] - self.prior * self.w
        A = self._normal()
        ridge = damping[:, None] * np.diagonal(A, axis1=1, axis2=2)
        A[:, self.diagonal, self.diagonal] += ridge
        # Regular by the priors, so not scaled.
        step = np.asarray(np.linalg.solve(A, downhill[..., None])[..., 0], dtype=float)
        return step, (step * (downhill + ridge * step)).sum(axis=1)

    def move(self, step: Array, active: NDArray[np.intp]) -> tuple[_Trial, Array, NDArray[np.bool_]]:
        """The networks after a step; all weights are valid."""
        w = self.w + step
        y, J = respond_with_jacobian(self.topology, w, self.x)
        cost = self._cost(w, y)
        return (w, y, J, cost), cost, np.ones(len(w), dtype=bool)

    def accept(self, trial: _Trial, better: NDArray[np.bool_], active: NDArray[np.intp]) -> None:
        """Accept the trial for networks that improved."""
        w, y, J, cost = trial
        self.w, self.y = np.where(better[:, None], w, self.w), np.where(better[:, None], y, self.y)
        self.J = np.where(better[:, None, None], J, self.J)
        self.cost = np.where(better, cost, self.cost)

    def update_priors(self, allow_scatter: bool) -> None:
        """Update the priors, half the way on a logarithmic scale, and the scatter."""
        leverage = np.diagonal(np.linalg.inv(self._normal()), axis1=1, axis2=2)
        self.a = updated_precision(self.topology, self.a, leverage, self.w, self.x)
        if allow_scatter:
            gamma = self.topology.n_weights - (self.prior * leverage).sum(axis=1)
            self._update_scatter(np.maximum(len(self.x) - gamma, 0.05 * len(self.x)))
        self._weigh()

    def _update_scatter(self, freedom: Array) -> None:
        """Update tau^2 so that the squared errors have their expected size; 0 if they are smaller."""
        total = self.variance + self.tau2[:, None]
        ratio = ((self.y - self.targets) ** 2 / total).sum(axis=1) / freedom
        known = self.variance.any()
        median = np.median(self.variance, axis=-1)
        least = 1e-4 * median if known else 1e-8
        seed = np.where(self.tau2 > 0, self.tau2, median * np.maximum(ratio - 1, 0))
        self.tau2 = seed * np.clip(ratio, 0.1, 10.0)
        self.tau2 = np.where(self.tau2 < least, 0.0 if known else least, self.tau2)

    def result(self) -> TrainedNets:
        """The networks as they are, with the logarithm of their evidence (B,)."""
        sign, volume = np.linalg.slogdet(self._normal())
        volume = np.where(sign > 0, volume, np.inf)
        log_prior = 0.5 * np.log(self.prior).sum(axis=1)
        noise = np.log(self.variance + self.tau2[:, None]).sum(axis=1)
        # Symmetric permutations of the weights are not counted, as idle units have none.
        evidence = -0.5 * self.cost - 0.5 * volume + log_prior - 0.5 * noise
        evidence = np.where(np.isfinite(evidence), evidence, -np.inf)
        return TrainedNets(self.w, self.a, self.tau2, evidence)


def updated_precision(
    topology: Topology, precision: Array, leverage: Array, weights: Array, x: Array
) -> Array:
    """Precision of each prior (..., G) by MacKay's formula, half the way to it on a logarithmic scale.

    `leverage` (..., P) is the diagonal of A^-1. Data do not shrink weights along directions that they do not
    determine. The standard deviation of a prior is therefore at most 6. It is at most 1.8 for those of tanh
    units where no control has more than four values: so few lie on the bend of one large unit by chance, and
    it overshoots between them. It is at most 1 for weights from a control of three values, where a unit could
    turn between two of them without any effect on the data, and for the weights a of the rational units, as
    tanh(a) saturates. It is exactly 1 for a where a control has three values, as these leave the tilt open.
    Weights that are held at 0 stay so.
    """
    kinds, D, sparse = topology.membership, topology.controls, sparse_controls(x)
    least, most = np.full(len(kinds), _LEAST), np.full(len(kinds), _MOST)
    if few_values(x):
        least[: 5 + D] = _LEAST_FEW
    least[2 : 2 + D][sparse] = _LEAST_SPARSE
    least[6 + D] = _LEAST_TILT
    if sparse.any():
        most[6 + D] = _LEAST_TILT
    effective = np.maximum(kinds.sum(axis=1) - precision * (leverage @ kinds.T), 1e-3)
    squares = np.maximum((weights * weights) @ kinds.T, 1e-12)
    updated = np.sqrt(precision * np.clip(effective / squares, least, most))
    return np.where(precision == _HELD, _HELD, updated)


def prior_precision(topology: Topology, precision: Array) -> Array:
    """Precision of each weight's prior, (..., G) -> (..., P)."""
    group = topology.groups
    return np.where(group < 0, _FLAT, np.asarray(precision)[..., np.maximum(group, 0)])


def few_values(x: Array) -> bool:
    """Whether no control has more than four distinct values in the settings (S, D)."""
    return max(len(np.unique(column)) for column in x.T) <= _ENOUGH_VALUES


def sparse_controls(x: Array) -> NDArray[np.bool_]:
    """(D,) which controls have too few distinct values in the settings (S, D) for tanh units."""
    return np.array([len(np.unique(column)) < _ENOUGH_VALUES for column in x.T])

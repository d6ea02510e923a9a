"""The networks of one zoom lens: each predicts one camera parameter at any setting.

The outputs are centred and scaled. alpha_u is on a logarithmic, linear or reciprocal scale, whichever has the
highest evidence. Instead of alpha_v there is log(alpha_v / alpha_u), as the pixels' shape hardly changes with
the setting. u0, v0, t_z and the distortion coefficients are used as they are.

`fit_committee` is step 2: networks for each parameter alone, with several topologies and starts. The
parameters are fitted in an order, like the polynomials of Willson (1994). t_z comes first, as it is the least
certain. The others are then estimated with t_z held at the output of its networks. alpha_u, which is
correlated with t_z, compensates for the remaining error of these networks, and its targets are precise.

Evidence ranks networks of all topologies. The noise is far smaller than the variation of the parameters, so
some of the best networks overfit: they pass through all settings and oscillate between them. The committee
therefore consists of those of the best networks that agree most between the settings (`_agreeing`).

The errors of known cameras, whose size nobody tells, follow from their networks, too (`error_variances`). A
network may pass through all cameras, and then its residuals say nothing. By the priors of its weights, it
is a sum of independent functions of the setting, the eigenvectors of J P^-1 J^T with the eigenvalues w_k as
variances: a constant, a slope, a bend, and ever finer wiggles, whose variances fall quickly. So the targets'
parts t_k along the finest functions are errors for the most part:

    sigma^2 = sum_k q_k t_k^2 / sum_k q_k,   q_k = 1 / (w_k + tau^2)^2,   nu = (sum_k q_k)^2 / sum_k q_k^2

tau^2 is raised from the scatter that the training found until nu degrees of freedom count, because one wiggle
alone may be 0 by chance. What the parts hold of the lens itself makes sigma too large, never too small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.calibration.verdict.findings import LEVEL, log_odds
from neurocal_cli.calibration.zoom.mlfn import (
    Schedule,
    Topology,
    few_values,
    prior_precision,
    respond,
    respond_with_jacobian,
    sparse_controls,
    train,
)
from neurocal_cli.calibration.zoom.settings import inverse
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import UsageError

_LEAST_STD = 1e-6  # of a parameter without errors, as a share of the parameter

# Degrees of freedom that must count: two of five cameras with one control, four of seven or more. Repeated by
# test_the_errors_of_known_cameras_are_told (slow).
_LEAST_FREEDOM, _ENOUGH_FREEDOM = 2.0, 4.0

_SMOOTH = 3  # weights for each control of a smooth parameter

_TAU2 = 1e-8 * 10 ** np.arange(0.0, 9.0, 0.125)

SCALES = ("log", "linear", "inverse")
# Two slow tests of test_zoom_lens.py, with 45 settings and of a real lens, measure the errors that
# these choices, `Budget` and `Schedule` reach between settings.
# (own, hidden): tanh units of the first layer for each control, units of the second.
TOPOLOGIES = ((0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (2, 1), (1, 2), (2, 2), (1, 3), (2, 3))
# Three values of a control determine no more than its rational unit, so it has no tanh units of its own.
_SPARSE = ((0, 0), (0, 1), (0, 2), (0, 3))
_WEIGHTS_PER_SETTING, _WITH_PRODUCTS = 2.0, 1.5  # most of them, and most if tanh units have products
# Log-odds that tanh units of alpha_u's networks must reach, and another scale of it than the logarithmic one.
_LOG_ODDS = 5.0
_CENTRE = (2, 3)  # u0 and v0, which are where the glass wanders
_AGREEING_SHARE = 0.6  # of the best networks, which may be in the committee
_GRID = 13  # values of each control at which networks are compared


@frozen_dataclass(eq=False)
class LensNets:
    """One network for each local parameter: alpha_u, alpha_v, u0, v0, and then t_z and distortion."""

    scale: str  # of alpha_u's network, one of `SCALES`
    nets: tuple[ParameterNet, ...]

    @property
    def weights(self) -> Array:
        """(P,) weights of all networks, one after the other."""
        return np.concatenate([net.weights for net in self.nets])

    @property
    def prior(self) -> Array:
        """(P,) precisions of the priors of all weights."""
        return np.concatenate([net.prior for net in self.nets])

    def moved(self, step: Array) -> LensNets:
        """After a step (P,) of all weights."""
        moved = [
            replace(net, weights=net.weights + part)
            for net, part in zip(self.nets, self.split(step), strict=True)
        ]
        return replace(self, nets=tuple(moved))

    def split(self, weights: Array) -> list[Array]:
        """Split a vector of the length of all weights (P,) into the parts of each network."""
        return np.split(weights, np.cumsum([net.topology.n_weights for net in self.nets])[:-1])

    def local(self, x: Array) -> Array:
        """(n, L) local parameters at scaled controls (n, D)."""
        return outputs_to_local(self.scale, np.column_stack([net.output(x) for net in self.nets]))[0]

    def local_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Local parameters (n, L) and their derivatives by all weights (n, L, P)."""
        pairs = [net.output_with_jacobian(x) for net in self.nets]
        local, by_output = outputs_to_local(self.scale, np.column_stack([y for y, _ in pairs]))
        parts = [by_output[:, :, j, None] * J[:, None] for j, (_, J) in enumerate(pairs)]
        return local, np.concatenate(parts, axis=2)

    def local_scatter(self, local: Array) -> Array:
        """(L,) variance of the local parameters from setting to setting; `local` (S, L) are their values."""
        scatter = np.array([net.scatter for net in self.nets])
        alpha = np.median(local[:, :2], axis=0)
        slope = float(np.median(np.abs(to_scale(self.scale, local[:, 0])[1])))
        scatter[0] /= slope**2
        scatter[1] = scatter[1] * alpha[1] ** 2 + scatter[0]
        return scatter


@frozen_dataclass(eq=False)
class ParameterNet:
    """One network with the scaling of its output: centre + spread y."""

    topology: Topology
    weights: Array  # (P,)
    precision: Array  # (G,) of the weights' priors
    centre: float
    spread: float
    scatter: float = 0.0  # variance of the output from setting to setting that the network does not explain

    def output(self, x: Array) -> Array:
        """(n,) outputs at scaled controls (n, D)."""
        return self.centre + self.spread * respond(self.topology, self.weights[None], x)[0]

    def output_with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Outputs (n,) and their derivatives by the weights (n, P)."""
        y, J = respond_with_jacobian(self.topology, self.weights[None], x)
        return self.centre + self.spread * y[0], self.spread * J[0]

    @property
    def prior(self) -> Array:
        """(P,) precision of each weight's prior."""
        return prior_precision(self.topology, self.precision)


def to_scale(scale: str, alpha: Array) -> tuple[Array, Array]:
    """Values on one of `SCALES`, and their derivatives by the value; of the shape of alpha."""
    if scale == "log":
        return np.log(alpha), 1 / alpha
    if scale == "inverse":
        return 1 / alpha, -1 / alpha**2
    return np.asarray(alpha, dtype=float), np.ones_like(alpha)


def from_scale(scale: str, y: Array) -> tuple[Array, Array]:
    """Values from one of `SCALES`, and their derivatives by y; of the shape of y."""
    if scale == "log":
        alpha = np.exp(y)
        return alpha, alpha
    if scale == "inverse":
        return 1 / y, -1 / y**2
    return np.asarray(y, dtype=float), np.ones_like(y)


def outputs_to_local(scale: str, outputs: Array) -> tuple[Array, Array]:
    """Local parameters (n, L) from the networks' outputs (n, L), and derivatives (n, L, L)."""
    local, n, L = outputs.copy(), *outputs.shape
    by_output = np.tile(np.eye(L), (n, 1, 1))
    local[:, 0], by_output[:, 0, 0] = from_scale(scale, outputs[:, 0])
    ratio = np.exp(outputs[:, 1])
    local[:, 1] = local[:, 0] * ratio
    by_output[:, 1, 0], by_output[:, 1, 1] = by_output[:, 0, 0] * ratio, local[:, 1]
    return local, by_output


def local_to_outputs(scale: str, local: Array) -> tuple[Array, Array]:
    """The networks' outputs (n, L) for local parameters (n, L), and derivatives (n, L, L)."""
    outputs, n, L = local.copy(), *local.shape
    by_local = np.tile(np.eye(L), (n, 1, 1))
    outputs[:, 0], by_local[:, 0, 0] = to_scale(scale, local[:, 0])
    outputs[:, 1] = np.log(local[:, 1] / local[:, 0])
    by_local[:, 1, 0], by_local[:, 1, 1] = -1 / local[:, 0], 1 / local[:, 1]
    return outputs, by_local


def are_cameras(local: Array) -> NDArray[np.bool_]:
    """(...) which local parameters (..., L) are finite, with positive scale factors."""
    return np.asarray(np.isfinite(local).all(axis=-1) & (local[..., :2] > 0).all(axis=-1))


@frozen_dataclass
class Budget:
    """Numbers of networks to train and to keep.

    Raises
    ------
    UsageError
        Topologies that are not pairs of whole numbers.
    """

    topologies: tuple[tuple[int, int], ...] | None = None  # None: those that suit the number of settings
    starts: int = 12  # random starts of each topology
    best: int = 20  # networks of the highest evidence that may be in the committee
    members: int = 12  # size of the committee
    schedule: Schedule = field(default_factory=Schedule)

    def __post_init__(self) -> None:
        if self.topologies is None:
            return
        pairs = np.array(self.topologies, dtype=object)
        if pairs.shape[1:] != (2,) or not all(
            isinstance(n, (int, np.integer)) and n >= 0 for n in pairs.flat
        ):
            raise UsageError(
                "topologies must be pairs of whole numbers of at least 0, such as ((2, 0), (2, 2))"
            )


def fit_committee(
    x: Array,
    names: Sequence[str],
    local: Array,
    H: Array | None,
    variance: float,
    rng: np.random.Generator,
    budget: Budget,
    report: Callable[[float], None] = lambda share: None,
) -> tuple[LensNets, ...]:
    """Fit networks to tables of local parameters (S, L) at scaled controls (S, D), one parameter at a time.

    Of the names, alpha_u, alpha_v, u0, v0 come first. H (S, L + Q, L + Q) are normal matrices at the tables,
    which with the variance of the noise [px^2] give those of the targets; None where they are unknown.
    `report` is called with the share that is done. The first of the members consists of the networks that
    agree best with the others.
    """
    # A grid over the whole range of the controls.
    probe = np.array(list(product(np.linspace(-1, 1, _GRID), repeat=x.shape[1])))
    L = len(names)
    values, held = local.copy(), np.array([name == "t_z" for name in names])
    chosen: dict[int, list[ParameterNet]] = {}

    def choose(j: int, nets: list[ParameterNet]) -> None:
        chosen[j] = _agreeing(nets[: budget.best], probe, budget.members)

    values, spread = _given(local, values, H, variance, np.zeros(L, dtype=bool))
    alone = int(held.sum())  # whether t_z is fitted before all others
    for j in np.flatnonzero(held).tolist():
        ((nets, _),) = _fit(x, [_Targets(values[:, j], spread[:, j])], rng, budget, lambda k: report(k / L))
        choose(j, nets)
        values[:, j] = np.mean([net.output(x) for net in chosen[j]], axis=0)
        values, spread = _given(local, values, H, variance, held)
    plain = [*_CENTRE, *range(4 + alone, L)]
    # Plane and rational unit have four weights of a control, so four values contradict no hyperbola.
    any_fits = few_values(x) and not sparse_controls(x).any()
    targets = [_Targets(values[:, j], spread[:, j], pole=not (any_fits and j in _CENTRE)) for j in plain]
    for scale in SCALES:
        of_alpha, derivative = to_scale(scale, values[:, 0])
        targets.append(_Targets(of_alpha, spread[:, 0] * derivative**2, derivative))
    targets.append(_Targets(np.log(values[:, 1] / values[:, 0]), spread[:, 1] / values[:, 1] ** 2))
    found = _fit(x, targets, rng, budget, lambda k: report((alone + (L - alone) * k) / L))
    for j, (nets, _) in zip([*plain, 1], [*found[: len(plain)], found[-1]], strict=True):
        choose(j, nets)
    fits = dict(zip(SCALES, found[len(plain) : -1], strict=True))
    best = max(fits, key=lambda name: fits[name][1])
    scale = best if fits[best][1] > fits["log"][1] + _LOG_ODDS else "log"
    choose(0, fits[scale][0])
    return tuple(LensNets(scale, tuple(chosen[j][k] for j in range(L))) for k in range(budget.members))


def _given(
    local: Array, values: Array, H: Array | None, variance: float, held: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Tables with some parameters held at other values, and the variances of the rest; (S, L) both."""
    if H is None:
        return local.copy(), np.zeros_like(local)
    free = np.flatnonzero(~held)
    pull = -(H[:, free[:, None], np.flatnonzero(held)] @ (values - local)[:, held, None])
    B = H[:, free[:, None], free]
    values = values.copy()
    values[:, free] = local[:, free] + solve_scaled(B, pull, ROUNDING)[..., 0]
    spread = np.zeros_like(local)
    spread[:, free] = variance * np.diagonal(inverse(B), axis1=1, axis2=2)
    return values, spread


@frozen_dataclass(eq=False)
class _Targets:
    """What a network learns."""

    values: Array  # (S,)
    variance: Array  # (S,)
    # (S,) of a focal length on one of `SCALES`: derivatives by the length itself.
    derivative: Array | None = None
    pole: bool = True  # whether it may rise towards one, as optics does

    @cached_property
    def scaling(self) -> tuple[float, float]:
        """Centre and spread."""
        centre, spread = float(self.values.mean()), float(self.values.std())
        # Equal targets have no spread; their noise, or 1, replaces it.
        return centre, max(spread, float(np.sqrt(self.variance.mean())), 1e-9 * abs(centre)) or 1.0


def _fit(
    x: Array,
    targets: list[_Targets],
    rng: np.random.Generator,
    budget: Budget,
    report: Callable[[float], None],
) -> list[tuple[list[ParameterNet], float]]:
    """Networks of all topologies and starts, best first, and the evidence of the best; for each target.

    The evidence is in units of the targets, or of the focal length. The networks of all targets are trained
    together.
    """
    topologies = [suitable_topology(x, *pair) for pair in budget.topologies or _suitable_topologies(x)]
    starts = [
        [each.random_weights(budget.starts if each.own + each.hidden else 1, rng) for each in topologies]
        for _ in targets
    ]
    nets, evidence = ([list[Any]() for _ in targets] for _ in range(2))
    centre, spread = (np.array(part)[:, None] for part in zip(*(one.scaling for one in targets), strict=True))
    scaled = (np.array([one.values for one in targets]) - centre) / spread
    variance = np.array([one.variance for one in targets]) / spread**2
    for k, topology in enumerate(topologies):
        report(k / len(topologies))
        stack = np.concatenate([of_target[k] for of_target in starts])
        of = np.repeat(np.arange(len(targets)), len(stack) // len(targets))
        poles = np.array([one.pole for one in targets])[of]
        trained = train(topology, x, scaled[of], variance[of], stack, budget.schedule, poles)
        for t, w, a, tau2, e in zip(
            of, trained.weights, trained.precision, trained.scatter, trained.evidence, strict=True
        ):
            c, s = targets[t].scaling
            nets[t].append(ParameterNet(topology, w, a, c, s, float(tau2) * s**2))
            evidence[t].append(float(e))
    return [_ranked(*each) for each in zip(targets, nets, evidence, strict=True)]


def _ranked(
    targets: _Targets, nets: list[ParameterNet], evidence: list[float]
) -> tuple[list[ParameterNet], float]:
    order = np.argsort(-np.array(evidence), kind="stable")
    density = -len(targets.values) * float(np.log(targets.scaling[1]))
    if targets.derivative is not None:
        density += float(np.log(np.abs(targets.derivative)).sum())
        plain = [k for k in order if nets[k].topology.own + nets[k].topology.hidden == 0]
        if targets.variance.any() and plain and evidence[order[0]] < evidence[plain[0]] + _LOG_ODDS:
            order = np.array(plain)
    return [nets[k] for k in order], evidence[order[0]] + density


def _suitable_topologies(x: Array) -> tuple[tuple[int, int], ...]:
    """Topologies for settings (S, D): at most two weights a setting, as the priors make most of them idle."""
    limit = max(_WEIGHTS_PER_SETTING * len(x), Topology(x.shape[1], 0, 1).n_weights)
    choices = _SPARSE if sparse_controls(x).any() else TOPOLOGIES
    return tuple(pair for pair in choices if suitable_topology(x, *pair).n_weights <= limit)


def suitable_topology(x: Array, own: int, hidden: int) -> Topology:
    """The topology for settings (S, D); where these are few, its tanh units have no products."""
    topology = Topology(x.shape[1], own, hidden)
    return replace(topology, rich=topology.n_weights <= _WITH_PRODUCTS * len(x))


def _agreeing(nets: Sequence[ParameterNet], probe: Array, count: int) -> list[ParameterNet]:
    """The `count` networks nearest to the median of all, the nearest first.

    Networks far from it are never taken. Where there are too few networks, the nearer ones are repeated.
    """
    outputs = np.array([net.output(probe) for net in nets])
    distance = ((outputs - np.median(outputs, axis=0)) ** 2).mean(axis=1)
    order = np.argsort(distance, kind="stable")[: max(1, round(_AGREEING_SHARE * len(nets)))]
    return [nets[order[k % len(order)]] for k in range(count)]


def too_few(cameras: int, controls: int) -> bool:
    """Whether the cameras are too few to tell their errors from the lens."""
    return cameras - _SMOOTH * controls < _LEAST_FREEDOM


def error_variances(members: Sequence[LensNets], x: Array, outputs: Array) -> Array:
    """Variances (S, L) of the errors of the networks' targets `outputs` (S, L) at scaled controls x (S, D).

    The errors of alpha_u are taken to be equal shares of it. u0 and v0 are taken to have equal errors, so
    that two parameters tell their size.
    """
    variances = np.median(_errors(members, x, outputs)[0], axis=0)
    variances[2:4] = variances[2:4].mean()
    return np.asarray(variances * _sizes(members[0].scale, outputs) ** 2)


def odd_camera(members: Sequence[LensNets], x: Array, outputs: Array) -> int | None:
    """The camera without which the others agree far more probably, or None; see `error_variances`."""
    S = len(x)
    if too_few(S, x.shape[1]):
        return None
    variance, freedom = _errors(members, x, outputs)
    evidence = np.zeros(S)
    for s in range(S):
        rest = np.arange(S) != s
        without, left = _errors(members, x[rest], outputs[rest])
        squares = np.median([freedom * variance, left * without, left], axis=1)  # (3, L)
        of_nets = (log_odds(max(b, a), a, nu + 1, 1, outputs.size) for b, a, nu in squares.T.tolist())
        evidence[s] = max(of_nets)
    worst = int(evidence.argmax())
    return worst if evidence[worst] > LEVEL else None


def _errors(members: Sequence[LensNets], x: Array, outputs: Array) -> tuple[Array, Array]:
    """sigma^2 and nu (M, L) of each network."""
    sizes = _sizes(members[0].scale, outputs)
    found = np.array(
        [
            [_error(net, x, *of) for net, *of in zip(nets.nets, outputs.T, sizes.T, strict=True)]
            for nets in members
        ]
    )
    size = np.abs(np.median(outputs, axis=0))
    size[1] = 1.0  # log(alpha_v / alpha_u): a ratio of 1 is 0
    return np.maximum(found[..., 0], (_LEAST_STD * size) ** 2), found[..., 1]


def _error(net: ParameterNet, x: Array, targets: Array, sizes: Array) -> tuple[float, float]:
    """sigma^2 and nu of one network, for targets whose errors have relative sizes."""
    y, J = net.output_with_jacobian(x)
    J = J / (net.spread * sizes[:, None])
    w, functions = np.linalg.eigh((J / net.prior) @ J.T)  # P: the precisions of the prior
    # The weights' prior is about 0, so only the network without its linear part is subtracted.
    parts = functions.T @ ((targets - y) / (net.spread * sizes) + J @ net.weights)
    S, D = x.shape
    wanted = np.clip(S - _SMOOTH * D, min(_LEAST_FREEDOM, S - 2), _ENOUGH_FREEDOM)
    tau2 = np.maximum(_TAU2, net.scatter / net.spread**2)
    q = 1 / (np.maximum(w, 0.0) + tau2[:, None]) ** 2
    freedom = q.sum(axis=1) ** 2 / (q * q).sum(axis=1)
    k = min(int((freedom < wanted).sum()), len(tau2) - 1)
    return float((q[k] * parts**2).sum() / q[k].sum()) * net.spread**2, float(freedom[k])


def _sizes(scale: str, outputs: Array) -> Array:
    """Relative sizes (S, L) of the targets' errors, with a mean square of 1."""
    sizes = np.ones_like(outputs)
    alpha, derivative = from_scale(scale, outputs[:, 0])
    sizes[:, 0] = np.abs(alpha / derivative)
    return sizes / np.sqrt((sizes**2).mean(axis=0))

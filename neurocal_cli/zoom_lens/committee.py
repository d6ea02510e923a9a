"""Step 2: networks for each parameter by itself, several topologies and starts of each.

The parameters are taken in an order, as Willson (1994) takes his polynomials: t_z first, as it is the
least certain, then the others as they are when t_z is what its networks say. So the error that
remains in t_z's networks is made up for by alpha_u, with which it trades off, instead of adding to
it; and alpha_u's targets, t_z being held, are precise.

Evidence ranks the networks, whatever their topology; noise is far below the bends of a lens, so some
of the best pass through all settings and bend freely between them. Those fall out of line: of the
best ones, the committee is those that agree most between the settings (`_agreeing`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.zoom_lens.mlfn import Topology
from neurocal_cli.zoom_lens.network_training import Schedule, sparse_controls, train
from neurocal_cli.zoom_lens.parameter_networks import SCALES, LensNets, ParameterNet, to_scale
from neurocal_cli.zoom_lens.setting_normals import Normal

__all__ = ["TOPOLOGIES", "Budget", "fit_committee", "suitable_topologies"]

# (own, hidden): tanh units of the first layer for each control, units of the second.
TOPOLOGIES = ((0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (2, 1), (1, 2), (2, 2), (1, 3), (2, 3))
# Three values of a control tell no more than its bow: no tanh units of its own then.
_SPARSE = ((0, 0), (0, 1), (0, 2), (0, 3))
_WEIGHTS_PER_SETTING = 2.0
_CLEARLY = 5.0  # logarithm of the odds for another scale than the logarithmic, which fits any zoom's noise
_IN_LINE = 0.6  # share of the best networks that may be in the committee
_GRID = 13  # places on each control where networks are compared


@dataclass(frozen=True)
class Budget:
    """How hard to look.

    Parameters
    ----------
    topologies : tuple of (int, int), optional
        Default: those that the settings allow.
    starts : int
        Random starts of each topology.
    best : int
        Networks, by evidence, that may be in the committee.
    members : int
        Networks of each parameter in it.
    schedule : Schedule
    """

    topologies: tuple[tuple[int, int], ...] | None = None
    starts: int = 12
    best: int = 20
    members: int = 12
    schedule: Schedule = field(default_factory=Schedule)


@dataclass(frozen=True, eq=False)
class _Ranked:
    """Networks of one parameter, the best first, and the evidence of the best in units of the targets."""

    nets: list[ParameterNet]
    evidence: float


def fit_committee(
    x: Array,
    names: Sequence[str],
    local: Array,
    normal: Normal,
    variance: float,
    rng: np.random.Generator,
    budget: Budget,
    report: Callable[[float], None],
) -> tuple[LensNets, ...]:
    """Fit networks to the tables, one parameter at a time.

    Parameters
    ----------
    x : (S, D) array
        Scaled controls.
    names : sequence of str
        Of the L local parameters; alpha_u, alpha_v, u0, v0 first.
    local : (S, L) array
        The tables.
    normal : Normal
        At the tables; its covariances are the targets' variances. Of zero size in H where the
        variances are not known.
    variance : float [px^2]
        Of the noise.
    rng : numpy.random.Generator
    budget : Budget
    report : callable
        Called with the share that is done.

    Returns
    -------
    members : tuple of LensNets
        The first consists of each parameter's network that agrees best with the others.
    """
    probe = _probe(x.shape[1])
    L = len(names)
    order = [j for j, name in enumerate(names) if name == "t_z"] + [
        2,
        3,
        *range(4 + ("t_z" in names), L),
        0,
        1,
    ]
    values, held = local.copy(), np.zeros(L, dtype=bool)
    chosen: dict[int, list[ParameterNet]] = {}
    scale = "log"
    for count, j in enumerate(order):
        report(count / L)
        values, spread = _given(local, values, normal, variance, held)
        targets, derivative = values[:, j], np.ones(len(x))
        if j == 0:
            scale, ranked = _best_scale(x, values[:, 0], spread[:, 0], rng, budget)
        else:
            if j == 1:
                targets, derivative = np.log(values[:, 1] / values[:, 0]), 1 / values[:, 1]
            ranked = _fit(x, targets, spread[:, j] * derivative**2, rng, budget)
        chosen[j] = _agreeing(ranked.nets[: budget.best], probe, budget.members)
        if names[j] == "t_z":
            values[:, j] = np.mean([net.output(x) for net in chosen[j]], axis=0)
            held[j] = True
    return tuple(LensNets(scale, tuple(chosen[j][k] for j in range(L))) for k in range(budget.members))


def suitable_topologies(x: Array) -> tuple[tuple[int, int], ...]:
    """Topologies that are worth trying on settings (S, D): up to twice as many weights, most of them idle."""
    limit = max(_WEIGHTS_PER_SETTING * len(x), Topology(x.shape[1], 0, 1).n_weights)
    choices = _SPARSE if sparse_controls(x).any() else TOPOLOGIES
    return tuple(pair for pair in choices if Topology(x.shape[1], *pair).n_weights <= limit)


def _probe(D: int) -> Array:
    """Places between the settings, a grid over the whole range."""
    axes = np.meshgrid(*[np.linspace(-1, 1, _GRID)] * D, indexing="ij")
    return np.column_stack([axis.ravel() for axis in axes])


def _given(
    local: Array, values: Array, normal: Normal, variance: float, held: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Tables when some parameters are held at other values, and the variances of the rest; (S, L) both."""
    L = local.shape[1]
    if not normal.H.size:
        return local, np.zeros_like(local)
    free, H = np.flatnonzero(~held), normal.H[:, :L, :L]
    pull = -(H[:, free[:, None], np.flatnonzero(held)] @ (values - local)[:, held, None])
    B = H[:, free[:, None], free]
    values = values.copy()
    values[:, free] = local[:, free] + solve_scaled(B, pull, ROUNDING)[..., 0]
    spread = np.zeros_like(local)
    inverse = solve_scaled(B, np.tile(np.eye(len(free)), (len(local), 1, 1)), ROUNDING)
    spread[:, free] = variance * np.diagonal(inverse, axis1=1, axis2=2)
    return values, spread


def _best_scale(
    x: Array, alpha: Array, variance: Array, rng: np.random.Generator, budget: Budget
) -> tuple[str, _Ranked]:
    """The scale of alpha_u on which the data are most probable, and its networks."""
    fits = {}
    for scale in SCALES:
        targets, derivative = to_scale(scale, alpha)
        ranked = _fit(x, targets, variance * derivative**2, rng, budget)
        # A density of targets, as one of alpha.
        fits[scale] = (ranked.evidence + float(np.log(np.abs(derivative)).sum()), ranked)
    best = max(fits, key=lambda name: fits[name][0])
    scale = best if fits[best][0] > fits["log"][0] + _CLEARLY else "log"
    return scale, fits[scale][1]


def _fit(x: Array, targets: Array, variance: Array, rng: np.random.Generator, budget: Budget) -> _Ranked:
    """Train all topologies from all starts and rank the networks by evidence."""
    centre, spread = float(targets.mean()), float(targets.std())
    # Targets that are all the same have no spread; their noise, or 1, serves.
    spread = max(spread, float(np.sqrt(variance.mean())), 1e-9 * abs(centre)) or 1.0
    scaled = (targets - centre) / spread
    nets, evidence = [], []
    for own, hidden in budget.topologies or suitable_topologies(x):
        topology = Topology(x.shape[1], own, hidden)
        start = topology.random_weights(budget.starts if own + hidden else 1, rng)
        trained = train(topology, x, scaled, variance / spread**2, start, budget.schedule)
        for w, a, tau2, e in zip(
            trained.weights, trained.precision, trained.scatter, trained.evidence, strict=True
        ):
            nets.append(ParameterNet(topology, w, a, centre, spread, float(tau2) * spread**2))
            evidence.append(float(e))
    order = np.argsort(-np.array(evidence), kind="stable")
    return _Ranked([nets[k] for k in order], evidence[order[0]] - len(x) * float(np.log(spread)))


def _agreeing(nets: Sequence[ParameterNet], probe: Array, count: int) -> list[ParameterNet]:
    """The `count` networks nearest to the median of all, the nearest first.

    Those farthest from it are never taken: where few settings leave few networks to choose from, the
    nearer ones are repeated.
    """
    outputs = np.array([net.output(probe) for net in nets])
    distance = ((outputs - np.median(outputs, axis=0)) ** 2).mean(axis=1)
    order = np.argsort(distance, kind="stable")[: max(1, round(_IN_LINE * len(nets)))]
    return [nets[order[k % len(order)]] for k in range(count)]

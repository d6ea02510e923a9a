"""A rival cause of the residuals, and the one rule by which rivals are compared.

A rival adds a few unknowns. Its evidence is the logarithm of the probability of the data with it over that
without it: poses, camera and its unknowns are integrated out, the noise is what it leaves, the size of its
unknowns is the most probable one of a grid, and the logarithm of the number of choices among rivals of the
same kind is taken off. Clean data hardly ever give more than `findings.LEVEL`. The rivals of a rig
(`rig.causes`) are compared by the same rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from neurocal_cli.adjustment.cross_validation import Minimum, least_by_precision, quietly
from neurocal_cli.adjustment.normal_equations import NOTHING, solve_scaled
from neurocal_cli.calibration.verdict.findings import Cause, Said, in_sequence
from neurocal_cli.calibration.verdict.linearised import Effect, Linearised, linearised
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_SIZES = np.exp(np.linspace(np.log(1e-6), np.log(0.3), 20))  # prior std of an unknown
_ROUNDING = 1e-9
_ITERATIONS = 3  # the noise is what the rival leaves
ABSORBED = 1e-7
"""Share of the information about an unknown, beside the poses, that is not more than rounding."""

Steps = Callable[[Linearised], Array]
Pattern = tuple[str, Array, float]
"""Name, weights (P, V) of the views at P places, and the number of choices among patterns of its kind."""
Patterns = Callable[[Linearised, Array, Array], Iterator[Pattern]]
Its = TypeVar("Its")  # rival


@frozen_dataclass(eq=False)
class Found(Generic[Its]):
    """What the residuals say about a rival."""

    rival: Its
    pattern: str  # "" if each view has unknowns of its own
    evidence: float  # log odds over nothing
    explained: float  # share of the squared error
    amounts: Array  # (m,) of its unknowns, or (V, m)
    weights: Array  # (V,) of the views; empty if each has its own
    camera: Array  # (f,) change of the free parameters with it
    size: float  # most probable std of its unknowns
    noise: float  # variance of the residuals with it


@frozen_dataclass(eq=False)
class Told:
    """What a rival's words need besides its estimate."""

    lin: Linearised
    found: Estimate
    unit: str  # of the world
    std: Mapping[str, float]  # reported standard deviations of the parameters
    diagonal: float  # of the image [px]
    std_of_poses: Array | None = None  # (V, 6) reported ones of omega and tau, normalised

    @property
    def alpha(self) -> float:
        """The focal length [px]."""
        return float(self.lin.state.entries[0, 0]) * self.lin.views.pixel_scale

    @property
    def longer(self) -> float:
        """Relative change of the focal length with this cause."""
        return float(self.found.camera[0] / self.lin.state.entries[0, 0]) if 0 in self.lin.free else 0.0

    @property
    def biases(self) -> dict[str, float]:
        """Changes of the focal lengths and the centre with this cause [px]."""
        names = {0: "alpha_u", 2: "alpha_v", 3: "u0", 4: "v0"}
        by = zip(self.lin.free.tolist(), self.found.camera.tolist(), strict=False)
        return {names[k]: one * self.lin.views.pixel_scale for k, one in by if k in names}

    @property
    def moved_poses(self) -> float:
        """Rms change of the poses in their standard deviations, of the parameter that changes most."""
        if self.std_of_poses is None or not (self.std_of_poses > 0).all():
            return 0.0
        lin, found = self.lin, self.found
        step = found.rival.steps_at(lin) @ found.amounts
        step[lin.free] += found.camera[: len(lin.free)]
        moved = (lin.solved[:, :, :-1] @ step) / self.std_of_poses
        return float(np.sqrt((moved**2).mean(axis=0)).max())

    @property
    def members(self) -> list[str]:
        """The views that have it, if it is a step, a group or one view, in their sequence."""
        names, weights = self.lin.views.names, self.found.weights
        return [names[k] for k in in_sequence(names) if weights.size and weights[k] > 0]

    @property
    def displaced(self) -> float:
        """Rms of the pixels by which it displaces the points of the views that have it [px]."""
        views = self.lin.views
        n = len(views.index) / (views.n_views if self.found.pattern == "one" else 1)
        return float(np.sqrt(max(self.found.explained * self.lin.cost / n, 0.0))) * views.pixel_scale


Say = Callable[[Told], Said]


@frozen_dataclass(eq=False)
class Rival(Cause[Told]):
    """A cause that changes what the camera sees by a few unknowns.

    It has an effect, or `steps` (c, m): the changes of the linearised columns by its m unknowns, which have
    no dimension. `patterns` are the ways in which views share the unknowns; without any, each view has its
    own.
    """

    patterns: Patterns | None = None
    effect: Effect | None = None
    steps: Steps | None = None
    of_given: bool = False  # a given value
    of_distance: bool = False  # the camera is that of the distance of its targets, and no other is right
    of_board: bool = False  # the shape of the target, which is usually estimated
    of_selected: str = ""  # other advice where the lens was selected
    unknown: bool = False  # no cause, but what is left if none is known

    def steps_at(self, lin: Linearised) -> Array:
        """The steps (c, m); without any if it does not apply."""
        if self.steps is not None:
            return self.steps(lin)
        if self.effect is None or self.effect not in lin.columns:
            return np.zeros((lin.width, 0))
        return np.eye(lin.width)[:, lin.columns[self.effect]]


Estimate = Found[Rival]


def given_changes(lin: Linearised, found: Estimate) -> dict[int, float]:
    """Changes of the given focal lengths and centre over the focal length, by the place of the entry in A."""
    changes = (found.rival.steps_at(lin) @ found.amounts) / lin.state.entries[0, 0]
    return {k: float(changes[k]) for k in lin.given.tolist() if k != 1}


@quietly
def estimates(lin: Linearised, n: float, rivals: tuple[Rival, ...], least: float = 0.0) -> list[Estimate]:
    """The rivals with their most probable patterns, the most probable rival first.

    `n` is the effective number of equations beyond the unknowns. Rivals that cannot reach the `least`
    evidence are left out. Raises `numpy.linalg.LinAlgError` if the views leave a singular matrix, or nan.
    """
    known = Known.at(lin, n)
    best: dict[str, Estimate] = {}
    for rival in rivals:
        steps = rival.steps_at(lin)
        if not steps.size or not known.cost > 0:
            continue
        X = steps.T @ lin.R[:, :-1]  # (V, m, c + 1)
        S, along = X[:, :, :-1] @ steps, X[:, :, np.append(lin.free, lin.width)]
        absorbed = ABSORBED * lin.before @ steps[: lin.before.shape[1]] ** 2  # (V, m)
        its = Unknowns(rival, S, along, absorbed)
        shared = rival.patterns and rival.patterns(lin, S, along[:, :, -1])
        for one in its.own(known, least) if shared is None else its.shared(known, shared, least):
            if one.evidence > (best[rival.cause].evidence if rival.cause in best else -np.inf):
                best[rival.cause] = one
    return sorted(best.values(), key=lambda one: -one.evidence)


def causes_among(rivals: tuple[Rival, ...], m: Minimum, n: float | None = None) -> list[Estimate]:
    """Those among some rivals at a minimum, as `estimates` has them; none if that fails."""
    lin = linearised(m, tuple(one.effect for one in rivals if one.effect is not None))
    try:
        return estimates(lin, lin.spare if n is None else n, rivals)
    except np.linalg.LinAlgError:
        return []


def including(lin: Linearised, found: Estimate) -> Linearised:
    """The same camera with a rival's unknowns added to it."""
    steps = found.rival.steps_at(lin)
    if found.weights.size:  # as further columns, estimated
        X = lin.R[:, :-1, :].swapaxes(1, 2) @ steps * found.weights[:, None, None]  # (V, c + 1, m)
        S = np.einsum("v,cm,vcn->vmn", found.weights, steps, X[:, :-1])
        m, width = steps.shape[1], lin.width
        R = np.zeros((len(lin.R), width + m + 1, width + m + 1))
        old, new = np.r_[np.arange(width), width + m], np.arange(width, width + m)
        R[:, old[:, None], old] = lin.R
        R[:, old[:, None], new] = X
        R[:, new[:, None], old] = X.swapaxes(1, 2)
        R[:, new[:, None], new] = S
        free = np.concatenate([lin.free, new])
        return replace(lin, R=R, free=free, spare=lin.spare - m)
    X = steps.T @ lin.R[:, :-1]  # each view's own: integrated out
    S = X[:, :, :-1] @ steps
    left = S + found.noise / found.size**2 * np.eye(S.shape[1])
    determined = float(np.trace(np.linalg.solve(left, S), axis1=1, axis2=2).sum())
    R = lin.R - X.swapaxes(1, 2) @ np.linalg.solve(left, X)
    return replace(lin, R=R, spare=max(lin.spare - determined, 1.0))


@frozen_dataclass(eq=False)
class Known:
    """The quadratic in the camera's free parameters, bordered by the right side and the cost."""

    M: Array  # (f + 1, f + 1)
    n: float  # effective number of equations beyond the unknowns
    inverse: Array  # (f, f)
    right: Array  # (f,) the step to the minimum
    cost: float
    least: float  # squared error that noise leaves at least

    @classmethod
    def at(cls, lin: Linearised, n: float) -> Known:
        """Of a camera at its minimum, or with causes that are included."""
        kept = np.append(lin.free, lin.width)
        return cls.of(lin.R[:, kept[:, None], kept].sum(axis=0), n)

    @classmethod
    def of(cls, M: Array, n: float, least: float = 0.0) -> Known:
        """With what noise leaves at least, if that is known."""
        inverse = solve_scaled(M[:-1, :-1], np.eye(len(M) - 1), _ROUNDING)  # lenses are almost degenerate
        right = inverse @ M[:-1, -1]
        cost = float(M[-1, -1] - right @ M[:-1, -1])
        return cls(M, n, inverse, right, cost, max(_ROUNDING * cost, least))

    def evidence(self, left: Array, spread: Array) -> Array:
        """Log odds of what leaves this squared error, with the log determinant of its unknowns."""
        found = -0.5 * self.n * np.log(left / self.cost) - 0.5 * spread
        return np.where(np.isfinite(found), found, -np.inf)


@frozen_dataclass(eq=False)
class Unknowns(Generic[Its]):
    """A rival's unknowns, with the poses eliminated."""

    rival: Its
    S: Array  # (V, m, m) information of each view about them
    along: Array  # (V, m, f + 1) coupling to the free parameters, and right side
    absorbed: Array  # (V, m) information that is not more than rounding

    def own(self, known: Known, least: float) -> Iterator[Found[Its]]:
        """Each view with unknowns of its own."""
        V, m = self.S.shape[:2]
        values, vectors = np.linalg.eigh(self.S)
        told = values > (vectors**2 * self.absorbed[:, :, None]).sum(axis=1)
        values = np.where(told, values, 0.0).ravel()
        turned = np.where(told[..., None], vectors.swapaxes(1, 2) @ self.along, 0.0).reshape(V * m, -1)
        by_precision = least_by_precision(known.M, values, turned)
        freely, _ = by_precision(np.array([_ROUNDING * values.max(initial=NOTHING)]))
        if not known.evidence(np.maximum(freely, known.least), np.zeros(1))[0] > least:
            return
        _, logdet = np.linalg.slogdet(known.M[:-1, :-1])
        left = np.full(len(_SIZES), known.cost)
        for _ in range(_ITERATIONS):
            cost, by_size = by_precision(left / known.n / _SIZES**2)
            left = np.maximum(cost, known.least)
        evidence = known.evidence(left, by_size - logdet)
        best = int(np.argmax(evidence))
        noise = float(left[best]) / known.n
        precision = noise / _SIZES[best] ** 2
        N = known.M - (turned.T / (values + precision)) @ turned
        camera = np.linalg.solve(N[:-1, :-1], N[:-1, -1])
        amounts = (turned[:, -1] - turned[:, :-1] @ camera) / (values + precision)
        yield Found(
            self.rival, "", float(evidence[best]), 1.0 - float(left[best]) / known.cost,
            (vectors @ amounts.reshape(V, m, 1))[..., 0], np.zeros(0), camera, float(_SIZES[best]), noise,
        )  # fmt: skip

    def shared(self, known: Known, patterns: Iterable[Pattern], least: float) -> Iterator[Found[Its]]:
        """The best place of each pattern in which the views share the unknowns."""
        for name, weights, choices in patterns:
            weights = np.atleast_2d(weights)
            of_all = _weighted(weights, self.along)
            X, g = of_all[:, :, :-1], of_all[:, :, -1] - of_all[:, :, :-1] @ known.right
            S = _weighted(weights**2, self.S) - X @ known.inverse @ X.swapaxes(1, 2)
            values, vectors = np.linalg.eigh(S)
            told = values > (vectors**2 * (weights**2 @ self.absorbed)[:, :, None]).sum(axis=1)
            turned = np.where(told, (vectors.swapaxes(1, 2) @ g[..., None])[..., 0], 0.0)
            values = np.where(told, values, NOTHING)
            freely = known.cost - (turned**2 / values).sum(axis=1)
            reach = known.evidence(np.maximum(freely, known.least), 2 * np.log(choices))
            if not reach.max() > least:
                continue
            left = np.full((len(weights), len(_SIZES)), known.cost)
            for _ in range(_ITERATIONS):
                precision = left / known.n / _SIZES**2
                gained = (turned[:, None] ** 2 / (values[:, None] + precision[..., None])).sum(axis=2)
                left = np.maximum(known.cost - gained, known.least)
            spread = np.log1p(values[:, None] / precision[..., None]).sum(axis=2)
            evidence = known.evidence(left, spread + 2 * np.log(choices))
            p, k = np.unravel_index(int(np.argmax(evidence)), evidence.shape)
            amounts = vectors[p] @ (turned[p] / (values[p] + precision[p, k]))
            camera = known.right - known.inverse @ (X[p].T @ amounts)
            yield Found(
                self.rival, name, float(evidence[p, k]), 1.0 - float(left[p, k]) / known.cost, amounts,
                weights[p], camera, float(_SIZES[k]), float(left[p, k]) / known.n,
            )  # fmt: skip


def _weighted(weights: Array, values: Array) -> Array:
    """Sums (P, m, k) of values (V, m, k) over the views, by weights (P, V)."""
    return (weights @ values.reshape(len(values), -1)).reshape(len(weights), *values.shape[1:])

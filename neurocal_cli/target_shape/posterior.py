"""Posterior of the offsets of the target's points, with the sizes of the prior estimated by empirical Bayes.

In units of the noise variance, the squared error and the prior form one quadratic

    E = |r|^2 + sum_g lambda_g |w_g|^2,    lambda_g = sigma^2 / size_g^2,

in the cameras, the poses and the parts w of the offsets (`system`). MacKay's (1992) updates find the sizes.
Of the n_g coefficients of a part, the data determine

    gamma_g = n_g - lambda_g tr (H^-1)_gg,    lambda_g <- gamma_g sigma^2 / |w_g|^2.

A stretch has only two coefficients, which hardly determine its size. So its size is either at least that of
prints or zero, whichever has more evidence.

The evidence, with the noise variance marginalised as well, decides whether there are offsets at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import unit_diagonal
from neurocal_cli.target_shape.information import Information
from neurocal_cli.target_shape.prior import STRETCH, Prior
from neurocal_cli.target_shape.system import Solved, System


@frozen_dataclass(eq=False)
class Posterior:
    """The most probable offsets with their std, and the covariance of the cameras."""

    offsets: Array  # (n, 3) along each point's axes [world unit]
    variance: float  # of the noise [px^2]
    camera_step: Array  # (f,) of the cameras' free parameters
    camera: Array  # (f, f) covariance of these in units of the noise variance, with the offsets marginalised
    sizes: dict[str, float]  # of the prior's parts, by name [world unit]
    determined: float  # effective number of the offsets' unknowns that the data determine
    evidence: float  # log evidence, with a flat prior on the cameras' normalised parameters
    # The solution, its prior and the gauge (3 n, g); None if the points stay as given.
    solved: tuple[Solved, Prior, Array] | None = None

    @property
    def followed(self) -> Array:
        """(f, n, 3) S_cd S_dd^-1: regression of the cameras' scores on those of the offsets."""
        whole = np.zeros((len(self.camera), *self.offsets.shape))
        if self.solved is None or not len(whole):
            return whole
        solved, prior, _ = self.solved
        along = solved.camera_root.T @ solved.offset_root(prior)
        return np.asarray(-np.linalg.solve(self.camera, along).reshape(whole.shape))

    @property
    def std(self) -> Array:
        """(n, 3) standard deviations of the offsets, along each point's axes [world unit]."""
        if self.solved is None:
            return np.zeros_like(self.offsets)
        solved, prior, gauge = self.solved
        return np.sqrt(self.variance * np.maximum(solved.offset_variance(prior, gauge), 0.0))

    @property
    def poses(self) -> Array | None:
        """(P, 6, 6) covariance of each pose in units of the noise variance, with the target's gauge held."""
        if self.solved is None:
            return None
        solved, prior, gauge = self.solved
        return solved.poses(prior, gauge)


_SINGLE = {"place": [0, 1], "height": [2]}  # axes of the parts of single points
_STATED = "stated"  # the only part of surveyed points: the factor of their stated standard deviations
_OUT_OF_PLANE = ("bend", "height")
_START = {
    "fold": 3e-3,
    "bend": 3e-3,
    "stretch": STRETCH,
    "warp": 5e-4,
    "place": 3e-4,
    "height": 3e-4,
}  # of the target's size
_MOST = 2e-3  # largest size of a stretch over the target's size: a skew of the image axes looks like one
_NOTHING = 1e-7  # size of an absent part over the target's size
_SETTLED = 0.03  # relative change of the sizes
# Least predicted gain in log evidence of a step. With these, cameras differ by 0.005 standard deviations rms
# from those with 1e-5; 90 sets of boards of all shapes by tests/support/targets.py.
_NO_GAIN = 0.002
_NO_GAIN_YET = 0.5  # the same from arbitrary initial sizes, around a target that will still move
_FARTHEST = 8.0  # largest multiple of MacKay's step
_HALVINGS = 6
_PASSES = 40
_NO_COST = 1e-300  # lower bound of a cost, which rounding may make negative


def evidence_of_given(*cameras: Information) -> float:
    """Log evidence of the given target, from cameras that share no unknowns."""
    spare = cost = logdet = 0.0
    for info in cameras:
        S, g, least, of_poses = _poses_eliminated(info)
        spare += info.spare
        cost += least - (float(g @ np.linalg.solve(S, g)) if len(g) else 0.0)
        logdet += of_poses + (float(np.linalg.slogdet(S)[1]) if len(g) else 0.0) - info.log_precision
    return log_evidence(spare, cost, logdet)


def camera_step_of(info: Information) -> Array:
    """(f,) step of the cameras, with the points as given."""
    S, g, *_ = _poses_eliminated(info)
    return camera_step(S, g)


def camera_step(S: Array, g: Array) -> Array:
    """Steps of the cameras, given their matrices (..., f, f) and right sides (f,) or (..., f, k)."""
    scaled, scale = unit_diagonal(S)
    inverse = np.linalg.pinv(scaled, hermitian=True) * scale[..., :, None] * scale[..., None, :]
    return np.asarray(inverse @ g)


def _poses_eliminated(info: Information) -> tuple[Array, Array, float, float]:
    """Eliminate the poses: the cameras' matrix, right side and cost, and the log determinant of the poses."""
    if not len(info.pose):
        return info.camera, info.camera_right, info.cost, 0.0
    root = np.linalg.inv(np.linalg.cholesky(info.pose))
    rows = root @ np.concatenate([info.pose_camera, info.pose_right[..., None]], axis=2)
    flat = rows.reshape(-1, rows.shape[2])
    S = info.camera - flat[:, :-1].T @ flat[:, :-1]
    g = info.camera_right - flat[:, :-1].T @ flat[:, -1]
    logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
    return S, g, info.cost - float(flat[:, -1] @ flat[:, -1]), logdet


def log_evidence(spare: float, cost: float, logdet: float) -> float:
    """Log evidence of a quadratic with this minimum and log determinant; variance prior 1 / sigma^2."""
    least = max(cost, _NO_COST)
    return math.lgamma(0.5 * spare) - 0.5 * spare * math.log(math.pi * least) - 0.5 * logdet


def posterior(
    info: Information,
    prior: Prior,
    sizes: Mapping[str, float] | None = None,
    flat: bool = False,
    variance: float | None = None,
    with_stretch: bool = True,
) -> Posterior:
    """Estimate the sizes of the parts, and the offsets.

    The quadratic is in the whole offsets from the given target, along each point's axes. With initial sizes
    [world unit], an initial noise variance [px^2] is needed as well, because then the errors on the given
    target are no noise. Flat means that the points stay in their plane, and `with_stretch` that the stretch
    may be switched on or off. Raises `numpy.linalg.LinAlgError` if the points do not determine the cameras.
    """
    parts = _Parts(info, prior, flat, _NO_GAIN_YET if sizes is None else _NO_GAIN)
    noise = np.sqrt(info.cost / parts.spare if variance is None else variance)
    start = sizes or {name: _START[name] * prior.size for name in (*prior.groups, *_SINGLE)}
    now = parts.climbed(parts.at({name: size / noise for name, size in parts.allowed(start).items()}))
    if with_stretch and "stretch" in now.ratios:
        other = parts.climbed(parts.at(parts.with_stretch_changed(now)))
        now = other if other.evidence > now.evidence else now
    return parts.posterior(now)


def given_posterior(info: Information, prior: Prior) -> Posterior:
    """The posterior with zero offsets: the points stay as given."""
    S, g, cost, logdet = _poses_eliminated(info)
    inverse = np.linalg.inv(S)
    cost -= float(g @ inverse @ g)
    logdet += float(np.linalg.slogdet(S)[1]) - info.log_precision
    return Posterior(
        offsets=np.zeros((len(info.point), 3)),
        variance=cost / info.spare,
        camera_step=inverse @ g,
        camera=np.asarray(inverse, dtype=float),
        sizes=dict.fromkeys((*prior.groups, *_SINGLE), _NOTHING * prior.size),
        determined=0.0,
        evidence=log_evidence(info.spare, cost, logdet),
    )


def known_sizes(info: Information, prior: Prior, sizes: Mapping[str, float], variance: float) -> Posterior:
    """The posterior for known sizes and a known noise variance.

    For surveyed points the std keeps the given variance, because their stated sizes do not follow the
    residuals. Raises `numpy.linalg.LinAlgError` if the points do not determine the cameras.
    """
    parts = _Parts(info, prior, flat=False)
    noise = np.sqrt(variance)
    found = parts.posterior(parts.at({name: size / noise for name, size in sizes.items()}))
    return found if prior.stated is None else replace(found, variance=variance)


def minimum_of(
    info: Information, prior: Prior, sizes: Mapping[str, float], variance: float
) -> tuple[Array, Array]:
    """Step (f,) of the cameras and offsets (n, 3) of `known_sizes`, without the covariances."""
    parts, noise = _Parts(info, prior, flat=False), np.sqrt(variance)
    ratios = {name: size / noise for name, size in sizes.items()}
    step, smooth, single = parts.system.minimum(parts.of_smooth(ratios), parts.of_points(ratios))
    return step, np.asarray(prior.basis @ smooth + single)


def quadratic_at(info: Information, prior: Prior) -> Callable[[float], tuple[float, float]]:
    """Minimum and log determinant for surveyed points, as a function of factor over noise std.

    The log determinant is that of H minus that of the precisions.
    """
    parts = _Parts(info, prior, flat=False)

    def at(ratio: float) -> tuple[float, float]:
        single = parts.of_points({_STATED: ratio})
        cost, logdet = parts.system.least(np.zeros(0), single)
        return max(cost, _NO_COST), logdet - float(np.log(single).sum())

    return at


def prior_covariance(prior: Prior, sizes: Mapping[str, float]) -> Array:
    """(3 n, 3 n) prior covariance of the offsets along each point's axes, for given sizes [world unit]."""
    n, m = len(prior.axes), prior.basis.shape[2]
    if prior.stated is not None:
        return np.diag((sizes[_STATED] * prior.stated.ravel()) ** 2)
    weight = np.empty(m)
    for name, places in prior.groups.items():
        weight[places] = (sizes[name] / prior.size) ** 2
    basis = prior.basis.reshape(3 * n, m)
    own = np.tile([sizes["place"], sizes["place"], sizes["height"]], n) ** 2
    return np.asarray((basis * weight) @ basis.T + np.diag(own))


@frozen_dataclass(eq=False)
class _Solution:
    """The quadratic solved for one set of sizes, which are in units of the noise's standard deviation."""

    ratios: dict[str, float]
    solved: Solved
    variance: float
    evidence: float


class _Parts:
    """The parts of the offsets with their sizes."""

    def __init__(self, info: Information, prior: Prior, flat: bool, least_gain: float = _NO_GAIN) -> None:
        self.least_gain = least_gain
        self.system, self.prior, self.flat = System(info, prior), prior, flat
        self.least, self.stretch = _NOTHING * prior.size, STRETCH * prior.size
        self.spare, self.log_precision = info.spare, info.log_precision

    def allowed(self, sizes: Mapping[str, float]) -> dict[str, float]:
        """The sizes, without out-of-plane parts if the target must stay flat."""
        return dict(sizes) | {name: self.least for name in _OUT_OF_PLANE if self.flat and name in sizes}

    def at(self, ratios: dict[str, float]) -> _Solution:
        smooth, single = self.of_smooth(ratios), self.of_points(ratios)
        solved = self.system.solve(smooth, single)
        logprior = float(np.log(smooth).sum()) + float(np.log(single).sum()) + self.log_precision
        evidence = log_evidence(self.spare, solved.cost, solved.logdet - logprior)
        return _Solution(ratios, solved, solved.cost / self.spare, evidence)

    def of_smooth(self, ratios: Mapping[str, float]) -> Array:
        """(m,) precisions of the smooth coefficients, in units of the noise precision."""
        smooth = np.empty(self.system.m)
        for name, places in self.prior.groups.items():
            smooth[places] = (self.prior.size / ratios[name]) ** 2
        return smooth

    def of_points(self, ratios: Mapping[str, float]) -> Array:
        """(n, 3) precisions of the single points' parts, in units of the noise precision."""
        if self.prior.stated is not None:
            return np.asarray((ratios[_STATED] * self.prior.stated) ** -2)
        place, height = (ratios[name] ** -2 for name in _SINGLE)
        return np.tile([place, place, height], (self.system.n, 1))

    def _parts(self, now: _Solution) -> Iterator[tuple[str, float, int, float, float]]:
        """Name, size, number, sum of squares and sum of variances of each part's coefficients."""
        solved, prior = now.solved, self.prior
        for name, places in prior.groups.items():
            w = solved.smooth[places]
            size = now.ratios[name] / prior.size
            yield name, size, len(w), float(w @ w), solved.smooth_variance(places)
        variance, squares = solved.single_variance(), solved.single**2
        if prior.stated is not None:
            squares, variance = squares / prior.stated**2, variance / prior.stated**2
            yield _STATED, now.ratios[_STATED], squares.size, float(squares.sum()), float(variance.sum())
            return
        for name, columns in _SINGLE.items():
            w2 = squares[:, columns]
            yield name, now.ratios[name], w2.size, float(w2.sum()), float(variance[:, columns].sum())

    def renewed(self, now: _Solution) -> tuple[dict[str, float], dict[str, float]]:
        """MacKay's update of the sizes, and the slopes of the log evidence by the logarithms of the sizes.

        The step is lengthened for parts that the data hardly determine, where MacKay's step is too short.
        """
        new, slope, noise = {}, {}, math.sqrt(now.variance)
        for name, size, number, squares, variance in self._parts(now):
            share = min(max(1.0 - variance / (number * size**2), 1e-6), 1.0)
            change = squares / number / (size * noise) ** 2 / share
            slope[name] = number * share * (change - 1.0)
            least, most = self.least, self.prior.size
            if name == "stretch":
                least, most = (self.stretch, _MOST * most) if self.is_stretched(now) else (least, least)
            wanted = now.ratios[name] * change ** (1.0 - 0.5 * share)
            new[name] = min(max(wanted, least / noise), most / noise)
        allowed = self.allowed({name: ratio * noise for name, ratio in new.items()})
        return {name: size / noise for name, size in allowed.items()}, slope

    def is_stretched(self, now: _Solution) -> bool:
        """Whether the stretch has the size of prints."""
        return now.ratios["stretch"] * float(np.sqrt(now.variance)) > np.sqrt(self.stretch * self.least)

    def with_stretch_changed(self, now: _Solution) -> dict[str, float]:
        """The sizes with the stretch switched on or off."""
        size = self.least if self.is_stretched(now) else self.stretch
        return now.ratios | {"stretch": size / float(np.sqrt(now.variance))}

    def climbed(self, now: _Solution) -> _Solution:
        """Ascend to the most probable sizes; steps grow for sizes that keep changing in one direction."""
        before, reach = dict.fromkeys(now.ratios, 0.0), dict.fromkeys(now.ratios, 1.0)
        for _ in range(_PASSES):
            wanted, slope = self.renewed(now)
            step = {name: math.log(wanted[name] / ratio) for name, ratio in now.ratios.items()}
            if max(map(abs, step.values())) < _SETTLED:
                break
            reach = {
                name: min(2 * reach[name], _FARTHEST) if by * before[name] > 0 else 1.0
                for name, by in step.items()
            }
            wanted = self.beyond(now, step, reach)
            promised = sum(by * np.log(wanted[name] / now.ratios[name]) for name, by in slope.items())
            if 0.5 * promised < self.least_gain:
                break
            better = self.better(now, wanted)
            gain, now, before = better.evidence - now.evidence, better, step
            if gain < self.least_gain:
                break
        return now

    def beyond(self, now: _Solution, step: dict[str, float], reach: dict[str, float]) -> dict[str, float]:
        """Sizes after the given multiples of steps in their logarithms; a stretch has its own limits."""
        noise, beyond = math.sqrt(now.variance), {}
        for name, ratio in now.ratios.items():
            if name == "stretch":
                beyond[name] = ratio * math.exp(step[name])
                continue
            size = ratio * noise * math.exp(step[name] * reach[name])
            beyond[name] = min(max(size, self.least), self.prior.size) / noise
        return beyond

    def better(self, now: _Solution, wanted: dict[str, float]) -> _Solution:
        """A solution with higher evidence on the way to the wanted sizes, by step halving, or this one."""
        for halvings in range(_HALVINGS):
            part = 0.5**halvings
            found = self.at({name: r * (wanted[name] / r) ** part for name, r in now.ratios.items()})
            if found.evidence > now.evidence:
                return found
        return now

    def posterior(self, now: _Solution) -> Posterior:
        prior, solved, noise = self.prior, now.solved, math.sqrt(now.variance)
        determined = sum(number - variance / size**2 for _, size, number, _, variance in self._parts(now))
        return Posterior(
            offsets=(prior.basis @ solved.smooth) + solved.single,
            variance=now.variance,
            camera_step=solved.camera,
            camera=solved.camera_root.T @ solved.camera_root,
            sizes={name: ratio * noise for name, ratio in now.ratios.items()},
            determined=determined,
            evidence=now.evidence,
            solved=(solved, prior, self.system.gauge),
        )

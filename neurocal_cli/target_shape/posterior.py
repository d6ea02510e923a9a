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
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import unit_diagonal
from neurocal_cli.target import Target
from neurocal_cli.target_shape.information import Information
from neurocal_cli.target_shape.prior import STATED, STRETCH, Prior
from neurocal_cli.target_shape.system import JointCovariance, Solved, system_of


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
    # The covariance of cameras, offsets and poses and the gauge (3 n, g); None if the points stay as given.
    joint: tuple[Callable[[], JointCovariance], Array] | None = None

    @property
    def followed(self) -> Array:
        """(f, n, 3) S_cd S_dd^-1: regression of the cameras' scores on those of the offsets."""
        whole = np.zeros((len(self.camera), *self.offsets.shape))
        if self.joint is None or not len(whole):
            return whole
        joint = self.joint[0]()
        along = joint.camera_root.T @ joint.offset_root
        return np.asarray(-np.linalg.solve(self.camera, along).reshape(whole.shape))

    @property
    def std(self) -> Array:
        """(n, 3) standard deviations of the offsets, along each point's axes [world unit]."""
        if self.joint is None:
            return np.zeros_like(self.offsets)
        joint, gauge = self.joint
        return np.sqrt(self.variance * np.maximum(joint().offset_variance(gauge), 0.0))

    @property
    def poses(self) -> Array | None:
        """(P, 6, 6) covariance of each pose in units of the noise variance, with the target's gauge held."""
        if self.joint is None:
            return None
        joint, gauge = self.joint
        return joint().poses(gauge)


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
    start = sizes or {name: _START[name] * prior.size for name in prior.names}
    now = parts.climbed(parts.at({name: size / noise for name, size in parts.allowed(start).items()}))
    if with_stretch and "stretch" in now.ratios:
        other = parts.climbed(parts.with_stretch_changed(now))
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
        sizes=dict.fromkeys(prior.names, _NOTHING * prior.size),
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


def posterior_of(target: Target, info: Information, prior: Prior, variance: float) -> Posterior:
    """The posterior of the offsets of an estimated target; with bends, they are integrated out."""
    if target.bends is not None:
        info = info.held(variance / target.bends.size**2)
    if target.only_bends:
        return given_posterior(info, prior)
    return known_sizes(info, prior, target.sizes, variance)


def minimum_of(
    info: Information, prior: Prior, sizes: Mapping[str, float], variance: float
) -> tuple[Array, Array]:
    """Step (f,) of the cameras and offsets (n, 3) of `known_sizes`, without the covariances."""
    noise = math.sqrt(variance)
    return system_of(info, prior).minimum({name: size / noise for name, size in sizes.items()})


def quadratic_at(info: Information, prior: Prior) -> Callable[[float], tuple[float, float]]:
    """Minimum and log determinant for surveyed points, as a function of factor over noise std.

    The log determinant is that of H minus that of the precisions.
    """
    system = system_of(info, prior)

    def at(ratio: float) -> tuple[float, float]:
        cost, logdet = system.least({STATED: ratio})
        return max(cost, _NO_COST), logdet

    return at


def prior_covariance(prior: Prior, sizes: Mapping[str, float]) -> Array:
    """(3 n, 3 n) prior covariance of the offsets along each point's axes, for given sizes [world unit]."""
    basis = prior.basis.reshape(3 * len(prior.axes), -1)
    smooth = (basis * prior.of_coefficients(sizes)) @ basis.T
    return np.asarray(smooth + np.diag(prior.of_points(sizes).ravel()))


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
        self.system, self.prior, self.flat = system_of(info, prior), prior, flat
        self.least, self.stretch = _NOTHING * prior.size, STRETCH * prior.size
        self.spare, self.log_precision = info.spare, info.log_precision
        self.gauge = prior.gauge if len(info.pose) else prior.gauge[:, :0]

    def allowed(self, sizes: Mapping[str, float]) -> dict[str, float]:
        """The sizes, without out-of-plane parts if the target must stay flat."""
        return dict(sizes) | {name: self.least for name in _OUT_OF_PLANE if self.flat and name in sizes}

    def at(self, ratios: dict[str, float]) -> _Solution:
        return self._solution(ratios, self.system.solve(ratios))

    def _solution(self, ratios: dict[str, float], solved: Solved) -> _Solution:
        if not solved.cost > 0:  # rounding: without a camera that fits at all, the quadratic means nothing
            raise np.linalg.LinAlgError("the least squared error is not positive")
        evidence = log_evidence(self.spare, solved.cost, solved.logdet - self.log_precision)
        return _Solution(ratios, solved, solved.cost / self.spare, evidence)

    def renewed(self, now: _Solution) -> tuple[dict[str, float], dict[str, float]]:
        """MacKay's update of the sizes, and the slopes of the log evidence by the logarithms of the sizes.

        The step is lengthened for parts that the data hardly determine, where MacKay's step is too short.
        """
        new, slope, noise = {}, {}, math.sqrt(now.variance)
        for name, part in now.solved.parts.items():
            share = min(max(part.determined / part.number, 1e-6), 1.0)
            change = part.squares / (part.number * now.variance * share)
            slope[name] = part.number * share * (change - 1.0)
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

    def with_stretch_changed(self, now: _Solution) -> _Solution:
        """The solution with the stretch switched on or off."""
        size = self.least if self.is_stretched(now) else self.stretch
        ratios = now.ratios | {"stretch": size / math.sqrt(now.variance)}
        return self._solution(ratios, now.solved.changed(ratios, "stretch"))

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
        solved, noise = now.solved, math.sqrt(now.variance)
        return Posterior(
            offsets=solved.offsets,
            variance=now.variance,
            camera_step=solved.camera_step,
            camera=solved.camera,
            sizes={name: ratio * noise for name, ratio in now.ratios.items()},
            determined=sum(part.determined for part in solved.parts.values()),
            evidence=now.evidence,
            joint=(solved.joint, self.gauge),
        )

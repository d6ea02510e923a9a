"""Posterior of the offsets of the target's points, with the sizes of the prior estimated by empirical Bayes.

In units of the noise variance, the squared error and the prior form one quadratic

    E = |r|^2 + sum_g lambda_g |w_g|^2,    lambda_g = sigma^2 / size_g^2,

in the cameras, the poses and the parts w of the offsets (`system`). The sizes maximise the evidence (MacKay
1992). Of the n_g coefficients of a part, the data determine

    gamma_g = n_g - lambda_g tr (H^-1)_gg,    gamma_g = lambda_g |w_g|^2 / sigma^2 at the maximum.

The difference of both sides is the slope by the logarithm of the size. Newton's steps lead to the maximum,
with the average information (Gilmour, Thompson and Cullis 1995) as the curvature.

Stretch and lean have one coefficient each, which does not determine its size. So each is absent, or has at
least the size of those of prints, whichever is more probable. Noise may hide an absent one; the covariance
contains this possibility.

The evidence, with the noise variance marginalised as well, decides whether there are offsets at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.board.information import Information
from neurocal_cli.adjustment.board.prior import LEAN, NOTHING, STATED, STRETCH, Gauge, Prior
from neurocal_cli.adjustment.board.system import JointCovariance, Solved, System, system_of
from neurocal_cli.adjustment.normal_equations import unit_diagonal
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.observations.target import STRETCHED, Target


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
    # The covariance of cameras, offsets and poses and the gauge; None if the points stay as given.
    joint: tuple[Callable[[], JointCovariance], Gauge] | None = None

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


OUT_OF_PLANE = ("curl", "twist", "bend", "height")
"""Parts that move points out of their plane."""
_SWITCHED = ("stretch", "lean")
_START = {
    "fold": 6e-4,
    "curl": 6e-4,
    "twist": 6e-4,
    "bend": 6e-4,
    "stretch": STRETCH,
    "lean": STRETCH,
    "warp": 1e-4,
    "place": 6e-5,
    "height": 6e-5,
}  # of the target's size
# Least gain in log evidence with which a stretch or a lean is estimated, as by the odds in `open_stretch`.
# With 0, errors from five views of bent boards are 5 to 10 % larger (test_simulated_targets.py, slow).
_SEEN = math.log(5.0)
_NEARLY = 0.99  # of the largest size of prints, from which on a wrong description is tried
_CERTAIN = 500.0  # largest log odds: more overflows
_LEAST_SHARE = 1e-9  # of its prior variance that a coefficient keeps
# Least size of the fold over the target's size: planes are set up by hand, not better than to 0.1 mm of 200.
# Without it, a stretch and a lean may explain one view of two planes, and the centre is off by eight standard
# deviations (test_folded_targets.py, slow).
_BY_HAND = 5e-4
_MOST = 2e-3  # largest size of a stretch over the target's size: a skew of the image axes looks like one
# Of a flat target that is described wrongly: the least and largest size, half of the difference of two sides,
# and the log evidence that it has to gain, as all causes.
_DESCRIBED, _MOST_DESCRIBED, _GAIN = 0.5 * STRETCHED, 3e-2, 6.0
# Least predicted gain in log evidence of a step. With these, cameras differ by 0.002 standard deviations rms
# from those with 1e-5; 207 sets of boards of all shapes by tests/support/targets.py.
_NO_GAIN = 0.002
_NO_GAIN_YET = 0.5  # the same from arbitrary initial sizes, around a target that will still move
# Longest step of the logarithm of a size, and largest factor by which it grows. With these, 48 boards of
# eight shapes in 5 to 40 views need 15.5 solutions of the system; with longest steps of 2 and 5, 15.9 and
# 15.5.
_LONGEST, _GROWTH = 3.0, 7.0
_LEAST_CURVATURE = 1e-3  # of the log evidence by the logarithm of a size: absent parts have none
_AT_MOST = 2.0  # times the promised gain, which is that of a quadratic
_AT_LEAST = 1.01  # times the least ratio; the noise has changed since a part was set to the least
_HALVINGS = 6
_PASSES = 40
_NO_COST = 1e-300  # lower bound of a cost, which rounding may make negative


def evidence_of_given(*cameras: Information) -> float:
    """Log evidence of the given target, from cameras that share no unknowns."""
    parts = [(info.spare, *_as_given(info)[2:]) for info in cameras]
    return log_evidence(*(sum(part) for part in zip(*parts, strict=True)))


def _as_given(info: Information) -> tuple[Array, Array, float, float]:
    """Covariance of the cameras for unit noise, their step, the cost and the log determinant of all."""
    S, g, cost, of_poses = _poses_eliminated(info)
    inverse = np.asarray(np.linalg.inv(S), dtype=float)
    step = inverse @ g
    logdet = of_poses + float(np.linalg.slogdet(S)[1]) - info.log_precision
    return inverse, step, cost - float(g @ step), logdet


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
    root = np.linalg.inv(np.linalg.cholesky(info.cameras.own))
    rows = root @ info.cameras.cross
    flat = rows.reshape(-1, rows.shape[2])
    M = info.cameras.shared - flat.T @ flat
    logdet = -2 * float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
    return M[:-1, :-1], M[:-1, -1], float(M[-1, -1]), logdet


def log_evidence(spare: float, cost: float, logdet: float) -> float:
    """Log evidence of a quadratic with this minimum and log determinant; variance prior 1 / sigma^2."""
    least = max(cost, _NO_COST)
    return math.lgamma(0.5 * spare) - 0.5 * spare * math.log(math.pi * least) - 0.5 * logdet


def posterior(
    info: Information,
    prior: Prior,
    sizes: Mapping[str, float] | None = None,
    absent: Collection[str] = (),
    variance: float | None = None,
    with_stretch: bool = True,
) -> Posterior:
    """Estimate the sizes of the parts, and the offsets.

    The quadratic is in the whole offsets from the given target, along each point's axes. With initial sizes
    [world unit], an initial noise variance [px^2] is needed as well, because then the errors on the given
    target are no noise. Parts that are named as absent stay absent, and `with_stretch` means that stretch and
    lean may be switched on or off. Raises `numpy.linalg.LinAlgError` if the points do not determine the
    cameras.
    """
    system = system_of(info, prior)
    climb = _Climb(info, prior, system, absent, _NO_GAIN_YET if sizes is None else _NO_GAIN)
    noise = math.sqrt(info.cost / info.spare if variance is None else variance)
    if sizes is not None:
        start = prior.as_array(sizes) / noise
    else:
        start = np.array([_START[name] for name in prior.names]) * prior.size / noise
    now = climb.climbed(climb.at(np.minimum(start, climb.most / noise)))
    for part in climb.switched if with_stretch else ():
        now = climb.on_or_off(now, part)
    return climb.posterior(climb.described(now) if with_stretch else now)


def given_posterior(info: Information, prior: Prior) -> Posterior:
    """The posterior with zero offsets: the points stay as given."""
    inverse, step, cost, logdet = _as_given(info)
    return Posterior(
        offsets=np.zeros((len(prior.axes), 3)),
        variance=cost / info.spare,
        camera_step=step,
        camera=inverse,
        sizes=dict.fromkeys(prior.names, NOTHING * prior.size),
        determined=0.0,
        evidence=log_evidence(info.spare, cost, logdet),
    )


def known_sizes(info: Information, prior: Prior, sizes: Mapping[str, float], variance: float) -> Posterior:
    """The posterior for known sizes and a known noise variance.

    The covariance contains stretch and lean as far as noise may hide them. For surveyed points the std keeps
    the given variance, because their stated sizes do not follow the residuals. Raises
    `numpy.linalg.LinAlgError` if the points do not determine the cameras.
    """
    climb = _Climb(info, prior, system_of(info, prior))
    now = climb.at(prior.as_array(sizes) / math.sqrt(variance))
    found, wider = climb.posterior(now), climb.with_open(now).solved
    found = replace(found, camera=wider.camera, joint=(wider.joint, climb.gauge))
    return found if prior.stated is None else replace(found, variance=variance)


def posterior_of(target: Target, info: Information, prior: Prior, variance: float) -> Posterior:
    """The posterior of the offsets of an estimated target; with bends, they are integrated out."""
    if target.bends is not None:
        info = info.held(variance / target.bends.size**2)
    if target.only_bends:
        return given_posterior(info, prior)
    return known_sizes(info, prior, target.sizes, variance)


def minimum_of(system: System, sizes: Mapping[str, float], variance: float) -> tuple[Array, Array]:
    """Step (f,) of the cameras and offsets (n, 3) of `known_sizes`, without the covariances."""
    noise = math.sqrt(variance)
    solved = system.solve({name: size / noise for name, size in sizes.items()})
    return solved.camera_step, solved.offsets()


def quadratic_at(info: Information, prior: Prior) -> Callable[[float], tuple[float, float]]:
    """Minimum and log determinant for surveyed points, as a function of factor over noise std.

    The log determinant is that of H minus that of the precisions.
    """
    system = system_of(info, prior)

    def at(ratio: float) -> tuple[float, float]:
        solved = system.solve({STATED: ratio})
        return max(solved.cost, _NO_COST), solved.logdet

    return at


def prior_covariance(prior: Prior, sizes: Mapping[str, float]) -> Array:
    """(3 n, 3 n) prior covariance of the offsets along each point's axes, for given sizes [world unit]."""
    basis = prior.basis.reshape(3 * len(prior.axes), -1)
    of_smooth, of_single = prior.variances(sizes)
    return np.asarray((basis * of_smooth) @ basis.T + np.diag(of_single.ravel()))


@frozen_dataclass(eq=False)
class _Solution:
    """The quadratic solved for one set of sizes."""

    ratios: Array  # (G,) sizes of the parts in units of the noise's standard deviation
    solved: Solved
    variance: float
    evidence: float

    def size(self, part: int) -> float:
        """Size of a part [world unit]."""
        return float(self.ratios[part]) * math.sqrt(self.variance)


class _Climb:
    """The ascent to the most probable sizes of the parts."""

    def __init__(
        self,
        info: Information,
        prior: Prior,
        system: System,
        absent: Collection[str] = (),
        least_gain: float = _NO_GAIN,
    ) -> None:
        self.system, self.names, self.least_gain = system, prior.names, least_gain
        self.spare, self.log_precision = info.spare, info.log_precision
        self.gauge = prior.gauge if len(info.pose_point) else Gauge.none(len(info.point))
        held = [name in absent for name in self.names]
        self.least = np.full(len(self.names), NOTHING * prior.size)
        if "fold" in self.names:
            self.least[self.names.index("fold")] = _BY_HAND * prior.size
        self.most = np.where(held, self.least, prior.size)
        self.switched = [self.names.index(name) for name in _SWITCHED if name in self.names]
        self.of_prints = STRETCH * prior.size
        self.most_of_prints, self.size = _MOST * prior.size, prior.size

    def at(self, ratios: Array) -> _Solution:
        """The solution for these sizes of the parts."""
        solved = self.system.solve(self._named(ratios))
        if not solved.cost > 0:  # rounding: without a camera that fits at all, the quadratic means nothing
            raise np.linalg.LinAlgError("the least squared error is not positive")
        evidence = log_evidence(self.spare, solved.cost, solved.logdet - self.log_precision)
        return _Solution(ratios, solved, solved.cost / self.spare, evidence)

    def _named(self, ratios: Array) -> dict[str, float]:
        return dict(zip(self.names, ratios.tolist(), strict=True))

    def limits(self, now: _Solution) -> tuple[Array, Array]:
        """(G,) least and largest ratios; the same for a part that is held."""
        least, most = self.least.copy(), self.most.copy()
        for k in self.switched:
            on = self.is_on(now, k)
            of_print = now.size(k) < _DESCRIBED * self.size
            largest = self.most_of_prints if of_print else _MOST_DESCRIBED * self.size
            least[k], most[k] = (self.of_prints, largest) if on else (least[k], least[k])
        return least / math.sqrt(now.variance), most / math.sqrt(now.variance)

    def is_on(self, now: _Solution, part: int) -> bool:
        """Whether a stretch or a lean has the size of prints."""
        return now.size(part) > math.sqrt(self.of_prints * self.least[0])

    def changed(self, now: _Solution, new: Mapping[int, float]) -> _Solution:
        """The solution with new ratios of some parts."""
        ratios = now.ratios.copy()
        ratios[list(new)] = list(new.values())
        return self.at(ratios)

    def on_or_off(self, now: _Solution, part: int) -> _Solution:
        """The solution with or without a stretch or a lean, whichever is more probable."""
        on = self.is_on(now, part)
        size = self.least[0] if on else self.of_prints
        wanted = now.evidence + (-_SEEN if on else _SEEN)
        other = self.climbed(self.changed(now, {part: size / math.sqrt(now.variance)}), wanted)
        return other if other.evidence > wanted else now

    def described(self, now: _Solution) -> _Solution:
        """The solution with a stretch that no print has, if it is far more probable than one of a print."""
        if "fold" in self.names or "stretch" not in self.names:
            return now
        part = self.names.index("stretch")
        if now.size(part) < _NEARLY * self.most_of_prints:
            return now
        wanted, size = now.evidence + _GAIN, 2 * _DESCRIBED * self.size
        other = self.climbed(self.changed(now, {part: size / math.sqrt(now.variance)}), wanted)
        return other if other.evidence > wanted else now

    def with_open(self, now: _Solution) -> _Solution:
        """The solution whose covariance contains stretch and lean as far as noise may hide them.

        What is switched off is there with the probability p. If it were, its coefficient would have the
        posterior mean m and variance v, and the other unknowns would follow it. Averaged over both, its
        second moment around 0 is ``p (v + m^2)``, which is its posterior variance for some smaller prior.
        """
        noise, wider = math.sqrt(now.variance), {}
        for part in self.switched:
            if self.is_on(now, part):
                continue
            on = self.changed(now, {part: self.of_prints / noise})
            # In units of the prior's variance.
            v = max(1.0 - float(on.solved.parts().determined[part]), _LEAST_SHARE)
            squared = float(on.solved.parts().squares[part]) / on.variance
            p = 1.0 / (1.0 + math.exp(min(now.evidence - on.evidence, _CERTAIN)))
            precision = 1.0 / (p * (v + squared)) - (1.0 / v - 1.0)
            share = 1.0 / math.sqrt(precision) if precision > 1.0 else 1.0
            if self.names[part] == "lean":
                share = max(share, LEAN / STRETCH)
            ratio = share * self.of_prints / noise
            if ratio > now.ratios[part]:
                wider[part] = ratio
        return self.changed(now, wider) if wider else now

    def climbed(self, now: _Solution, wanted: float = -math.inf) -> _Solution:
        """Ascend to the most probable sizes, unless they will not have the wanted log evidence."""
        for _ in range(_PASSES):
            ratios, promised = self.renewed(now)
            if promised < self.least_gain or now.evidence + _AT_MOST * promised < wanted:
                break
            better = self.better(now, ratios)
            gain, now = better.evidence - now.evidence, better
            if gain < self.least_gain:
                break
        return now

    def renewed(self, now: _Solution) -> tuple[Array, float]:
        """The ratios after a step towards the maximum, and the gain in log evidence that it promises.

        It is Newton's step, damped where the slope is large. Growing sizes take it in their inverse squares,
        in which the evidence of a part that the data determine is nearly a quadratic.
        """
        parts, (least, most) = now.solved.parts(), self.limits(now)
        squares = parts.squares / now.variance
        slope = squares - parts.determined
        H = 2 * (parts.coupling / now.variance - np.outer(squares, squares) / self.spare)
        H[np.diag_indices(len(H))] += np.abs(slope) / _LONGEST + _LEAST_CURVATURE
        inside = np.where(slope > 0, now.ratios < most, now.ratios > _AT_LEAST * least)
        free = np.flatnonzero(inside & (least < most))
        step = np.zeros(len(slope))
        step[free] = np.linalg.solve(H[free[:, None], free], slope[free])
        promised = 0.5 * float(slope @ step)
        grown = -0.5 * np.log(np.maximum(1.0 - 2.0 * step, _GROWTH**-2))
        ratios = now.ratios * np.exp(np.where(step > 0, grown, step))
        return np.clip(ratios, least, most), promised

    def better(self, now: _Solution, wanted: Array) -> _Solution:
        """A solution with higher evidence on the way to the wanted ratios, by step halving, or this one."""
        for halvings in range(_HALVINGS):
            found = self.at(now.ratios * (wanted / now.ratios) ** 0.5**halvings)
            if found.evidence > now.evidence:
                return found
        return now

    def posterior(self, now: _Solution) -> Posterior:
        """The posterior for the sizes of a solution."""
        solved, noise = now.solved, math.sqrt(now.variance)
        return Posterior(
            offsets=solved.offsets(),
            variance=now.variance,
            camera_step=solved.camera_step,
            camera=solved.camera,
            sizes=self._named(now.ratios * noise),
            determined=float(solved.parts().determined.sum()),
            evidence=now.evidence,
            joint=(solved.joint, self.gauge),
        )

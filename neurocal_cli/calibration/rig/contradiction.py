"""Test whether the pairs of views agree on one rig, and find the best explanation if they do not.

With one rig for all pairs the sum of squares of `relative_poses` is a chi-squared variable of 6 (P - 1)
degrees of freedom. Each explanation adds a few unknowns: a second rig, another size of the target or a
second focal length from some pair on, or a share of the target's motion from pair to pair. Where the target
is larger than its points say, both cameras seem nearer to it, and nothing but the baseline seems shorter. The
Bayesian information criterion compares them:

    N log(s^2) + p log N,

with N equations, p added unknowns and s^2 the sum of squares over its degrees of freedom, but at least 1,
because smaller values arise by chance. Pairs that contradict most others are found by least trimmed squares.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.chi_squared import exceeded_by_chance
from neurocal_cli.adjustment.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.calibration.rig.relative_poses import RelativePoses
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median

# Kass and Raftery (1995) call a difference of 10 in the criterion very strong evidence.
_VERY_STRONG = 10.0
_LEVEL = 3.09  # standard deviations of a normal variable, exceeded by chance once in 1000
# An explanation must leave no more than chance does, or no more than this share of the rms. Relative poses
# that merely scatter often fall into two unequal parts; test_scatter_is_not_taken_for_a_change repeats it.
_LEFT = 0.3
_LEAST_PAIRS = 2  # of each part; a single pair that differs is an odd one
# The squared distance of a sound pair from the rig is a chi-squared variable of 6 degrees of freedom, whose
# median is 5.35. Real cameras deviate from their models, so the median distance of all pairs replaces it
# where it is larger. The limit of 60 has the probability 5e-11;
# test_a_pair_not_taken_at_the_same_moment_is_named has pairs on both sides.
MEDIAN = 5.35
SUSPECT = 60.0
# The distance must also exceed this multiple of the pair's equations: the pair's rms error is twice as large
# with the rig as without it.
_OWN_SHARE = 3.0
_MOST_STARTS = 40
_STEPS = 10  # most concentration steps; fewer suffice
# The cameras whose focal length changed.
FOCAL = {"left focal": (0,), "right focal": (1,), "both focal": (0, 1)}


@frozen_dataclass(eq=False)
class Contradiction:
    """How much the pairs contradict one rig, and why.

    The best explanation is one of: pairs that contradict the others ("odd"); the rig moved between two pairs;
    from some pair on the target has another size, so that only the length of the baseline differs; the focal
    length of a camera, or of both, changed between two pairs; the right images were taken later ("late"), or
    earlier, than the left ones. It is empty where none is needed, or none is found.
    """

    kind: str  # "", "odd", "moved", "size", one of FOCAL, "late", "early"
    at: int  # first pair after the change
    # Relative change of the focal length or the baseline, or share of the motion to the next (previous) pair.
    amount: float
    degrees: int  # of freedom of the scatter
    odd: NDArray[np.bool_]  # (P,) pairs that contradict the others
    scatter: float  # rms of the relative poses of all but the odd pairs about one rig, over that of noise
    rest: float  # the same after the explanation
    gain: float  # rms of what the explanation explains, over that of noise
    growth: float  # rms residual of the common fit over that of both cameras alone
    shift: Array  # (2, F) how far off the unknowns of the common fit are before and after a change

    @property
    def is_significant(self) -> bool:
        """Whether the pairs scatter about one rig by more than chance."""
        return is_significant(self.scatter**2 * self.degrees, self.degrees)


def is_significant(squares: float, degrees: int) -> bool:
    """Whether a sum of squares is larger than by chance: a chi-squared test at the level of 0.001.

    Examples
    --------
    >>> is_significant(70.0, 54), is_significant(100.0, 54)
    (False, True)
    """
    return degrees > 0 and bool(squares / degrees > exceeded_by_chance(degrees, _LEVEL))


def contradiction(
    poses: RelativePoses, used: NDArray[np.bool_] | None = None, seek_odd: bool = True
) -> Contradiction:
    """Explain how the relative poses of the used pairs (P,) differ; by default of all.

    Pairs that contradict most others are one of the explanations, but not with `seek_odd` False, after such
    pairs have been left out: some of the remaining ones would always be the oddest.
    """
    used = np.ones(len(poses), dtype=bool) if used is None else used
    whole = _OneRig(poses, used)
    found = _best(whole)
    if seek_odd and is_significant(whole.squares, whole.degrees):
        odd = odd_pairs(poses, used)
        rest = _OneRig(poses, used & ~odd)
        if odd.any() and rest.score(None, 6 * int(odd.sum())) < whole.score(found):
            return _as_contradiction(rest, _best(rest), odd)
    return _as_contradiction(whole, found, np.zeros_like(used))


def _as_contradiction(one: _OneRig, found: _Explanation | None, odd: NDArray[np.bool_]) -> Contradiction:
    poses, n, squares = one.poses, one.degrees, one.squares
    growth = float(np.sqrt((poses.spare + squares) / (poses.spare + n)))
    scatter = float(np.sqrt(squares / n)) if n else 0.0
    none = np.zeros((2, poses.design.shape[2]))
    if found is None:
        return Contradiction("odd" if odd.any() else "", 0, 0.0, n, odd, scatter, scatter, 0.0, growth, none)
    left = max(squares - found.gain, 0.0) / max(n - len(found.values), 1)
    amount = float(found.values[0]) if found.kind in ("late", "early") else 0.0
    if found.kind in FOCAL:
        size = 1.0 if found.kind == "both focal" else _focal(poses, FOCAL[found.kind][0])
        amount = float(np.mean(found.values / size))
    if found.kind == "size":
        baseline = poses.reference + (poses.solution(one.used) - found.shift[0])[poses.rig[3:]]
        amount = float(found.values[0] * (poses.reference @ baseline) / max(baseline @ baseline, 1e-300))
    gain = float(np.sqrt(found.gain / len(found.values)))
    return Contradiction(
        found.kind, found.at, amount, n, odd, scatter, float(np.sqrt(left)), gain, growth, found.shift
    )


@frozen_dataclass(eq=False)
class _OneRig:
    """The common fit of the used pairs with one rig."""

    poses: RelativePoses
    used: NDArray[np.bool_]  # (P,)

    @property
    def degrees(self) -> int:
        """Degrees of freedom of `squares`."""
        return max(6 * (int(self.used.sum()) - 1), 0)

    @cached_property
    def squares(self) -> float:
        """Sum of squares, over that of the cameras alone."""
        poses = self.poses
        S, g = poses.normal(self.used)
        solved = solve_scaled(S, g[:, None])[:, 0]
        alone = poses.cameras.g.sum(axis=0)[:-6]
        own = solve_scaled(poses.cameras.S.sum(axis=0)[:-6, :-6], alone[:, None])[:, 0]
        return max(float(poses.pairs.cost[self.used].sum() - g @ solved + alone @ own), 0.0)

    def score(self, found: _Explanation | None, more: int = 0) -> float:
        """The criterion with an explanation, or with `more` unknowns."""
        n = 6 * len(self.poses)
        gain, unknowns = (0.0, more) if found is None else (found.gain, found.unknowns)
        spare = self.degrees - (0 if found is None else unknowns)
        rest = (self.squares - gain) / spare if spare > 0 else np.inf
        return float(n * np.log(max(rest, 1.0)) + unknowns * np.log(n))

    def rest_is_small(self, found: _Explanation) -> bool:
        """Whether the rest after an explanation is insignificant, or small compared with the whole."""
        left, spare = self.squares - found.gain, self.degrees - len(found.values)
        if spare < 1:
            return False
        return left / spare <= _LEFT**2 * self.squares / self.degrees or not is_significant(left, spare)


@frozen_dataclass(eq=False)
class _Explanation:
    """One explanation: its gain in the sum of squares, its unknowns and their values."""

    kind: str
    at: int
    gain: float
    values: Array
    shift: Array

    @property
    def unknowns(self) -> int:
        """Unknowns that it costs. Both focal lengths mimic a small turn of the rig, so they cost as much."""
        return 6 if self.kind == "both focal" else len(self.values)


def _best(one: _OneRig) -> _Explanation | None:
    """The explanation with the lowest criterion, if the evidence for it is very strong."""
    every = (*_changes(one.poses, one.used), *_motions(one.poses, one.used))
    found = [explanation for explanation in every if one.rest_is_small(explanation)]
    if not found:
        return None
    best = min(found, key=one.score)
    # The search over all places of a change counts as one more unknown.
    dear = _VERY_STRONG + (np.log(6 * len(one.poses)) if best.at else 0.0)
    return best if one.score(best) < one.score(None) - dear else None


def _changes(poses: RelativePoses, used: NDArray[np.bool_]) -> Iterator[_Explanation]:
    """A second rig, another size or a second focal length from some pair on: the best place of each kind."""
    places = np.flatnonzero(used)
    if len(places) < 2 * _LEAST_PAIRS:
        return
    S, g = poses.normal(used)
    inverse = solve_scaled(S, np.eye(len(S)), ROUNDING)
    x = inverse @ g
    starts = places[_LEAST_PAIRS : len(places) - _LEAST_PAIRS + 1]

    def from_starts(of_pairs: Array) -> Array:
        return np.cumsum(of_pairs[::-1], axis=0)[::-1][starts]

    after_S = from_starts(np.where(used[:, None, None], poses.pairs.S, 0.0))
    after_g = from_starts(np.where(used[:, None], poses.pairs.g, 0.0))
    own_S, own_g = (from_starts(of[poses.frame]) for of in (poses.cameras.S, poses.cameras.g))
    unknowns = np.eye(len(S))
    longer = np.zeros((len(S), 1))
    longer[poses.rig[3:], 0] = poses.reference
    kinds = [("moved", unknowns[:, poses.rig], after_S, after_g), ("size", longer, after_S, after_g)]
    zooms = np.zeros((len(S), 2))
    for side, (kind, columns) in enumerate(zip(("left focal", "right focal"), poses.focal, strict=True)):
        if len(columns):
            kinds.append((kind, unknowns[:, columns], after_S + own_S, after_g + own_g))
            zooms[columns, side] = _focal(poses, side)
    if zooms.any(axis=0).all():
        kinds.append(("both focal", zooms, after_S + own_S, after_g + own_g))
    for kind, step, S2, g2 in kinds:
        cross = S2 @ step
        follow = inverse @ cross
        block = step.T @ cross - np.swapaxes(cross, 1, 2) @ follow
        right = g2 @ step - np.swapaxes(cross, 1, 2) @ x
        values = solve_scaled(block, right[..., None], ROUNDING)[..., 0]
        gains = np.nan_to_num((values * right).sum(axis=1), nan=-np.inf)
        k = int(np.argmax(gains))
        before = follow[k] @ values[k]
        after = before - step @ values[k]
        yield _Explanation(kind, int(starts[k]), float(gains[k]), values[k], np.stack([before, after]))


def _focal(poses: RelativePoses, side: int) -> Array:
    """Alpha_u and alpha_v of one camera, normalised, or the one for both."""
    return np.asarray(poses.problem.cameras[side].entries[0, [0, 2][: len(poses.focal[side])]])


def _motions(poses: RelativePoses, used: NDArray[np.bool_]) -> Iterator[_Explanation]:
    """Right images that show the target on its way to the next, or from the previous, pair."""
    S, g = poses.normal(used)
    x = solve_scaled(S, g[:, None])[:, 0]
    weight = np.linalg.inv(poses.covariance)
    for kind, motion in zip(("late", "early"), np.moveaxis(poses.motion, 1, 0), strict=True):
        known = used & np.isfinite(motion).all(axis=1)
        if known.sum() < 2 * _LEAST_PAIRS:
            continue
        m = np.where(known[:, None], motion, 0.0)
        weighted = (weight @ m[..., None])[..., 0]
        cross = np.einsum("pif,pi->f", poses.design, weighted)
        follow = solve_scaled(S, cross[:, None], ROUNDING)[:, 0]
        block = float((m * weighted).sum() - cross @ follow)
        right = float((weighted * poses.offset).sum() - cross @ x)
        if not block > 0:
            continue
        value = right / block
        if 0 < value < 1:
            shift = np.broadcast_to(follow * value, (2, len(follow)))
            yield _Explanation(kind, 0, right * value, np.array([value]), shift)


def odd_pairs(poses: RelativePoses, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pairs that contradict most of the used ones, (P,) bool; none where there is no majority."""
    none = np.zeros(len(poses), dtype=bool)
    places = np.flatnonzero(used)
    if len(places) < 3:
        return none
    starts = places[np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_STARTS)).astype(int))]
    best, lowest = none, np.inf
    for start in starts:
        total, core = _concentrated(poses, places, start)
        if total < lowest:
            best, lowest = core, total
    for _ in range(_STEPS):
        distance = _predicted(poses, best)
        limit = SUSPECT * max(1.0, float(median(distance[places])) / MEDIAN)
        odd = used & (distance > limit) & (distance > _OWN_SHARE * poses.n_equations)
        if (best == (used & ~odd)).all():
            break
        best = used & ~odd
    return odd if 2 * odd.sum() < len(places) else none


def _concentrated(
    poses: RelativePoses, places: NDArray[np.intp], start: int
) -> tuple[float, NDArray[np.bool_]]:
    """The half of the pairs that is nearest to its own rig, and the sum of its squared distances from it.

    The search begins with the pairs nearest to one of them, and ends when the half stays the same.
    """
    half = len(places) // 2 + 1
    apart = poses.offset - poses.offset[start]
    together = poses.covariance + poses.covariance[start]
    distance = np.asarray((apart * np.linalg.solve(together, apart[..., None])[..., 0]).sum(axis=1))
    core = np.zeros(len(poses), dtype=bool)
    for _ in range(_STEPS):
        nearest = np.zeros_like(core)
        nearest[places[np.argsort(distance[places], kind="stable")[:half]]] = True
        if (nearest == core).all():
            break
        core = nearest
        distance = _predicted(poses, core)
    return float(np.sort(distance[places])[:half].sum()), core


def _predicted(poses: RelativePoses, core: NDArray[np.bool_]) -> Array:
    """(P,) squared distances from the rig of some pairs; of the others, with the uncertainty of that rig.

    Few pairs determine the rig poorly, because errors of both cameras bias it. Without this uncertainty,
    sound pairs might seem far off.
    """
    S, g = poses.normal(core)
    solved = solve_scaled(S, np.column_stack([np.eye(len(S)), g]))
    apart = poses.offset - poses.design @ solved[:, -1]
    spread = poses.design @ solved[:, :-1] @ np.swapaxes(poses.design, 1, 2)
    covariance = poses.covariance + np.where(core[:, None, None], 0.0, spread)
    return np.asarray((apart * solve_scaled(covariance, apart[..., None])[..., 0]).sum(axis=1))

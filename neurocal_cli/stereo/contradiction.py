"""Test whether the pairs of views agree on one rig, and find the best explanation if they do not.

With one rig for all pairs the sum of squares of `relative_poses` is a chi-squared variable of 6 (P - 1)
degrees of freedom. Each explanation adds a few unknowns: a second rig or a second focal length from some pair
on, or a share of the target's motion from pair to pair. The Bayesian information criterion compares them:

    N log(s^2) + p log N,

with N equations, p added unknowns and s^2 the sum of squares over its degrees of freedom, but at least 1,
because smaller values arise by chance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.chi_squared import exceeded_by_chance
from neurocal_cli.least_squares.normal_equations import ROUNDING, solve_scaled
from neurocal_cli.stereo.odd_pairs import odd_pairs
from neurocal_cli.stereo.relative_poses import RelativePoses

# Kass and Raftery (1995) call a difference of 10 in the criterion very strong evidence.
_VERY_STRONG = 10.0
_LEVEL = 3.09  # standard deviations of a normal variable, exceeded by chance once in 1000
# An explanation must leave no more than chance does, or no more than this share of the rms. Relative poses
# that merely scatter often fall into two unequal parts; test_scatter_is_not_taken_for_a_change repeats it.
_LEFT = 0.3
_LEAST_PAIRS = 2  # of each part; a single pair that differs is an odd one


@frozen_dataclass(eq=False)
class Contradiction:
    """How much the pairs contradict one rig, and why.

    Attributes
    ----------
    kind : {"", "odd", "moved", "left focal", "right focal", "late", "early"}
        The best explanation: pairs that contradict the others; the rig moved between two pairs; the focal
        length of a camera changed between two pairs; the right images were taken later, or earlier, than
        the left ones. Empty where none is needed, or none is found.
    at : int
        First pair after the change.
    amount : float
        Relative change of the focal length, or the share of the motion to the next (previous) pair.
    degrees : int
        Of freedom of the scatter.
    odd : (P,) bool array
        Pairs that contradict the others.
    scatter : float
        Rms of the relative poses about one rig, of all pairs but the odd ones, over what noise explains.
    rest : float
        The same after the explanation.
    gain : float
        Rms of what the explanation explains over what noise explains.
    growth : float
        Rms residual of the common fit over that of both cameras alone.
    shift : (2, F) array
        By how much the unknowns of the common fit are off before and after the change; 0 without one.
    """

    kind: str
    at: int
    amount: float
    degrees: int
    odd: NDArray[np.bool_]
    scatter: float
    rest: float
    gain: float
    growth: float
    shift: Array


@frozen_dataclass(eq=False)
class _Explanation:
    """One explanation: its gain in the sum of squares, its unknowns and their values."""

    kind: str
    at: int
    gain: float
    values: Array
    shift: Array


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
    """Explain how the relative poses of the used pairs differ.

    Parameters
    ----------
    poses : RelativePoses
    used : (P,) bool array, optional
        Pairs that are not known to be wrong; default all.
    seek_odd : bool
        Whether pairs that contradict most others are one of the explanations. Not after such pairs have been
        left out, because some of the remaining ones would always be the oddest.
    """
    used = np.ones(len(poses), dtype=bool) if used is None else used
    found = _best(poses, used)
    odd = np.zeros_like(used)
    if seek_odd and is_significant(_squares(poses, used), _degrees(used)):
        odd = odd_pairs(poses, used)
    if odd.any() and (_score(poses, used & ~odd, None, 6 * int(odd.sum())) < _score(poses, used, found)):
        return _as_contradiction(poses, used & ~odd, _best(poses, used & ~odd), odd)
    return _as_contradiction(poses, used, found, np.zeros_like(used))


def _as_contradiction(
    poses: RelativePoses, used: NDArray[np.bool_], found: _Explanation | None, odd: NDArray[np.bool_]
) -> Contradiction:
    n, squares = _degrees(used), _squares(poses, used)
    equations = poses.spare + max(n, 0)
    growth = float(np.sqrt((poses.spare + squares) / equations))
    scatter = float(np.sqrt(squares / n)) if n else 0.0
    none = np.zeros((2, poses.design.shape[2]))
    if found is None:
        return Contradiction("odd" if odd.any() else "", 0, 0.0, n, odd, scatter, scatter, 0.0, growth, none)
    left = max(squares - found.gain, 0.0) / max(n - len(found.values), 1)
    amount = float(found.values[0]) if found.kind in ("late", "early") else 0.0
    for side, kind in enumerate(("left focal", "right focal")):
        if found.kind == kind:
            amount = float(np.mean(found.values / poses.problem.cameras[side].entries[0, [0, 2]]))
    gain = float(np.sqrt(found.gain / len(found.values)))
    return Contradiction(
        found.kind, found.at, amount, n, odd, scatter, float(np.sqrt(left)), gain, growth, found.shift
    )


def _degrees(used: NDArray[np.bool_]) -> int:
    return max(6 * (int(used.sum()) - 1), 0)


def _squares(poses: RelativePoses, used: NDArray[np.bool_]) -> float:
    """Sum of squares of the used pairs with one rig, over that of the cameras alone."""
    S, g = poses.normal(used)
    solved = solve_scaled(S, g[:, None])[:, 0]
    alone = poses.cameras.g.sum(axis=0)[:-6]
    own = solve_scaled(poses.cameras.S.sum(axis=0)[:-6, :-6], alone[:, None])[:, 0] if len(alone) else alone
    return max(float(poses.pairs.cost[used].sum() - g @ solved + alone @ own), 0.0)


def _score(poses: RelativePoses, used: NDArray[np.bool_], found: _Explanation | None, more: int = 0) -> float:
    """The criterion of one rig for the used pairs, with an explanation or `more` unknowns."""
    n = 6 * len(poses)
    gain, unknowns = (0.0, more) if found is None else (found.gain, len(found.values))
    spare = _degrees(used) - (0 if found is None else unknowns)
    rest = (_squares(poses, used) - gain) / spare if spare > 0 else np.inf
    return float(n * np.log(max(rest, 1.0)) + unknowns * np.log(n))


def _best(poses: RelativePoses, used: NDArray[np.bool_]) -> _Explanation | None:
    """The explanation with the lowest criterion, if the evidence for it is very strong."""
    squares, n = _squares(poses, used), _degrees(used)
    found = [one for one in (*_changes(poses, used), *_motions(poses, used)) if _explains(one, squares, n)]
    if not found:
        return None
    best = min(found, key=lambda one: _score(poses, used, one))
    # The search over all places of a change counts as one more unknown.
    dear = _VERY_STRONG + (np.log(6 * len(poses)) if best.at else 0.0)
    return best if _score(poses, used, best) < _score(poses, used, None) - dear else None


def _explains(one: _Explanation, squares: float, n: int) -> bool:
    """Whether the rest after an explanation is insignificant, or small compared with the whole."""
    left, spare = squares - one.gain, n - len(one.values)
    if spare < 1:
        return False
    return left / spare <= _LEFT**2 * squares / n or not is_significant(left, spare)


def _changes(poses: RelativePoses, used: NDArray[np.bool_]) -> Iterator[_Explanation]:
    """A second rig, or a second focal length, from some pair on: the best place of each kind."""
    places = np.flatnonzero(used)
    if len(places) < 2 * _LEAST_PAIRS:
        return
    S, g = poses.normal(used)
    inverse = solve_scaled(S, np.eye(len(S)), ROUNDING)
    x = inverse @ g
    starts = places[_LEAST_PAIRS : len(places) - _LEAST_PAIRS + 1]
    pairs = np.where(used[:, None, None], poses.pairs.S, 0.0), np.where(used[:, None], poses.pairs.g, 0.0)
    after_S, after_g = (np.cumsum(block[::-1], axis=0)[::-1][starts] for block in pairs)
    own_S, own_g = (
        np.cumsum(block[poses.frame][::-1], axis=0)[::-1][starts]
        for block in (poses.cameras.S, poses.cameras.g)
    )
    kinds = [("moved", poses.rig, after_S, after_g)]
    for kind, columns in zip(("left focal", "right focal"), poses.focal, strict=True):
        if len(columns) == 2:
            kinds.append((kind, columns, after_S + own_S, after_g + own_g))
    for kind, columns, S2, g2 in kinds:
        cross = S2[:, :, columns]
        follow = inverse @ cross
        block = S2[:, columns[:, None], columns] - np.swapaxes(cross, 1, 2) @ follow
        right = g2[:, columns] - np.swapaxes(cross, 1, 2) @ x
        values = solve_scaled(block, right[..., None], ROUNDING)[..., 0]
        gains = np.nan_to_num((values * right).sum(axis=1), nan=-np.inf)
        k = int(np.argmax(gains))
        before = follow[k] @ values[k]
        after = before.copy()
        after[columns] -= values[k]
        yield _Explanation(kind, int(starts[k]), float(gains[k]), values[k], np.stack([before, after]))


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

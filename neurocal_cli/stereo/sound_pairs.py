"""Select the pairs of views that determine the rig, and diagnose the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Calibration
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array, rotation_step
from neurocal_cli.median import median
from neurocal_cli.stereo.adjust import RigProblem
from neurocal_cli.stereo.consensus import UNSYNCHRONISED, find_consensus
from neurocal_cli.stereo.contradiction import contradiction
from neurocal_cli.stereo.pairing import ViewPairs
from neurocal_cli.stereo.problem import rig_problem
from neurocal_cli.stereo.relative_poses import RelativePoses, in_order, relative_poses
from neurocal_cli.verdict.findings import name_some

MOVED = "taken"  # first word of the reason for pairs taken before or after the rig moved
_OTHER_SIZE = 1.2  # least ratio of target sizes that differ; in one series they are equal
_AGREED, _LEAST_AGREED = 0.8, 3  # share of the pairs, and fewest pairs, that must agree once shifted

Pair = tuple[str, str]


@frozen_dataclass(eq=False)
class SoundPairs:
    """Pairs that determine the rig, and the faults of the others."""

    problem: RigProblem  # of all pairs
    rig: Pose  # the rig of most pairs, the start of an adjustment
    left_out: Mapping[Pair, str] = field(default_factory=dict)  # pairs that do not determine it, and why
    moved: str = ""  # message about a rig that moved between two pairs
    by_chance: bool = False  # whether the pairs differ by no more than chance

    def contradiction(self, outliers: str = "reject") -> str:
        """Message with the pairs that are left out and their faults."""
        if self.moved:
            return self.moved
        n_pairs = len(self.problem.paired)
        found = describe_faults(self.left_out, n_pairs)
        if outliers == "keep" and 2 * len(self.left_out) < n_pairs:
            return f"{found}; remove them, or use --outliers reject"
        return f"{found}; check that the views of a pair show one target at one moment, in the same order"


def describe_faults(left_out: Mapping[Pair, str], n_pairs: int) -> str:
    """Describe pairs that are left out: their number, and the faults with the pairs of each."""
    by_reason: dict[str, list[str]] = {}
    for pair, reason in left_out.items():
        by_reason.setdefault(reason, []).append(pair_name(pair))
    parts = [f"{name_some(names)}: {reason}" for reason, names in by_reason.items()]
    return f"{len(left_out)} of {n_pairs} pairs of views contradict the rig ({'; '.join(parts)})"


def pair_name(pair: Pair) -> str:
    """The name of a pair of views for messages."""
    return pair[0] if pair[0] == pair[1] else f"{pair[0]}/{pair[1]}"


def span(pairs: Sequence[Pair]) -> str:
    """The names of pairs in a row, by the first and the last left view."""
    first, last = pairs[0][0], pairs[-1][0]
    return first if len(pairs) == 1 else f"{first} to {last}"


def sound_pairs(left: Calibration, right: Calibration, views: ViewPairs) -> SoundPairs:
    """Find the pairs that determine the rig; an error if half of them or more contradict each other."""
    problem = rig_problem(left, right, views)
    consensus = find_consensus(problem)
    reasons = dict(zip(problem.pairs, consensus.reasons, strict=True))
    # A fault that has a name is certain. The others may belong to a rig that moved.
    named = {pair: reason for pair, reason in reasons.items() if reason not in ("", UNSYNCHRONISED)}
    found = SoundPairs(problem, consensus.rig, {pair: reason for pair, reason in reasons.items() if reason})
    poses = relative_poses(problem, consensus.rig)
    if poses is not None:
        used = np.array([pair not in named for pair in poses.names])
        found = _explained(poses, used, found)
    if not found.moved and 2 * len(found.left_out) >= len(views.both):
        shifted = _shifted(left, right, views)
        raise DegenerateGeometryError(shifted or found.contradiction())
    return found


def _explained(poses: RelativePoses, used: NDArray[np.bool_], found: SoundPairs) -> SoundPairs:
    """Leave out the pairs that contradict most others, or the smaller part if the rig moved."""
    why = contradiction(poses, used)
    odd = {pair: UNSYNCHRONISED for pair, is_odd in zip(poses.names, why.odd, strict=True) if is_odd}
    if why.kind == "moved":
        found = replace(found, left_out={**found.left_out, **odd})
        return _larger_part(poses, used & ~why.odd, why.at, found)
    return replace(found, left_out={**odd, **found.left_out}, by_chance=not why.is_significant)


def _larger_part(poses: RelativePoses, used: NDArray[np.bool_], at: int, found: SoundPairs) -> SoundPairs:
    """The pairs before or after the rig moved; those after it, as the rig is now, if both are as many."""
    later = np.arange(len(poses)) >= at
    sides = used & ~later, used & later
    kept = int(sides[1].sum() >= sides[0].sum())
    members = {pair for pair, is_in in zip(poses.names, sides[kept], strict=True) if is_in}
    others = [pair for pair, is_in in zip(poses.names, sides[1 - kept], strict=True) if is_in]
    between = f"between {pair_name(poses.names[at - 1])} and {pair_name(poses.names[at])}"
    reason = f"{MOVED} {('after', 'before')[kept]} the rig moved {between}"
    left_out = {pair: why for pair, why in found.left_out.items() if pair not in members}
    left_out |= dict.fromkeys(others, reason)
    start = poses.solution(sides[kept])[-6:]
    rig = Pose(rotation_step(start[:3]) @ found.rig.R, found.rig.t + start[3:] * poses.unit)
    text, advice = describe_move(poses.names, poses.size, at, poses.names[at:] if kept else poses.names[:at])
    return SoundPairs(found.problem, rig, left_out, f"{text}; {advice}")


def describe_move(names: Sequence[Pair], size: Array, at: int, kept: Sequence[Pair] = ()) -> tuple[str, str]:
    """Describe a rig that has two geometries, the second from pair `at` on, with advice.

    `size` (P,) is that of each target, and `kept` the part that determines the rig; empty if both do.
    """
    this = f"; this is that of {span(kept)}" if kept else ""
    (large, larger), (small, smaller) = sorted(
        ((float(median(size[part])), span(names[part])) for part in (slice(at), slice(at, None))),
        reverse=True,
    )
    if large > _OTHER_SIZE * small:
        return (
            f"the targets in {larger} are {large / small:.3g} times as large as in {smaller}, so the rig has "
            f"two sizes{this}",
            "check the unit of X,Y,Z and the size of the squares",
        )
    return (
        f"the rig moved between {pair_name(names[at - 1])} and {pair_name(names[at])}: it has two "
        f"geometries, {span(names[:at])} and {span(names[at:])}{this}",
        "calibrate each part by itself, and fix the cameras to each other",
    )


def _shifted(left: Calibration, right: Calibration, views: ViewPairs) -> str:
    """Message if the pairs agree on a rig once the right views are shifted by one; otherwise empty."""
    if len(views.both) < 2 * _LEAST_AGREED:
        return ""
    for word, by in (("next", 1), ("previous", -1)):
        pairs = in_order(views.both)
        first, second = (pairs[:-1], pairs[1:]) if by > 0 else (pairs[1:], pairs[:-1])
        moved = tuple((a, b) for (a, _), (_, b) in zip(first, second, strict=True))
        agree = find_consensus(rig_problem(left, right, ViewPairs(moved))).agree
        if agree.mean() > _AGREED:
            return (
                f"each left view fits the right view of the {word} pair, such as {pair_name(moved[0])}, but "
                "not that of its own; one image of one camera is missing or was taken twice; name the views "
                "that were taken at the same moment alike"
            )
    return ""

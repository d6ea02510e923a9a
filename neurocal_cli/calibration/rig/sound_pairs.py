"""Select the pairs of views that determine the rig, and diagnose the others.

Each pair of views gives the pose of the right camera relative to the left one. Pairs that disagree with most
others are tested for four faults: the target is turned in one image (its points have another order), one
image is mirrored, the two images are exchanged, or they were not taken at the same moment. `contradiction`
then compares the relative poses with their covariances, and tells whether the rig moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.calibration.rig.adjust import RigProblem, stereo_problem
from neurocal_cli.calibration.rig.contradiction import Contradiction, contradiction
from neurocal_cli.calibration.rig.pairing import ViewPairs
from neurocal_cli.calibration.rig.relative_poses import RelativePoses, in_order, relative_poses
from neurocal_cli.calibration.verdict.findings import name_some
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_to_rotation, median, nearest_rotation, rotation_step
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import DegenerateGeometryError

# Two pairs agree if their targets differ in the image by less than this share of the target's size or by less
# than so many standard deviations of a pixel. The tests of named faults in test_stereo_evaluation.py
# repeat that faults are found and sound pairs kept.
_SHARE = 0.1
_SIGMAS = 30.0
_MOST_HYPOTHESES = 40
_EXCHANGED = 6.0  # largest distance of an exchanged pair, whose intrinsic parameters fit roughly only ...
_NEARER = 0.4  # ... and the same as a share of the distance of the pair as it is
_TURNED = "the target is turned by {} degrees in one of the images"
_MIRRORED = "one of the two images is mirrored, or its u and v are exchanged"
# Faults of the images of flat targets: how the target's axes (the longest first, the normal last) and those
# of the right camera are exchanged. A mirrored image of a flat target is one of its back; programs that
# number the points in each image by themselves then begin at another corner.
_IMAGE_MIRRORED = np.diag([-1.0, 1.0, 1.0])
_FAULTS = (
    *((_TURNED.format(d), euler_to_rotation(0.0, 0.0, np.radians(d)), np.eye(3)) for d in (90, 270, 180)),
    *((_MIRRORED, np.diag(of_target), _IMAGE_MIRRORED) for of_target in np.where(np.eye(3)[::-1], -1.0, 1.0)),
)
_OTHER_SIZE = 1.2  # least ratio of target sizes that differ; in one series they are equal
_AGREED, _LEAST_AGREED = 0.8, 3  # share of the pairs, and fewest pairs, that must agree once shifted

UNSYNCHRONISED = "does not fit the others (not taken at the same moment?)"
TWO_GEOMETRIES = ("moved", "size")  # kinds of contradiction after which one part of the pairs is used
PAIR_ANEW = (
    "one image of one camera is missing or was taken twice; name the views that were taken at the same "
    "moment alike"
)
SHIFTED = {word: f"the left image fits the right one of the {word} pair" for word in ("next", "previous")}
MOVED = "taken"  # first word of the reason for pairs taken before or after the rig moved

Pair = tuple[str, str]


@frozen_dataclass(eq=False)
class SoundPairs:
    """Pairs that determine the rig, and the faults of the others."""

    problem: RigProblem  # of all pairs
    rig: Pose  # the rig of most pairs, the start of an adjustment
    left_out: Mapping[Pair, str]  # pairs that do not determine it, and why
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
        if shifted(self.left_out):
            return f"{found}; {PAIR_ANEW}"
        if UNSYNCHRONISED not in self.left_out.values():
            return f"{found}; correct these images, or the order of their points"
        return f"{found}; check that the views of a pair show one target at one moment, in the same order"


def sound_pairs(left: Calibration, right: Calibration, views: ViewPairs) -> SoundPairs:
    """Find the pairs that determine the rig; an error if half of them or more contradict each other."""
    problem = stereo_problem(left, right, views.both)
    consensus = find_consensus(problem)
    reasons = dict(zip(problem.pairs, consensus.reasons, strict=True))
    found = SoundPairs(problem, consensus.rig, {pair: reason for pair, reason in reasons.items() if reason})
    poses = relative_poses(problem, consensus.rig)
    if poses is not None:
        # A fault that has a name is certain. The others may belong to a rig that moved.
        used = np.array([reasons[pair] in ("", UNSYNCHRONISED) for pair in poses.names])
        why = contradiction(poses, used)
        odd = {pair: UNSYNCHRONISED for pair, is_odd in zip(poses.names, why.odd, strict=True) if is_odd}
        if why.kind in TWO_GEOMETRIES:
            found = replace(found, left_out={**found.left_out, **odd})
            found = _larger_part(poses, used & ~why.odd, why, found)
        else:
            left_out = {**odd, **found.left_out}
            found = replace(found, left_out=left_out, by_chance=not why.is_significant)
    found = _with_shifted(left, right, found)
    if not found.moved and 2 * len(found.left_out) >= len(views.both):
        message = "" if shifted(found.left_out) else _all_shifted(left, right, views)
        if not message and UNSYNCHRONISED in found.left_out.values():
            message = _poor_camera(left, right, found)
        raise DegenerateGeometryError(message or found.contradiction())
    return found


def _larger_part(
    poses: RelativePoses, used: NDArray[np.bool_], why: Contradiction, found: SoundPairs
) -> SoundPairs:
    """The pairs before or after the rig moved; those after it, as the rig is now, if both are as many."""
    at = why.at
    later = np.arange(len(poses)) >= at
    sides = used & ~later, used & later
    kept = int(sides[1].sum() >= sides[0].sum())
    members = {pair for pair, is_in in zip(poses.names, sides[kept], strict=True) if is_in}
    others = [pair for pair, is_in in zip(poses.names, sides[1 - kept], strict=True) if is_in]
    between = f"between {pair_name(poses.names[at - 1])} and {pair_name(poses.names[at])}"
    what = "the size of the target changed" if why.kind == "size" else "the rig moved"
    reason = f"{MOVED} {('after', 'before')[kept]} {what} {between}"
    left_out = {pair: fault for pair, fault in found.left_out.items() if pair not in members}
    left_out |= dict.fromkeys(others, reason)
    start = poses.solution(sides[kept])[-6:]
    rig = Pose(rotation_step(start[:3]) @ found.rig.R, found.rig.t + start[3:] * poses.unit)
    own = poses.names[at:] if kept else poses.names[:at]
    text, advice = describe_move(poses.names, poses.size, why, own)
    return SoundPairs(found.problem, rig, left_out, f"{text}; {advice}")


def _with_shifted(left: Calibration, right: Calibration, found: SoundPairs) -> SoundPairs:
    """Name pairs whose left views fit the right views of the next pairs, or of the previous ones.

    From the place on where one camera lost an image, or took one twice, all views are paired wrongly.
    """
    odd = {a: b for (a, b), reason in found.left_out.items() if reason == UNSYNCHRONISED}
    for word in SHIFTED:
        moved = tuple(pair for pair in _neighbours(found.problem.pairs, word) if pair[0] in odd)
        if len(moved) < _LEAST_AGREED:
            continue
        problem = stereo_problem(left, right, moved)
        fits = _distance(problem, _poses(problem), found.rig.R[None], found.rig.t[None])[0] < 1
        if fits.sum() >= max(_LEAST_AGREED, _AGREED * len(moved)):
            names = [a for (a, _), one in zip(problem.pairs, fits, strict=True) if one]
            reasons = {(a, odd[a]): SHIFTED[word] for a in names}
            return replace(found, left_out={**found.left_out, **reasons})
    return found


def _all_shifted(left: Calibration, right: Calibration, views: ViewPairs) -> str:
    """Message if the pairs agree on a rig once the right views are shifted by one; otherwise empty."""
    if len(views.both) < 2 * _LEAST_AGREED:
        return ""
    for word in SHIFTED:
        moved = _neighbours(views.both, word)
        faults = find_consensus(stereo_problem(left, right, moved)).reasons
        if faults.count("") / len(faults) > _AGREED:
            return (
                f"each left view fits the right view of the {word} pair, such as {pair_name(moved[0])}, but "
                f"not that of its own; {PAIR_ANEW}"
            )
    return ""


def _neighbours(pairs: Sequence[Pair], word: str) -> tuple[Pair, ...]:
    """Each left view with the right view of the next, or of the previous, pair."""
    ordered = in_order(pairs)
    first, second = (ordered[:-1], ordered[1:]) if word == "next" else (ordered[1:], ordered[:-1])
    return tuple((a, b) for (a, _), (_, b) in zip(first, second, strict=True))


def _poor_camera(left: Calibration, right: Calibration, found: SoundPairs) -> str:
    """Message if the pairs contradict each other, and a camera is poor by itself; otherwise empty."""
    for side, camera in (("left", left), ("right", right)):
        verdict = camera.verdict
        if verdict is not None and verdict.word == "poor":
            return (
                f"{len(found.left_out)} of {len(found.problem.paired)} pairs of views contradict the rig, "
                f"and the {side} camera is poor by itself: {verdict.reasons[0]}; {verdict.advice[0]}"
            )
    return ""


def describe_faults(left_out: Mapping[Pair, str], n_pairs: int) -> str:
    """Describe pairs that are left out: their number, and the faults with the pairs of each, most first."""
    by_reason: dict[str, list[str]] = {}
    for pair, reason in left_out.items():
        by_reason.setdefault(reason, []).append(pair_name(pair))
    most_first = sorted(by_reason.items(), key=lambda item: -len(item[1]))
    parts = [f"{name_some(names)}: {reason}" for reason, names in most_first]
    return f"{len(left_out)} of {n_pairs} pairs of views contradict the rig ({'; '.join(parts)})"


def describe_move(
    names: Sequence[Pair], size: Array, why: Contradiction, kept: Sequence[Pair]
) -> tuple[str, str]:
    """Describe a rig that has two geometries, the second from some pair on, with advice.

    `size` (P,) is that of each target, and `kept` the part that determines the rig; empty if both do.
    """
    at = why.at
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
    if why.kind == "size":
        larger = np.expm1(-np.log1p(why.amount))  # of the later targets, for which the baseline is shorter
        than = f"{'larger' if larger > 0 else 'smaller'} than in {span(names[:at])}, compared with X,Y,Z"
        return (
            f"from {pair_name(names[at])} on nothing but the length of the baseline differs, by "
            f"{100 * why.amount:+.2g} %: the target in {span(names[at:])} is {100 * abs(larger):.2g} % "
            f"{than} (or the cameras slid along the line between them, or both changed their focal length)"
            f"{this.replace('this', 'the rig')}",
            "measure the squares of both targets, and give each target its own X,Y,Z",
        )
    return (
        f"the rig moved between {pair_name(names[at - 1])} and {pair_name(names[at])}: it has two "
        f"geometries, {span(names[:at])} and {span(names[at:])}{this}",
        "calibrate each part by itself, and fix the cameras to each other",
    )


def shifted(left_out: Mapping[Pair, str]) -> bool:
    """Whether left views fit the right views of other pairs than their own."""
    return any(reason in SHIFTED.values() for reason in left_out.values())


def pair_name(pair: Pair) -> str:
    """The name of a pair of views for messages."""
    return pair[0] if pair[0] == pair[1] else f"{pair[0]}/{pair[1]}"


def span(pairs: Sequence[Pair]) -> str:
    """The names of pairs in a row, by the first and the last left view."""
    first, last = pairs[0][0], pairs[-1][0]
    return first if len(pairs) == 1 else f"{first} to {last}"


@frozen_dataclass(eq=False)
class RigConsensus:
    """The rig that most pairs of views support."""

    rig: Pose  # X_right = R X_left + t [world unit]
    reasons: tuple[str, ...]  # fault of each pair; empty for those that agree


def find_consensus(problem: RigProblem) -> RigConsensus:
    """Find the rig that most pairs of views support."""
    poses = _poses(problem)
    R, t = poses.rigs()
    agree = _distance(problem, poses, R, t) < 1
    best = int(np.argmax(agree.sum(axis=1)))
    if agree[best].all():
        return RigConsensus(_mean_rig(poses, agree[best]), ("",) * len(problem.paired))
    R, t, sound = _common_fault(problem, poses, (R[best], t[best], agree[best]))
    return RigConsensus(_mean_rig(poses, sound), _reasons(problem, poses, R, t, sound))


@frozen_dataclass(eq=False)
class _Poses:
    """Poses of the paired targets in each camera alone: rotations and centres, left and right."""

    R: tuple[Array, Array]
    m: tuple[Array, Array]

    def rigs(self) -> tuple[Array, Array]:
        """R and t of single pairs, for an even choice of the pairs."""
        n = len(self.R[0])
        some = np.linspace(0, n - 1, min(n, _MOST_HYPOTHESES)).astype(int)
        R = self.R[1][some] @ np.swapaxes(self.R[0][some], 1, 2)
        return R, self.m[1][some] - (R @ self.m[0][some][..., None])[..., 0]


def _poses(problem: RigProblem) -> _Poses:
    left, right = problem.cameras
    scale = problem.scale[problem.paired][:, None]
    return _Poses(
        (left.R[problem.paired_left], right.R[problem.paired_right]),
        (left.t[problem.paired_left] * scale, right.t[problem.paired_right] * scale),
    )


def _distance(problem: RigProblem, poses: _Poses, R: Array, t: Array) -> Array:
    """(H, P) distance of each pair's target from its prediction by each rig; pairs agree below 1."""
    offsets = problem.spread * problem.scale[problem.paired][:, None, None]
    targets = [
        offsets @ np.swapaxes(R_k, 1, 2) + m_k[:, None, :] for R_k, m_k in zip(poses.R, poses.m, strict=True)
    ]
    # (H, P, 5, 3): the targets in the right camera's frame, as each rig predicts them.
    through = np.einsum("hij,pnj->hpni", R, targets[0]) + t[:, None, None, :]
    focal = problem.cameras[1].entries[0, [0, 2]]
    with np.errstate(invalid="ignore", divide="ignore"):
        image = targets[1][..., :2] / targets[1][..., 2:] * focal
        guess = np.where(through[..., 2:] > 0, through[..., :2] / through[..., 2:], np.inf) * focal
        apart = np.sqrt(((guess - image) ** 2).sum(axis=-1).mean(axis=-1))
    size = np.sqrt(((image - image[:, :1]) ** 2).sum(axis=-1).mean(axis=-1))
    noise = _SIGMAS / np.sqrt(problem.observations[1].weight)
    return np.asarray(apart / np.maximum(_SHARE * size, noise))


def _common_fault(
    problem: RigProblem, poses: _Poses, found: tuple[Array, Array, NDArray[np.bool_]]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The rig and the pairs that agree with it, if most pairs have one fault."""
    most, flat = int(found[2].sum()), problem.is_flat[problem.paired]
    for _, of_target, of_image in _FAULTS:
        mended = _mended(problem, poses, of_target, of_image)
        R, t = mended.rigs()
        sound = _distance(problem, poses, R, t) < 1
        faulty = (_distance(problem, mended, R, t) < 1) & flat
        counts = (sound | faulty).sum(axis=1)
        if counts.max() > most:
            best, most = int(np.argmax(counts)), int(counts.max())
            found = R[best], t[best], sound[best]
    return found


def _reasons(
    problem: RigProblem, poses: _Poses, R: Array, t: Array, sound: NDArray[np.bool_]
) -> tuple[str, ...]:
    """Fault of each pair that does not agree with the rig."""
    plain = _distance(problem, poses, R[None], t[None])[0]
    exchanged = _Poses((poses.R[1], poses.R[0]), (poses.m[1], poses.m[0]))
    distance = _distance(problem, exchanged, R[None], t[None])[0]
    flat = problem.is_flat[problem.paired]
    reasons = np.where(
        (distance < _EXCHANGED) & (distance < _NEARER * plain),
        "the left and the right image are exchanged",
        UNSYNCHRONISED,
    )
    for reason, of_target, of_image in _FAULTS:
        mended = _mended(problem, poses, of_target, of_image)
        fits = flat & (_distance(problem, mended, R[None], t[None])[0] < 1)
        reasons = np.where(fits, reason, reasons)
    return tuple(np.where(sound, "", reasons).tolist())


def _mended(problem: RigProblem, poses: _Poses, of_target: Array, of_image: Array) -> _Poses:
    """The poses if the axes of the targets and of the image of the right camera were exchanged."""
    axes = problem.basis[problem.paired]
    turn = axes @ of_target @ np.swapaxes(axes, 1, 2)
    return _Poses((poses.R[0], of_image @ poses.R[1] @ turn), (poses.m[0], poses.m[1] @ of_image.T))


def _mean_rig(poses: _Poses, agree: NDArray[np.bool_]) -> Pose:
    """The mean rotation, and the translation that fits the targets' centres best."""
    if not agree.any():
        return Pose(np.eye(3), np.zeros(3))
    R = nearest_rotation((poses.R[1][agree] @ np.swapaxes(poses.R[0][agree], 1, 2)).sum(axis=0))
    # The centre of a far target is less certain.
    depth = poses.m[1][agree, 2]
    t = poses.m[1][agree] - poses.m[0][agree] @ R.T
    return Pose(R, np.average(t, axis=0, weights=1.0 / np.maximum(depth, 1e-300) ** 2))

"""The rig that most pairs of views agree on, and what is wrong with the others.

Each pair of views says by itself how the right camera stands to the left. Most pairs agree; the others
have something wrong with them, which is looked for: the target turned in one image (its points in another
order), the two images exchanged, or just a pair that was not taken at the same moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.geometry import Array, euler_to_rotation, nearest_rotation
from neurocal_cli.stereo.problem import RigProblem

__all__ = ["Consensus", "find_consensus"]

_SHARE = 0.1  # of the target's size in the image: two pairs that differ by less may agree
_NOISE = 30.0  # standard deviations of a pixel, likewise
_MOST_HYPOTHESES = 40
_EXCHANGED, _MUCH_NEARER = (
    6.0,
    0.4,
)  # distance of an exchanged pair, and as a share of that of the pair as it is

UNSYNCHRONISED = "does not fit the others (not taken at the same moment?)"
_TURNS = (90, 270, 180)


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the pairs of views agree on.

    Attributes
    ----------
    rig : Pose
        ``X_right = R X_left + t`` [world unit].
    agree : (P,) bool array
    reasons : tuple of str
        What is wrong with each pair; empty for those that agree.
    """

    rig: Pose
    agree: NDArray[np.bool_]
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Poses:
    """Where each camera alone puts the paired targets: rotations and centres, left and right."""

    R: tuple[Array, Array]
    m: tuple[Array, Array]

    def rigs(self) -> tuple[Array, Array]:
        """R and t that some of the pairs, spread over all of them, have by themselves."""
        n = len(self.R[0])
        some = np.unique(np.linspace(0, n - 1, min(n, _MOST_HYPOTHESES)).astype(int))
        R = self.R[1][some] @ np.swapaxes(self.R[0][some], 1, 2)
        return R, self.m[1][some] - (R @ self.m[0][some][..., None])[..., 0]


def find_consensus(problem: RigProblem) -> Consensus:
    """Find the rig that the most pairs of views agree on."""
    poses = _poses(problem)
    R, t = poses.rigs()
    agree = _distance(problem, poses, R, t) < 1
    best = int(np.argmax(agree.sum(axis=1)))
    reasons = ("",) * len(problem.paired)
    if agree[best].all():
        return Consensus(_mean_rig(poses, agree[best]), agree[best], reasons)
    R, t, sound = _common_fault(problem, poses, (R[best], t[best], agree[best]))
    return Consensus(_mean_rig(poses, sound), sound, _reasons(problem, poses, R, t, sound))


def _poses(problem: RigProblem) -> _Poses:
    left, right = problem.cameras
    scale = problem.frames.scale[problem.paired][:, None]
    return _Poses(
        (left.R[problem.paired], right.R[problem.paired_right]),
        (left.t[problem.paired] * scale, right.t[problem.paired_right] * scale),
    )


def _distance(problem: RigProblem, poses: _Poses, R: Array, t: Array) -> Array:
    """(H, P) how far each pair's target is from where each rig has it, as a share of what may agree."""
    offsets = problem.spread * problem.frames.scale[problem.paired][:, None, None]
    seen = [
        offsets @ np.swapaxes(R_k, 1, 2) + m_k[:, None, :] for R_k, m_k in zip(poses.R, poses.m, strict=True)
    ]
    # (H, P, 5, 3): the targets in the right camera's frame as each rig has them.
    through = np.einsum("hij,pnj->hpni", R, seen[0]) + t[:, None, None, :]
    focal = problem.cameras[1].entries[0, [0, 2]]
    with np.errstate(invalid="ignore", divide="ignore"):
        image = seen[1][..., :2] / seen[1][..., 2:] * focal
        guess = np.where(through[..., 2:] > 0, through[..., :2] / through[..., 2:], np.inf) * focal
        apart = np.sqrt(((guess - image) ** 2).sum(axis=-1).mean(axis=-1))
    size = np.sqrt(((image - image[:, :1]) ** 2).sum(axis=-1).mean(axis=-1))
    noise = _NOISE / np.sqrt(problem.sightings[1].weight)
    return np.asarray(apart / np.maximum(_SHARE * size, noise))


def _common_fault(
    problem: RigProblem, poses: _Poses, found: tuple[Array, Array, NDArray[np.bool_]]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The rig, and the pairs that agree with it, once a turn that most targets share is seen through."""
    most = int(found[2].sum())
    for degrees in _TURNS:
        turned = _turned(problem, poses, degrees)
        R, t = turned.rigs()
        sound = _distance(problem, poses, R, t) < 1
        faulty = (_distance(problem, turned, R, t) < 1) & problem.flat
        counts = (sound | faulty).sum(axis=1)
        if counts.max() > most:
            best, most = int(np.argmax(counts)), int(counts.max())
            found = R[best], t[best], sound[best]
    return found


def _reasons(
    problem: RigProblem, poses: _Poses, R: Array, t: Array, sound: NDArray[np.bool_]
) -> tuple[str, ...]:
    """What is wrong with each pair that does not agree with the rig."""
    plain = _distance(problem, poses, R[None], t[None])[0]
    exchanged = _Poses((poses.R[1], poses.R[0]), (poses.m[1], poses.m[0]))
    distance = _distance(problem, exchanged, R[None], t[None])[0]
    reasons = np.where(
        # Exchanged images put the target where the other camera's intrinsics have it: roughly.
        (distance < _EXCHANGED) & (distance < _MUCH_NEARER * plain),
        "the left and the right image are exchanged",
        UNSYNCHRONISED,
    )
    for degrees in _TURNS:
        fits = problem.flat & (_distance(problem, _turned(problem, poses, degrees), R[None], t[None])[0] < 1)
        reasons = np.where(fits, f"the target is turned by {degrees} degrees in one of the images", reasons)
    return tuple(np.where(sound, "", reasons).tolist())


def _turned(problem: RigProblem, poses: _Poses, degrees: int) -> _Poses:
    """The right camera's poses if its targets were turned in their planes."""
    turn = euler_to_rotation(0.0, 0.0, np.radians(degrees))
    return _Poses((poses.R[0], poses.R[1] @ problem.axes @ turn @ np.swapaxes(problem.axes, 1, 2)), poses.m)


def _mean_rig(poses: _Poses, agree: NDArray[np.bool_]) -> Pose:
    """The mean rotation, and the translation that brings the targets' centres together."""
    if not agree.any():
        return Pose(np.eye(3), np.zeros(3))
    R = nearest_rotation((poses.R[1][agree] @ np.swapaxes(poses.R[0][agree], 1, 2)).sum(axis=0))
    # Weighted by nearness: a far target's centre is known less well.
    depth = poses.m[1][agree, 2]
    t = poses.m[1][agree] - poses.m[0][agree] @ R.T
    return Pose(R, np.average(t, axis=0, weights=1.0 / np.maximum(depth, 1e-300) ** 2))

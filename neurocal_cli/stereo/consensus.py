"""The rig that most pairs of views support, and the faults of the other pairs.

Each pair of views gives the pose of the right camera relative to the left one. Pairs that disagree with most
others are tested for three faults: the target is turned in one image (its points have another order), the two
images are exchanged, or they were not taken at the same moment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array, euler_to_rotation, nearest_rotation
from neurocal_cli.stereo.adjust import RigProblem

# Two pairs agree if their targets differ in the image by less than this share of the target's size or by less
# than so many standard deviations of a pixel. The tests of named faults in tests/test_stereo_evaluation.py
# repeat that faults are found and sound pairs kept.
_SHARE = 0.1
_SIGMAS = 30.0
_MOST_HYPOTHESES = 40
_EXCHANGED = 6.0  # largest distance of an exchanged pair, whose intrinsic parameters fit roughly only ...
_NEARER = 0.4  # ... and the same as a share of the distance of the pair as it is

UNSYNCHRONISED = "does not fit the others (not taken at the same moment?)"
_TURNS = (90, 270, 180)


@frozen_dataclass(eq=False)
class RigConsensus:
    """The rig that most pairs of views support."""

    rig: Pose  # X_right = R X_left + t [world unit]
    agree: NDArray[np.bool_]  # (P,)
    reasons: tuple[str, ...]  # fault of each pair; empty for those that agree


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


def find_consensus(problem: RigProblem) -> RigConsensus:
    """Find the rig that most pairs of views support."""
    poses = _poses(problem)
    R, t = poses.rigs()
    agree = _distance(problem, poses, R, t) < 1
    best = int(np.argmax(agree.sum(axis=1)))
    reasons = ("",) * len(problem.paired)
    if agree[best].all():
        return RigConsensus(_mean_rig(poses, agree[best]), agree[best], reasons)
    R, t, sound = _common_fault(problem, poses, (R[best], t[best], agree[best]))
    return RigConsensus(_mean_rig(poses, sound), sound, _reasons(problem, poses, R, t, sound))


def _poses(problem: RigProblem) -> _Poses:
    left, right = problem.cameras
    scale = problem.scale[problem.paired][:, None]
    return _Poses(
        (left.R[problem.paired], right.R[problem.paired_right]),
        (left.t[problem.paired] * scale, right.t[problem.paired_right] * scale),
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
    """The rig and the pairs that agree with it, if most targets are turned alike in one camera."""
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
    """Fault of each pair that does not agree with the rig."""
    plain = _distance(problem, poses, R[None], t[None])[0]
    exchanged = _Poses((poses.R[1], poses.R[0]), (poses.m[1], poses.m[0]))
    distance = _distance(problem, exchanged, R[None], t[None])[0]
    reasons = np.where(
        (distance < _EXCHANGED) & (distance < _NEARER * plain),
        "the left and the right image are exchanged",
        UNSYNCHRONISED,
    )
    for degrees in _TURNS:
        fits = problem.flat & (_distance(problem, _turned(problem, poses, degrees), R[None], t[None])[0] < 1)
        reasons = np.where(fits, f"the target is turned by {degrees} degrees in one of the images", reasons)
    return tuple(np.where(sound, "", reasons).tolist())


def _turned(problem: RigProblem, poses: _Poses, degrees: int) -> _Poses:
    """The poses if the targets of the right camera were turned in their planes."""
    turn = euler_to_rotation(0.0, 0.0, np.radians(degrees))
    return _Poses((poses.R[0], poses.R[1] @ problem.axes @ turn @ np.swapaxes(problem.axes, 1, 2)), poses.m)


def _mean_rig(poses: _Poses, agree: NDArray[np.bool_]) -> Pose:
    """The mean rotation, and the translation that fits the targets' centres best."""
    if not agree.any():
        return Pose(np.eye(3), np.zeros(3))
    R = nearest_rotation((poses.R[1][agree] @ np.swapaxes(poses.R[0][agree], 1, 2)).sum(axis=0))
    # The centre of a far target is less certain.
    depth = poses.m[1][agree, 2]
    t = poses.m[1][agree] - poses.m[0][agree] @ R.T
    return Pose(R, np.average(t, axis=0, weights=1.0 / np.maximum(depth, 1e-300) ** 2))

"""Measure the quality of a rig beyond the error of the common fit, and reach a verdict.

Everything is computed from the rig and its points, so a file can be judged like a fresh result:

* the verdict on each camera by its own points (`verdict.assessment`);
* whether the pairs of views agree on one rig (`contradiction`);
* the cross-validation error over pairs;
* the uncertainty of triangulated depth (`depth_uncertainty`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.calibration import Verdict
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.leave_out import Quadratics, folds_of
from neurocal_cli.median import median
from neurocal_cli.stereo.consensus import UNSYNCHRONISED
from neurocal_cli.stereo.contradiction import Contradiction, contradiction
from neurocal_cli.stereo.covariance import rig_covariance
from neurocal_cli.stereo.depth_uncertainty import depth_std
from neurocal_cli.stereo.pairing import ViewPairs, pair_points
from neurocal_cli.stereo.problem import rig_problem
from neurocal_cli.stereo.relative_poses import RelativePoses, relative_poses
from neurocal_cli.stereo.rig import Rig
from neurocal_cli.stereo.rules import RigEvidence, reach_rig_verdict
from neurocal_cli.stereo.sound_pairs import MOVED
from neurocal_cli.verdict.assessment import assess

_FOLDS = 5
_MOST_POINTS = 400  # most points that are triangulated for the uncertainty of depth


def assess_rig(rig: Rig) -> Verdict | None:
    """Good, usable or poor, with reasons and advice; None for a rig without points of its own."""
    pairs = (*rig.pairs, *rig.left_out)
    for side, camera in enumerate((rig.left, rig.right)):
        names = set(camera.points.view_names)
        if not pairs or names != set(camera.views) or not names >= {pair[side] for pair in pairs}:
            return None
    return reach_rig_verdict(rig, gather_rig_evidence(rig))


def gather_rig_evidence(rig: Rig) -> RigEvidence:
    """Compute all measures of a rig's quality.

    Parameters
    ----------
    rig : Rig
        With the points of both cameras.
    """
    pairs = (*rig.pairs, *rig.left_out)
    cameras = assess(rig.left), assess(rig.right)
    poses = relative_poses(rig_problem(rig.left, rig.right, ViewPairs(pairs, (), ())), rig.pose)
    nan = float("nan")
    if poses is None:
        return RigEvidence(cameras, pairs, np.zeros(0), None, None, nan, nan, nan, nan)
    used = np.array([pair not in rig.left_out for pair in poses.names])
    found = contradiction(poses, used, seek_odd=False)
    covariance = rig_covariance(poses, used, found)
    depth, std = depth_std(rig, poses, covariance, _some_points(rig))
    return RigEvidence(
        cameras=cameras,
        names=poses.names,
        size=poses.size,
        moved=_moved(rig, poses, used, found),
        contradiction=found,
        displacement=_displacement(poses, used),
        held_out_px=_held_out(rig, poses, used),
        depth=_share(depth),
        depth_share=_share(std / depth),
    )


def _share(of_points: Array) -> float:
    """Median of the finite values; nan if there are none."""
    fine = np.isfinite(of_points)
    return float(median(of_points[fine])) if fine.any() else float("nan")


def _moved(
    rig: Rig, poses: RelativePoses, used: NDArray[np.bool_], found: Contradiction
) -> Contradiction | None:
    """The contradiction of all pairs if its explanation is that the rig moved."""
    reasons = [rig.left_out.get(pair, "") for pair in poses.names]
    either = np.array([reason == UNSYNCHRONISED or reason.startswith(MOVED) for reason in reasons])
    if either.any():
        found = contradiction(poses, used | either)
    return found if found.kind == "moved" else None


def _displacement(poses: RelativePoses, used: NDArray[np.bool_]) -> float:
    """Rms distance between the targets' positions in the right camera and those predicted by the rig."""
    left = poses.offset - poses.design @ poses.solution(used)
    moved = np.cross(left[:, :3], poses.centre) + left[:, 3:]
    return float(np.sqrt((moved[used] ** 2).sum(axis=1).mean())) * poses.unit


def _held_out(rig: Rig, poses: RelativePoses, used: NDArray[np.bool_]) -> float:
    """Cross-validation error: rms of held-out pairs, with their poses fitted."""
    at, places = poses.solution(used), poses.frame[used]
    S, g, cost = poses.cameras.S.copy(), poses.cameras.g.copy(), poses.cameras.at(at)
    S[places] += poses.pairs.S[used]
    cost[places] += poses.pairs.at(at)[used]
    g -= (poses.cameras.S @ at[:, None])[..., 0]
    g[places] += poses.pairs.g[used] - (poses.pairs.S[used] @ at[:, None])[..., 0]
    lost = Quadratics(S, g, cost).held_out(folds_of(len(cost), _FOLDS))
    return rig.rmse_px * float(np.sqrt(lost.sum() / max(cost.sum(), 1e-300)))


def _some_points(rig: Rig) -> tuple[Array, Array]:
    """Pixels of some points in both cameras, evenly spaced over the pairs."""
    sides = rig.left.points, rig.right.points
    rows = pair_points(*sides, ViewPairs(rig.pairs, (), ()))
    step = max(1, len(rows.left) // _MOST_POINTS)
    return sides[0].pixels[rows.left[::step]], sides[1].pixels[rows.right[::step]]

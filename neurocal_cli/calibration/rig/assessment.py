"""The verdict on a rig, good, usable or poor, with reasons and advice: its measures and its rules.

Everything is computed from the rig and its points, so a file can be judged like a fresh result:

* the verdict on each camera by its own points (`calibration.verdict.assessment`);
* whether the pairs of views agree on one rig (`contradiction`);
* the cross-validation error over pairs;
* the uncertainty of triangulated depth, from the covariance of the rig and its cameras.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.leave_out import Quadratics, folds_of
from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.calibration.calibration import Verdict
from neurocal_cli.calibration.rig.adjust import stereo_problem
from neurocal_cli.calibration.rig.contradiction import FOCAL, Contradiction, contradiction
from neurocal_cli.calibration.rig.covariance import covariance_by_given, rig_covariance
from neurocal_cli.calibration.rig.pairing import ViewPairs, pair_points
from neurocal_cli.calibration.rig.relative_poses import RelativePoses, relative_poses
from neurocal_cli.calibration.rig.rig import Rig
from neurocal_cli.calibration.rig.sound_pairs import (
    MOVED,
    PAIR_ANEW,
    TWO_GEOMETRIES,
    UNSYNCHRONISED,
    describe_faults,
    describe_move,
    pair_name,
    shifted,
)
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.calibration.verdict.assessment import assess
from neurocal_cli.calibration.verdict.findings import WORDS, Finding, Limit, verdict_of
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median, rotation_step
from neurocal_cli.camera.pinhole import Intrinsics, Pose

# Repeated by test_wrong_rigs.py, in which no wrong rig may be good, and by test_rig_verdict.py,
# in which real and simulated good rigs are good. With real boards the relative poses scatter 2 to 3.5 times
# as much as noise explains.
_SCATTER = Limit(4.0, 10.0)
_GROWTH = Limit(1.6, 2.3)
_CHANGE = Limit(0.0, 10.0)  # standard deviations for each unknown of the explanation
_HELD_OUT = Limit(1.3, 2.0)  # over the rms error
_DEPTH = Limit(0.01, 0.05)  # std over the depth
_BASELINE = Limit(0.01, 0.05)  # std over the baseline
_LEFT_OUT = Limit(0.0, 0.34)  # share of the pairs

# When the right images were taken, and towards which pair's place they show the target.
_MOTIONS = {"late": ("later", "to the next"), "early": ("earlier", "back to the previous")}
_MOMENT = (
    "trigger both cameras at the same moment, or hold the target still; check that the cameras are fixed"
)

_FOLDS = 5
_MOST_POINTS = 400  # most points that are triangulated for the uncertainty of depth
_STEP = 1e-2  # standard deviations: small enough to be linear, large against rounding
_LEAST_STEP = 1e-9


def assess_rig(rig: Rig) -> Verdict | None:
    """Good, usable or poor, with reasons and advice; None for a rig without points of its own."""
    pairs = (*rig.pairs, *rig.left_out)
    for side, camera in enumerate((rig.left, rig.right)):
        names = set(camera.points.view_names)
        if not pairs or names != set(camera.views) or not names >= {pair[side] for pair in pairs}:
            return None
    evidence = _evidence(rig)
    found = evidence.contradiction
    growth, scatter = (np.nan, np.nan) if found is None else (found.growth, found.scatter)
    measures = {
        "held_out_px": evidence.held_out_px,
        "alone_px": rig.rmse_px / growth,
        "growth": growth,
        "scatter": scatter,
        "depth": evidence.depth,
        "depth_share": evidence.depth_share,
    }
    return verdict_of(_findings(rig, evidence), measures)


@frozen_dataclass(eq=False)
class _Evidence:
    """Measures of a rig's quality; nan and None if a view does not determine its pose."""

    # Side of each camera, whether something of it was given, and the verdict by its own points.
    cameras: list[tuple[str, bool, Verdict]]
    names: tuple[tuple[str, str], ...]  # of all pairs, in order
    size: Array  # (P,) of each pair's target [world unit]
    moved: Contradiction | None = None  # of all pairs, if the rig moved
    contradiction: Contradiction | None = None  # of the pairs that determine the rig
    displacement: float = np.nan  # rms distance of the targets from their predicted positions [world unit]
    held_out_px: float = np.nan  # five-fold cross-validation error over pairs, if any can be left out
    depth: float = np.nan  # median depth of the points [world unit]
    depth_share: float = np.nan  # median std of triangulated depth over the depth, for exact pixels


def _evidence(rig: Rig) -> _Evidence:
    pairs = (*rig.pairs, *rig.left_out)
    cameras = [
        (side, camera.type != 1, verdict)
        for side, camera in (("left", rig.left), ("right", rig.right))
        if (verdict := assess(camera)) is not None
    ]
    poses = relative_poses(stereo_problem(rig.left, rig.right, pairs), rig.pose)
    if poses is None:
        return _Evidence(cameras, pairs, np.zeros(0))
    used = np.array([pair not in rig.left_out for pair in poses.names])
    found = contradiction(poses, used, seek_odd=False)
    depth, std = _depth_std(rig, poses, rig_covariance(poses, used, found))
    return _Evidence(
        cameras=cameras,
        names=poses.names,
        size=poses.size,
        moved=_moved(rig, poses, used, found),
        contradiction=found,
        displacement=_displacement(poses, used),
        held_out_px=_held_out(rig, poses, used),
        depth=_typical(depth),
        depth_share=_typical(std / depth),
    )


def _typical(of_points: Array) -> float:
    """Median of the finite values; nan if there are none."""
    fine = np.isfinite(of_points)
    return float(median(of_points[fine])) if fine.any() else np.nan


def _moved(
    rig: Rig, poses: RelativePoses, used: NDArray[np.bool_], found: Contradiction
) -> Contradiction | None:
    """The contradiction of all pairs if its explanation is that the rig moved."""
    reasons = [rig.left_out.get(pair, "") for pair in poses.names]
    either = np.array([reason == UNSYNCHRONISED or reason.startswith(MOVED) for reason in reasons])
    if either.any():
        found = contradiction(poses, used | either)
    return found if found.kind in TWO_GEOMETRIES else None


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


def _depth_std(rig: Rig, poses: RelativePoses, covariance: Array) -> tuple[Array, Array]:
    """Depths of some points in the left camera [world unit], and their standard deviations for exact pixels.

    `covariance` (F, F) is that of the unknowns of the relative poses. That of given cameras is added. The
    points are evenly spaced over the pairs; nan for points that are behind a camera.
    """
    estimated = poses.problem.estimated_shared
    state = poses.problem.start([rig.pose])
    given = covariance_by_given(poses.problem, state, poses.problem.normal(state)[0], estimated)
    shared = np.zeros((len(estimated), len(estimated)))
    shared[np.ix_(estimated, estimated)] = covariance
    covariance = shared if given is None else shared + given.shared
    columns = state.columns
    sides = rig.left.points, rig.right.points
    rows = pair_points(*sides, ViewPairs(rig.pairs))
    step = max(1, len(rows.left) // _MOST_POINTS)
    pixels = sides[0].pixels[rows.left[::step]], sides[1].pixels[rows.right[::step]]

    def depths(step: Array) -> Array:
        left, right = (_moved_camera(poses, side, step[columns.cameras[side]]) for side in (0, 1))
        w, tau = np.split(step[columns.rigs[1]], 2)
        pose = Pose(rotation_step(w) @ rig.R, rig.t + tau * poses.unit)
        found = triangulate(left, right, pose, *pixels)
        return np.where(found.behind, np.nan, found.points[:, 2])

    depth = depths(np.zeros(columns.n_shared))
    moving = np.flatnonzero(np.diagonal(covariance))
    covariance = covariance[np.ix_(moving, moving)]
    steps = np.maximum(_STEP * np.sqrt(np.abs(np.diagonal(covariance))), _LEAST_STEP)
    unit = np.eye(columns.n_shared)[moving]
    J = np.stack([(depths(h * one) - depth) / h for h, one in zip(steps, unit, strict=True)], axis=1)
    return depth, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, covariance, J), 0.0))


def _moved_camera(poses: RelativePoses, side: int, step: Array) -> Camera:
    """One camera after a step of A's entries and the distortion coefficients."""
    state, seen = poses.problem.cameras[side], poses.problem.observations[side]
    values = np.concatenate([state.entries[0], state.k]) + step
    A = intrinsic_matrix(seen.in_pixels(values[:5]))
    return Camera(Intrinsics.from_matrix(A), Distortion(state.model, values[5:]))


def _findings(rig: Rig, e: _Evidence) -> Iterator[Finding]:
    if not rig.converged:
        yield 2, f"training did not converge: {rig.stop_reason}", "increase --starts"
    # A camera that is poor by itself, or was given wrong, spoils the pairs, so it is named before them.
    for side, given, verdict in e.cameras:
        if verdict.reasons and (given or verdict.word == "poor"):
            advice = verdict.advice[0] if verdict.advice else ""
            yield WORDS.index(verdict.word), f"{side} camera: {verdict.reasons[0]}", advice
    yield from _pairs(rig, e)
    yield from _precision(rig, e)
    for side, _, verdict in e.cameras:
        # Reasons and advice come the worst first.
        for k, reason in enumerate(verdict.reasons):
            yield (1 if k else WORDS.index(verdict.word)), f"{side} camera: {reason}", ""
        for k, advice in enumerate(verdict.advice):
            yield (1 if k else WORDS.index(verdict.word)), "", advice


def _pairs(rig: Rig, e: _Evidence) -> Iterator[Finding]:
    """Findings about pairs that do not agree on one rig."""
    if len(rig.pairs) == 1:
        yield 1, "the rig rests on one pair of views, and nothing checks it", "add pairs of views"
    if e.moved is not None:
        parts = (e.names[: e.moved.at], e.names[e.moved.at :])
        kept = [part for part in parts if not set(part).isdisjoint(rig.pairs)]
        text, advice = describe_move(e.names, e.size, e.moved, kept[0] if len(kept) == 1 else ())
        yield _CHANGE.grade(e.moved.gain), text, advice
    odd = {
        pair: why for pair, why in rig.left_out.items() if not (e.moved is not None and why.startswith(MOVED))
    }
    if odd:
        yield (
            _LEFT_OUT.grade(len(odd) / len(e.names)),
            f"{describe_faults(odd, len(e.names))} and were left out",
            PAIR_ANEW if shifted(odd) else "look at the views of these pairs, and take them again",
        )
    found = e.contradiction
    if found is None:
        return
    if found.kind in (*FOCAL, *_MOTIONS):
        yield _changed(e, found)
        return
    if found.kind in TWO_GEOMETRIES:
        return
    poor = "the relative pose of the cameras differs from pair to pair"
    yield (
        max(_SCATTER.grade(found.rest), _GROWTH.grade(found.growth)),
        f"{poor}, by {found.rest:.2g} times what noise explains (rms {rig.rmse_px:.3g} px together, "
        f"{rig.rmse_px / found.growth:.3g} px each camera alone): the target moved by about "
        f"{e.displacement:.2g} {rig.unit} between the left and the right image, as they were not taken at "
        "the same moment, or the cameras are not fixed to each other",
        _MOMENT,
    )


def _changed(e: _Evidence, found: Contradiction) -> Finding:
    """Finding about a focal length that changed, or images taken at different moments."""
    grade = _CHANGE.grade(found.gain)
    if found.kind in _MOTIONS:
        sense, way = _MOTIONS[found.kind]
        return (
            grade,
            f"the two cameras were not triggered at the same moment: the right images were taken {sense}, as "
            f"they show the target {100 * found.amount:.2g} % of the way {way} pair's place",
            _MOMENT,
        )
    sides = " and the ".join(("left", "right")[side] for side in FOCAL[found.kind])
    return (
        grade,
        f"the focal length of the {sides} camera changed by {100 * found.amount:+.2g} % between "
        f"{pair_name(e.names[found.at - 1])} and {pair_name(e.names[found.at])}",
        "calibrate each part by itself, and lock zoom and focus",
    )


def _precision(rig: Rig, e: _Evidence) -> Iterator[Finding]:
    more = "add pairs of views in which the target is near, tilted and fills both images"
    yield (
        _DEPTH.grade(e.depth_share),
        f"the std of triangulated depth is {100 * e.depth_share:.2g} % of the depth",
        more,
    )
    share = rig.std["baseline"] / rig.baseline if rig.baseline > 0 else np.inf
    yield _BASELINE.grade(share), f"the std of the baseline is {100 * share:.2g} % of its length", more
    if e.contradiction is not None and rig.rmse_px > 0:
        yield (
            _HELD_OUT.grade(e.held_out_px / rig.rmse_px),
            f"the cross-validation error is {e.held_out_px:.3g} px, but the error on all data "
            f"{rig.rmse_px:.3g} px",
            "add pairs of views",
        )

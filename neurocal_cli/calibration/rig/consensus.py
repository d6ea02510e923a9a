"""The relative pose on which most pairs of views of two cameras agree, and the faults of the others.

Each pair of views gives the pose of the second camera relative to the first. Pairs that disagree with most
others are tested for five faults: the target is turned in one image (its points have another order), one
image is mirrored, the two images are exchanged, an image is paired with that of the next or the previous
moment, or the two were not taken at the same moment.

Before that, of the two poses that a small flat target may have in each image, those are taken on which both
cameras agree: each pair offers up to four relative poses, and the rig is the offer to which those of all
pairs, each by its nearest one, are nearest in the median.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.reprojection import predicted_pixels
from neurocal_cli.calibration.calibrate import CameraOptions, calibrate, fit_poses
from neurocal_cli.calibration.calibration import Calibration, ViewResult
from neurocal_cli.calibration.rig.adjust import rig_problem
from neurocal_cli.calibration.rig.frames import FrameNames, ViewPairs, frames_of_pairs
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.verdict.findings import ROUNDED, pixel_spread
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_to_rotation, median, nearest_rotation
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import NeurocalError
from neurocal_cli.observations.points import Correspondences

# Two pairs agree if their targets differ in the image by less than this share of the target's size or by less
# than so many standard deviations of a pixel. The tests of named faults in test_stereo_evaluation.py
# repeat that faults are found and sound pairs kept.
_SHARE = 0.1
_SIGMAS = 30.0
_HYPOTHESES = 40  # most pairs of which each is tried as the one that is right
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
AGREED, LEAST_AGREED = 0.8, 3
"""Share of the pairs, and fewest pairs, that must agree once a mistake is undone."""

EXCHANGED = "the left and the right image are exchanged"
UNSYNCHRONISED = "does not fit the others (not taken at the same moment?)"
PAIR_ANEW = (
    "one image of one camera is missing or was taken twice; name the views that were taken at the same "
    "moment alike"
)
NEXT = {"next": 1, "previous": -1}
SHIFTED = {word: f"the left image fits the right one of the {word} pair" for word in NEXT}
NEIGHBOUR = "fits the images of the"  # next or previous frame, of a view in a rig of more than two
OPPOSITE = {"next": "previous", "previous": "next"}

Pair = tuple[str, str]


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


def with_shifted(
    problem: RigProblem, rig: Pose, faults: Mapping[Pair, str], neighbours: Mapping[str, Sequence[Pair]]
) -> dict[Pair, str]:
    """The faults, with pairs named whose left views fit the right views of the next or the previous frames.

    From the place on where one camera lost an image, or took one twice, all views are paired wrongly.
    `neighbours` are the left views with these right ones.
    """
    odd = {a: b for (a, b), reason in faults.items() if reason == UNSYNCHRONISED}
    for word in SHIFTED:
        moved = [pair for pair in neighbours[word] if pair[0] in odd]
        if len(moved) < LEAST_AGREED:
            continue
        shifted = _of_pairs(problem, moved)
        fits = _distance(shifted, _poses(shifted), rig.R[None], rig.t[None])[0] < 1
        if fits.sum() >= max(LEAST_AGREED, AGREED * len(moved)):
            names = [a for (a, _), one in zip(shifted.pairs, fits, strict=True) if one]
            return {**faults, **{(a, odd[a]): SHIFTED[word] for a in names}}
    return dict(faults)


def all_shifted(problem: RigProblem, neighbours: Mapping[str, Sequence[Pair]]) -> str:
    """The word for the frames whose right views the left views fit, if all are paired wrongly; else empty.

    `neighbours` are the left views with these right ones.
    """
    for word in SHIFTED:
        if len(neighbours[word]) < 2 * LEAST_AGREED:
            continue
        reasons = find_consensus(_of_pairs(problem, neighbours[word])).reasons
        if reasons.count("") > AGREED * len(reasons):
            return word
    return ""


def changed(problem: RigProblem, a: int, b: int, place: NDArray[np.intp]) -> tuple[int, int, int] | None:
    """How many more pairs of two cameras agree if all their relative poses change at some frame.

    The other results are the last frame before that and the next one. None if hardly any more agree.
    `place` (V,) is that of each frame in their sequence.
    """
    n = len(place)
    agreed, is_seen = np.zeros(n + 1), np.zeros(n, dtype=bool)
    for two, first in _with_any(problem, a, b):
        frames = place[problem.observations[first].view[two.paired_left]]
        poses = _poses(two)
        R, t = poses.rigs()
        fits = np.zeros((len(R), n + 1))
        fits[:, 1 + frames] = _distance(two, poses, R, t) < 1
        before = fits.cumsum(axis=1)
        agreed += before.max(axis=0) + (before[:, -1:] - before).max(axis=0)
        is_seen[frames] = True
    at, seen = int(np.argmax(agreed)), np.flatnonzero(is_seen)
    gained = int(agreed[at] - agreed[-1])
    if gained < LEAST_AGREED:
        return None
    return gained, int(seen[seen < at].max(initial=0)), int(seen[seen >= at].min(initial=n - 1))


def mended_by_exchange(problem: RigProblem, a: int, b: int, is_late: NDArray[np.bool_]) -> int:
    """How many more pairs agree on a rig if two cameras exchange their images of late frames (V,).

    Both are calibrated again from the images that are theirs then, as lenses that differ move all poses.
    """
    cameras, frames = list(problem.calibrations), [observed.view for observed in problem.observations]
    for own, other in ((a, b), (b, a)):
        parts = [_of_frames(problem, own, ~is_late), _of_frames(problem, other, is_late)]
        world, pixels, views = (np.concatenate(part) for part in zip(*parts, strict=True))
        before = problem.calibrations[own]
        known: CameraOptions = {"skew": False, "target": "given"}
        if before.type == 3:
            known |= {"type": 3, "intrinsics": before.camera}
        points = Correspondences(world, pixels, views, before.image_size, unit=before.unit)
        try:
            cameras[own] = calibrate(points, **known)
        except NeurocalError:
            return 0
        frames[own] = np.array([int(name) for name in cameras[own].points.view_names])
    numbers = np.unique(np.concatenate(frames), return_inverse=True)[1]
    found = rig_problem(cameras, np.split(numbers, np.cumsum([len(own) for own in frames[:-1]])))
    left, odd = (sum(sum(map(bool, find_consensus(two).reasons)) for two, _ in _with_any(of, a, b))
                 for of in (found, problem))  # fmt: skip
    return odd - left


def _with_any(problem: RigProblem, a: int, b: int) -> Iterator[tuple[RigProblem, int]]:
    """The problems of two cameras, and of each of them with any other one; and the first camera of each."""
    others = [c for c in range(len(problem.cameras)) if c not in (a, b)]
    for c, d in [(a, b), *((one, c) for c in others for one in (a, b))]:
        two = problem.of_two(c, d)
        if len(two.paired):
            yield two, c


def _as_given(camera: Calibration) -> Correspondences:
    return camera.points if camera.target is None else camera.target.as_given(camera.points)


def _of_frames(
    problem: RigProblem, side: int, some: NDArray[np.bool_]
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Points of a camera in some of the frames, (V,), as given, with their pixels and frames."""
    points = _as_given(problem.calibrations[side])
    frame = problem.observations[side].view[points.view_index]
    return points.world[some[frame]], points.pixels[some[frame]], frame[some[frame]]


def exchanged_lenses(
    problem: RigProblem, suspects: Sequence[int], place: NDArray[np.intp]
) -> dict[tuple[int, int], tuple[int, int, int]]:
    """As `changed`, of all pairs of some cameras, by how many frames clearly fit the lenses of both.

    Files with images of several cameras may tell none of their poses. Lenses are those of the first third of
    the views of each file, or of the last third, of which one is by one camera.
    """
    found: dict[tuple[int, int], tuple[int, int, int]] = {}
    sides = {}
    for c in suspects:
        sides[c] = _as_given(problem.calibrations[c]), place[problem.observations[c].view]
    for is_late in (False, True):
        try:
            lenses = {c: _of_third(*side, is_late) for c, side in sides.items()}
            errors = {(c, d): _errors_of_views(sides[c][0], lenses[d]) for c in sides for d in sides}
        except NeurocalError:
            continue
        for a, b in combinations(suspects, 2):
            odds = np.zeros(len(place))
            for own, other in ((a, b), (b, a)):
                np.add.at(odds, sides[own][1], np.log(errors[own, own] / errors[own, other]))
            votes = np.where(np.abs(odds) > -np.log(_NEARER), np.sign(odds), 0) * (-1 if is_late else 1)
            at, clear = int(np.argmin(np.cumsum(np.append(0, votes)))), np.flatnonzero(votes)
            fits = int((votes[:at] < 0).sum()), int((votes[at:] > 0).sum())
            if min(fits) >= LEAST_AGREED and sum(fits) > AGREED * len(clear):
                found[a, b] = sum(fits), int(clear[clear < at].max()), int(clear[clear >= at].min())
    return found


def _of_third(points: Correspondences, place: NDArray[np.intp], is_late: bool) -> Calibration:
    """The camera of the first or last third of the views, whose places in the sequence are (V,)."""
    order = np.argsort(place)[:: -1 if is_late else 1]
    kept = np.isin(np.arange(len(place)), order[: len(place) // 3])
    return calibrate(points.select(kept[points.view_index]), skew=False, target="given")


def _errors_of_views(points: Correspondences, lens: Calibration) -> Array:
    """(V,) median errors of the views with the poses that fit a camera, at least those of rounding [px]."""
    state = fit_poses(points, lens.camera, lens.seed).state(points.view_names)
    off = predicted_pixels(state, points.world, points.view_index)[0] - points.pixels
    errors, view = np.linalg.norm(off, axis=1), points.view_index
    found = np.array([float(median(errors[view == k])) for k in range(points.n_views)])
    return np.maximum(found, ROUNDED * pixel_spread(points))


def _of_pairs(problem: RigProblem, pairs: Sequence[Pair]) -> RigProblem:
    """The problem of the two cameras with other pairs of views."""
    left, right = problem.names
    return rig_problem(problem.calibrations, frames_of_pairs(left, right, pairs).of_views)


@frozen_dataclass(eq=False)
class _Poses:
    """Poses of the paired targets in each camera alone: rotations and centres, left and right."""

    R: tuple[Array, Array]
    m: tuple[Array, Array]

    def rigs(self) -> tuple[Array, Array]:
        """R and t of single pairs, for an even choice of the pairs."""
        n = len(self.R[0])
        some = np.linspace(0, n - 1, min(n, _HYPOTHESES)).astype(int)
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
    # (H, P, 5, 3): the targets in the right camera's frame, as each rig predicts them. Directions are
    # compared, because a wide lens sees what is beside and behind it.
    through = _directions(np.einsum("hij,pnj->hpni", R, targets[0]) + t[:, None, None, :])
    seen = _directions(targets[1])
    focal = np.sqrt(problem.cameras[1].entries[0, [0, 2]].prod())
    apart, size = (
        focal * np.sqrt((difference**2).sum(axis=-1).mean(axis=-1))
        for difference in (through - seen, seen - seen[:, :1])
    )
    noise = _SIGMAS / np.sqrt(problem.observations[1].weight)
    return np.asarray(apart / np.maximum(_SHARE * size, noise))


def _directions(X: Array) -> Array:
    """Unit vectors towards points (..., 3)."""
    return X / np.maximum(np.linalg.norm(X, axis=-1, keepdims=True), 1e-300)


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
        EXCHANGED,
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
    away = np.linalg.norm(poses.m[1][agree], axis=1)
    t = poses.m[1][agree] - poses.m[0][agree] @ R.T
    return Pose(R, np.average(t, axis=0, weights=1.0 / away**2))


def with_agreeing_poses(cameras: list[Calibration], views: FrameNames) -> list[Calibration]:
    """Cameras with the poses of flat targets on which they agree with others."""
    if not any(camera.second_poses for camera in cameras):
        return cameras
    frames = [dict(zip(own.tolist(), camera.points.view_names, strict=True))
              for own, camera in zip(views.of_views, cameras, strict=True)]  # fmt: skip
    for a in range(len(cameras)):
        for b in range(a + 1, len(cameras)):
            both = tuple((frames[a][k], frames[b][k]) for k in frames[a].keys() & frames[b].keys())
            if both:
                cameras[a], cameras[b] = _of_two(cameras[a], cameras[b], both)
    return cameras


def _of_two(left: Calibration, right: Calibration, views: ViewPairs) -> tuple[Calibration, Calibration]:
    """Both cameras, with the poses of paired views on which they agree, and no second poses of these."""
    if not (left.second_poses or right.second_poses):
        return left, right
    offers = [[(a, b) for a in _possible(left, one) for b in _possible(right, other)] for one, other in views]
    padded = [[*some, *[some[0]] * (4 - len(some))] for some in offers]
    R_left, R_right = (np.array([[o[side].pose.R for o in some] for some in padded]) for side in (0, 1))
    t_left, t_right = (np.array([[o[side].pose.t for o in some] for some in padded]) for side in (0, 1))
    R = R_right @ np.swapaxes(R_left, 2, 3)  # (P, 4, 3, 3)
    t = t_right - (R @ t_left[..., None])[..., 0]  # (P, 4, 3)
    away = _nearest(R, t, np.linalg.norm(t_left, axis=2))
    sides = [dict(left.views), dict(right.views)]
    for pair, some, offer in zip(views, padded, away, strict=True):
        for side, name, view in zip(sides, pair, some[int(offer)], strict=True):
            side[name] = replace(view, std=side[name].std, probability=1.0)
    names = [{pair[side] for pair in views} for side in (0, 1)]
    return _settled(left, sides[0], names[0]), _settled(right, sides[1], names[1])


def _settled(camera: Calibration, views: dict[str, ViewResult], names: set[str]) -> Calibration:
    """A camera with other poses, of which those of the named views are certain."""
    rest = {name: view for name, view in camera.second_poses.items() if name not in names}
    return replace(camera, views=views, second_poses=rest)


def _possible(camera: Calibration, view: str) -> list[ViewResult]:
    second = camera.second_poses.get(view)
    return [camera.views[view], *([] if second is None else [second])]


def _nearest(R: Array, t: Array, distance: Array) -> Array:
    """(P,) which offer of each pair is nearest to the rig; R (P, 4, 3, 3), t (P, 4, 3), distance (P, 4)."""
    flat_R, flat_t = R.reshape(-1, 3, 3), t.reshape(-1, 3)
    some = np.unique(np.linspace(0, len(flat_R) - 1, R.shape[1] * _HYPOTHESES).astype(int))
    cosine = 0.5 * (np.einsum("hij,pcij->hpc", flat_R[some], R) - 1)
    shift = np.linalg.norm(flat_t[some][:, None, None] - t, axis=3) / distance
    away = np.arccos(np.clip(cosine, -1.0, 1.0)) + shift  # (H, P, 4) [rad]
    best = int(np.argmin(median(away.min(axis=2).T)))
    return np.asarray(away[best].argmin(axis=1))

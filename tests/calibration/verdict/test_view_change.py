"""A camera that changes between the views is told, with its cause; one that does not is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.grouped_views import ALPHA, board, photographed, poses, rescaled
from support.real_data import RealFiles
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Correspondences, Pose, calibrate, read_points
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses
from neurocal_cli.adjustment.view_covariance import scores_of_poses
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.verdict.assessment import gather_evidence
from neurocal_cli.calibration.verdict.view_change import in_sequence, view_change
from neurocal_cli.camera.state import CameraState

Make = Callable[[int, np.random.Generator], Correspondences]


def drift(share: float) -> Make:
    return lambda n, rng: photographed(poses(n, rng), rng, focal=1.0 + share * np.linspace(0, 1, n))


def by_pose(share: float, of_pose: Callable[[Pose], float]) -> Make:
    def make(n: int, rng: np.random.Generator) -> Correspondences:
        views = poses(n, rng)
        values = np.array([of_pose(pose) for pose in views])
        return photographed(views, rng, focal=1.0 + share * (values - values.min()) / np.ptp(values))

    return make


def near_and_far(share: float) -> Make:
    return by_pose(share, lambda pose: 1.0 / float(np.linalg.norm(pose.t + pose.R @ board().mean(axis=0))))


def left_and_right(share: float) -> Make:
    return by_pose(share, lambda pose: -np.sign(pose.R[2, 2]) * float(pose.R[0, 2]))


def every_other(share: float) -> Make:
    return lambda n, rng: rescaled(photographed(poses(n, rng), rng), np.arange(n) % 2 == 1, 1.0 + share)


def second_half(share: float) -> Make:
    return lambda n, rng: rescaled(photographed(poses(n, rng), rng), np.arange(n) >= n // 2, 1.0 + share)


def bent_and_every_other(share: float, curl: float) -> Make:
    def make(n: int, rng: np.random.Generator) -> Correspondences:
        return rescaled(photographed(poses(n, rng), rng, curl=curl), np.arange(n) % 2 == 1, 1.0 + share)

    return make


def any_half(share: float) -> Make:
    return lambda n, rng: rescaled(photographed(poses(n, rng), rng), rng.permutation(n) < n // 2, 1.0 + share)


def clean(n: int, rng: np.random.Generator) -> Correspondences:
    return photographed(poses(n, rng), rng, noise=float(rng.uniform(0.05, 0.6)))


def found(make: Make, seed: int) -> Calibration:
    rng = np.random.default_rng([seed, 77])
    return calibrate(make(int(rng.integers(9, 20)), rng))


def silently_wrong(cal: Calibration, share: float) -> bool:
    """Good, with a focal length that none of the views had, by 3 of its deviations or by 1 %."""
    alpha = cal.intrinsics.alpha_u
    off = max(ALPHA - alpha, alpha - ALPHA * (1 + share), 0.0)
    return cal.verdict.word == "good" and (off > 3 * cal.std["alpha_u"] or off > 0.01 * ALPHA)


def told(make: Make, share: float, words: tuple[str, ...], seeds: range) -> int:
    """In how many sets a reason has some of these words; none is silently wrong."""
    results = [found(make, seed) for seed in seeds]
    assert not any(silently_wrong(cal, share) for cal in results)
    return sum(any(some in reason for some in words for reason in cal.verdict.reasons) for cal in results)


CHANGES = {
    "drift": (drift, ("so zoom or focus",)),  # as a line, or as a step
    "focus that follows": (near_and_far, ("from the farthest to the nearest view",)),
    "turned left and right": (left_and_right, ("turned to the left to those to the right",)),
    "every other image scaled": (every_other, ("these views are scaled by",)),
    "second half scaled": (second_half, ("from view img0",)),
    # With two percent, images of two sizes are called images of two cameras in some sets.
    "any half scaled": (any_half, ("these views are scaled by", "the images come from two cameras")),
}


@pytest.mark.parametrize("share", slow_but((0.01,), (0.01, 0.02)))
@pytest.mark.parametrize(
    "change",
    slow_but(("drift",), ("drift", "every other image scaled", "focus that follows")),
)
def test_a_camera_that_changes_is_told_with_the_cause(change: str, share: float) -> None:
    make, words = CHANGES[change]
    assert told(make(share), share, words, range(3)) >= 2


# Of 14 views half a percent is 4 sigmas, of the best of all halvings hardly more than chance; 0.2 % is none.
@pytest.mark.slow
@pytest.mark.parametrize("share", [0.002, 0.005, 0.01, 0.02])
@pytest.mark.parametrize("change", list(CHANGES))
def test_changes_of_all_sizes(change: str, share: float) -> None:
    make, words = CHANGES[change]
    least = {0.002: 0, 0.005: 0 if change == "any half scaled" else 7, 0.01: 20, 0.02: 24}[share]
    assert told(make(share), share, words, range(30)) >= least


@pytest.mark.parametrize("seeds", slow_but((range(2, 3),), (range(2, 3), range(20))))
@pytest.mark.parametrize("curl", slow_but((0.5,), (0.5, 2.0)))
def test_images_of_two_sizes_are_told_of_a_bent_board_too(curl: float, seeds: range) -> None:
    words = ("these views are scaled by",)
    assert told(bent_and_every_other(0.01, curl), 0.01, words, seeds) >= 2 / 3 * len(seeds)
    assert told(bent_and_every_other(0.0, curl), 0.0, words, seeds) == 0


def clean_sets_told(seeds: range) -> int:
    count = 0
    for seed in seeds:
        rng = np.random.default_rng([seed, 3])
        points = clean(int(np.exp(rng.uniform(np.log(4), np.log(40)))), rng)
        evidence = gather_evidence(calibrate(points, distortion="k1k2p1p2", outliers="keep"))
        count += (evidence.change is not None) + (evidence.board is not None)
    return count


def test_clean_views_are_of_one_camera_and_a_flat_board() -> None:
    assert clean_sets_told(range(12)) <= 1


@pytest.mark.slow
def test_of_clean_sets_less_than_one_in_a_hundred_is_told() -> None:
    assert clean_sets_told(range(1000)) < 10


def test_the_natural_order_of_names() -> None:
    names = ("img10", "img2", "b3", "img1", "7", "img2b")
    assert [names[k] for k in in_sequence(names)] == ["7", "b3", "img1", "img2", "img2b", "img10"]


def test_the_sequence_is_that_of_the_names_not_of_the_file() -> None:
    rng = np.random.default_rng(5)
    views = poses(12, rng)
    points = photographed(views, rng, focal=1.0 + 0.015 * np.linspace(0, 1, 12))
    shuffled = np.concatenate([np.flatnonzero(points.view_index == k) for k in rng.permutation(12)])
    change = gather_evidence(calibrate(points.select(shuffled))).change
    assert change is not None
    assert change.pattern == "line"
    assert change.amount == pytest.approx(0.015, abs=5 * 0.015 / change.sigmas)
    assert list(change.views) == sorted(change.views)


def test_the_second_group_is_named() -> None:
    rng = np.random.default_rng(6)
    scaled = np.array([0, 1, 0, 0, 1, 1, 1, 0, 1, 0, 0, 1, 1, 0], dtype=bool)
    points = rescaled(photographed(poses(14, rng), rng), scaled, 0.98)
    change = gather_evidence(calibrate(points)).change
    assert change is not None
    assert (change.what, change.pattern) in (("image size", "groups"), ("focal length", "groups"))
    group = np.isin([f"img{k:03d}" for k in range(14)], change.views)
    assert min((group != scaled).sum(), (group == scaled).sum()) <= 2


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rescale", "these views are scaled by 0.996"),
        ("drift", "the focal length grows by 1 % along the sequence of the views"),
    ],
)
def test_small_contradictions(real_files: RealFiles, name: str, words: str) -> None:
    cal = calibrate(read_points(real_files(f"wrong_data/{name}.csv")[0]))
    assert cal.verdict.word == "usable"
    assert words in cal.verdict.reasons[0]
    # What the normal matrix says, 0.48 and 0.50, is several times too small.
    assert cal.std["alpha_u"] > 0.7


def test_views_that_determine_nothing_are_no_change_and_no_failure() -> None:
    """A singular normal matrix must not end in an exception."""
    views = arrange(clean(6, np.random.default_rng(1)))
    state = CameraState(np.array([[1.0, 0, 1.0, 0, 0]]), np.tile(np.eye(3), (6, 1, 1)), np.ones((6, 3)))
    normal = np.zeros((6, 12, 12))
    normal[:, -1, -1] = 1.0
    free = np.array([1, 0, 1, 1, 1], dtype=bool)
    repeated = RepeatedPoses(np.arange(6), 0.0)
    scores = scores_of_poses(normal, free, True, repeated)
    assert view_change(views, state, free, scores, repeated.group, 1.0, 100.0) is None

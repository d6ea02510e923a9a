"""Whether a camera of a rig has moved: never for an unchanged rig, and by what for one that was knocked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.many_cameras import SIGMA, moved
from support.many_cameras import scene as seen_by_many
from support.rigs import RigScene, random_rig, sides

from neurocal_cli import Pose, calibrate, calibrate_rig, evaluate_rig
from neurocal_cli.calibration.calibrate import CameraOptions, fit_poses
from neurocal_cli.calibration.drift import SHARE
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.rig import Rig, named_std
from neurocal_cli.calibration.rig.rig_drift import find_pose_drift, find_rig_drift, moved_since
from neurocal_cli.errors import InputError
from neurocal_cli.simulation.rigs import SimulatedRig


def again(scene: RigScene, seed: int, kind: str = "verging", n_views: int = 10) -> RigScene:
    """The same rig, with other views."""
    other = random_rig(np.random.default_rng([seed, 7]), kind, n_views)
    nearer = scene.cameras[0].alpha_u / other.cameras[0].alpha_u
    return replace(scene, poses={name: Pose(p.R, p.t * nearer) for name, p in other.poses.items()})


def calibrated(scene: RigScene, seed: int, sigma: float = 0.05) -> Rig:
    left, right = sides(scene, sigma, seed)
    return calibrate_stereo(left, right, distortion="none", target="given", outliers="keep")


def test_a_camera_that_turned_and_one_that_moved_are_told_from_one_that_did_not() -> None:
    scene = random_rig(np.random.default_rng(3), "verging", 10)
    old, new = calibrated(scene, 1), again(scene, 2)
    assert not find_pose_drift(old, calibrated(new, 2), "right").different
    turn = Pose.from_euler(0.0, 0.006, 0.0, np.zeros(3)).R
    turned = find_pose_drift(old, calibrated(replace(new, rig=Pose(turn @ new.rig.R, new.rig.t)), 3), "right")
    assert turned.different
    assert turned.turn == pytest.approx([0.0, 0.006, 0.0], abs=4 * turned.turn_std.max())
    apart = find_pose_drift(old, calibrated(replace(new, rig=Pose(new.rig.R, 1.02 * new.rig.t)), 4), "right")
    assert apart.different
    expected = 0.02 * float(np.linalg.norm(new.rig.t))
    assert apart.baseline == pytest.approx(expected, abs=4 * apart.baseline_std)


def test_what_changed_in_a_rig_is_named() -> None:
    scene = random_rig(np.random.default_rng(3), "verging", 10)
    old, new = calibrated(scene, 1), again(scene, 2)
    same = find_rig_drift(old, calibrated(new, 2))
    assert (same.changed, same.moved, same.different) == ((), (), False)
    turned = replace(new, rig=Pose(Pose.from_euler(0.0, 0.006, 0.0, np.zeros(3)).R @ new.rig.R, new.rig.t))
    assert find_rig_drift(old, calibrated(turned, 3)).moved == ("right",)
    left, right = new.cameras
    longer = replace(left, alpha_u=1.01 * left.alpha_u, alpha_v=1.01 * left.alpha_v)
    assert "left" in find_rig_drift(old, calibrated(replace(new, cameras=(longer, right)), 3)).changed


def test_of_several_cameras_the_knocked_one_is_named_even_if_it_is_the_first() -> None:
    pair = calibrated(random_rig(np.random.default_rng(3), "verging", 10), 1)
    names, none = "abcd", dict.fromkeys(pair.std, 0.0)
    poses = {name: Pose(np.eye(3), np.array([100.0 * k, 0, 0])) for k, name in enumerate(names)}
    covariance = np.diag(np.tile([1e-6] * 3 + [0.01] * 3, 3))
    std = {name: none if name == "a" else named_std(covariance[:6, :6], poses[name].t) for name in names}
    cameras = dict.fromkeys(names, pair.cameras["left"])
    rig = replace(pair, cameras=cameras, poses=poses, pose_std=std, covariance=covariance)
    turn = Pose.from_euler(0.0, 0.05, 0.0, np.zeros(3)).R

    def knocked(*some: str) -> Rig:
        turned = {name: Pose(turn @ p.R, turn @ p.t) if name in some else p for name, p in poses.items()}
        return replace(rig, poses={name: pose.relative_to(turned["a"]) for name, pose in turned.items()})

    assert not find_rig_drift(rig, knocked()).different
    for some, reference in ((("c",), "a"), (("a",), "b"), (("a", "b"), "c")):
        found = find_rig_drift(rig, knocked(*some))
        assert (found.moved, found.reference) == (some, reference)


def test_rigs_that_cannot_be_compared_are_refused() -> None:
    rig = calibrated(random_rig(np.random.default_rng(3), "verging", 10), 1)
    renamed = replace(rig, cameras={f"{name}1": camera for name, camera in rig.cameras.items()})
    with pytest.raises(InputError, match="different cameras: left, right, and left1, right1"):
        find_rig_drift(rig, renamed)
    with pytest.raises(InputError, match="relative to left"):
        find_pose_drift(rig, replace(rig, cameras=dict(reversed(rig.cameras.items()))), "right")
    unknown = replace(rig, covariance=np.full((6, 6), np.nan))
    with pytest.raises(InputError, match="are unknown"):
        find_pose_drift(rig, unknown, "right")
    assert find_pose_drift(rig, rig, "right").share == 1.0


def test_cameras_that_both_rigs_were_given_do_not_make_them_different_or_alike() -> None:
    ratios, shares = [], []
    for k in range(6):
        scene = random_rig(np.random.default_rng([k, 5]), "verging", 10)
        earlier = sides(again(scene, 1000 + k, n_views=5), 0.2, 9 * k)
        given: list[CameraOptions] = [
            {"type": 3, "intrinsics": calibrate(one, distortion="none", target="given")} for one in earlier
        ]
        old, new = (
            calibrate_stereo(*sides(one, 0.2, 2 * k + j), *given, target="given", outliers="keep")
            for j, one in enumerate((scene, again(scene, k)))
        )
        found = find_pose_drift(old, new, "right")
        assert not found.different
        ratios.append(np.append(found.turn / found.turn_std, found.shift / found.shift_std))
        # Without the points, it is not known what they share.
        apart = find_pose_drift(old.lean, new.lean, "right")
        assert find_rig_drift(old, new).twice == ()
        assert find_rig_drift(old.lean, new.lean).twice == ("left", "right")
        shares.append(found.shift_std[2] / apart.shift_std[2])
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.3
    assert max(shares) < 0.3


@pytest.fixture(scope="module")
def line() -> tuple[SimulatedRig, Rig]:
    truth, points = seen_by_many("line", 4, 16)
    return truth, calibrate_rig(points, target="given")


def judged(line: tuple[SimulatedRig, Rig], truth: SimulatedRig, size: float = 1.0) -> tuple[str, ...]:
    """The reasons of the verdict by new frames of a rig."""
    frames = dict(list(seen_by_many("line", 4, 16, 50)[0].frames.items())[:8])
    points = replace(truth, frames=frames).points(SIGMA, np.random.default_rng(9))
    verdict = evaluate_rig(
        line[1], {name: replace(one, world=size * one.world) for name, one in points.items()}
    ).verdict
    assert verdict is not None
    return verdict.reasons


@pytest.mark.parametrize(
    ("name", "degrees", "mm", "told"),
    [
        ("cam3", 0.5, 0.0, "relative to cam0, moved cam3 by 0.5"),
        ("cam0", 2.0, 0.0, "relative to cam1, moved cam0 by 2 degrees"),
        ("cam1", 0.0, 10.0, "relative to cam0, moved cam1 by 0.0"),
    ],
)
def test_new_frames_name_the_camera_that_was_bumped(
    line: tuple[SimulatedRig, Rig], name: str, degrees: float, mm: float, told: str
) -> None:
    reason = judged(line, moved(line[0], name, degrees, mm))[0]
    assert reason.startswith(f"since the calibration, {told}")
    assert reason.count("degrees") == 1


def test_new_frames_of_an_unchanged_rig_and_those_of_another_target_accuse_no_camera(
    line: tuple[SimulatedRig, Rig],
) -> None:
    assert not any("since the calibration" in reason for reason in judged(line, line[0]))
    reasons = judged(line, line[0], 1.2)
    assert "all distances of the cameras are 1.2 times that of the rig" in reasons[0]
    assert not any("since the calibration" in reason for reason in reasons)


@pytest.mark.slow
def test_new_frames_of_unchanged_rigs_differ_as_their_std_says() -> None:
    ratios, accused = [], []
    for seed in range(30):
        truth, points = seen_by_many(("line", "star")[seed % 2], 3 + seed % 3, 24, seed)
        rig = calibrate_rig(points)
        frames = dict(list(seen_by_many("star", 3 + seed % 3, 24, seed + 50)[0].frames.items())[:14])
        new = replace(truth, frames=frames).points(SIGMA, np.random.default_rng(seed + 9))
        found = moved_since(rig, {name: fit_poses(one, rig.cameras[name], 0) for name, one in new.items()})
        if found is None:  # not all cameras are in these frames
            continue
        accused += found.moved
        for one in found.poses.values():
            ratios.append(np.append(one.turn / one.turn_std, one.shift / one.shift_std))
    assert len(ratios) > 50
    assert not accused
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.15


@pytest.mark.slow
def test_pairs_of_an_unchanged_rig_differ_in_at_most_the_stated_share() -> None:
    shares, ratios = [], []
    for k in range(120):
        kind = ("parallel", "verging", "wide", "narrow")[k % 4]
        scene = random_rig(np.random.default_rng([k, 5]), kind)
        old, new = calibrated(scene, 2 * k, 0.1), calibrated(again(scene, k, kind), 2 * k + 1, 0.1)
        found = find_pose_drift(old, new, "right")
        shares.append(found.share)
        ratios.append(np.concatenate([found.turn / found.turn_std, found.shift / found.shift_std]))
    assert min(shares) > SHARE
    assert np.mean(np.array(shares) < 0.1) < 0.2
    assert np.sqrt((np.array(ratios) ** 2).mean(axis=0)) == pytest.approx(np.ones(6), abs=0.25)

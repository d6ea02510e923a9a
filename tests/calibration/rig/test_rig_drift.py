"""Whether a camera of a rig has moved: never for an unchanged rig, and by what for one that was knocked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.rigs import RigScene, random_rig, sides

from neurocal_cli import Pose
from neurocal_cli.calibration.drift import SHARE
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.rig import Rig, named_std
from neurocal_cli.calibration.rig.rig_drift import find_pose_drift, find_rig_drift
from neurocal_cli.errors import InputError


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

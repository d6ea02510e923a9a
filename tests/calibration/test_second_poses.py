"""A flat target that is small or far away may be tilted the other way as well: both poses are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neurocal_cli import Calibration, Camera, Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.commands.show.camera_report import calibration_json
from neurocal_cli.commands.streams import for_json
from neurocal_cli.files import calibration_yaml
from neurocal_cli.files.calibration_yaml import read_calibration
from neurocal_cli.files.result_files import write_calibration

CAMERA = Camera(Intrinsics(1000.0, 1000.0, 960.0, 540.0), image_size=(1920, 1080))
BOARD = np.array([[64.0 * c, 64.0 * r, 0.0] for r in range(4) for c in range(6)]) - [160, 96, 0]


def poses(n: int, seed: int, distance: float) -> list[Pose]:
    rng = np.random.default_rng([n, seed])
    angles = rng.uniform([-0.6, -0.6, -np.pi], [0.6, 0.6, np.pi], (n, 3))
    places = rng.uniform([-0.2, -0.2, 1], [0.2, 0.2, 1], (n, 3)) * distance
    return [Pose.from_euler(*turned, place) for turned, place in zip(angles, places, strict=True)]


def seen(true: list[Pose], sigma: float, seed: int = 1) -> Correspondences:
    pixels = np.concatenate([CAMERA.project(pose.to_camera(BOARD))[0] for pose in true])
    names = np.repeat([f"m{k:02d}" for k in range(len(true))], len(BOARD))
    noise = sigma * np.random.default_rng(seed).normal(size=pixels.shape)
    return Correspondences(np.tile(BOARD, (len(true), 1)), pixels + noise, names, CAMERA.image_size)


def located(points: Correspondences) -> Calibration:
    return calibrate(points, type=3, intrinsics=CAMERA, target="given")


def turn(one: Pose, other: Pose) -> float:
    """Angle between two poses [degrees]."""
    return float(np.degrees(np.arccos(np.clip((np.trace(one.R @ other.R.T) - 1) / 2, -1, 1))))


@pytest.fixture(scope="module")
def far() -> tuple[list[Pose], Calibration]:
    true = poses(60, 0, 6000.0)
    return true, located(seen(true, 0.4))


def test_a_pose_that_is_wrong_is_told_and_the_other_is_right(far: tuple[list[Pose], Calibration]) -> None:
    true, found = far
    assert len(found.views) == len(true)
    wrong = 0
    for pose, (name, view) in zip(true, found.views.items(), strict=True):
        if turn(view.pose, pose) > 15:
            wrong += 1
            assert turn(found.second_poses[name].pose, pose) < 15
    assert wrong > 1


def test_standard_deviations_cover_both_poses(far: tuple[list[Pose], Calibration]) -> None:
    true, found = far
    z = []
    for pose, view in zip(true, found.views.values(), strict=True):
        turned = (view.pose.euler - pose.euler + np.pi) % (2 * np.pi) - np.pi
        z.append(np.concatenate([turned, view.pose.t - pose.t]) / list(view.std.values()))
    assert np.abs(z).max() < 5
    assert np.sqrt(np.mean(np.square(z))) < 1.3


def test_their_probabilities_are_true(far: tuple[list[Pose], Calibration]) -> None:
    true, found = far
    known = dict(zip(found.views, true, strict=True))
    wrong = sum(
        turn(second.pose, known[name]) < turn(found.views[name].pose, known[name])
        for name, second in found.second_poses.items()
    )
    expected = np.array([view.probability for view in found.second_poses.values()])
    assert abs(wrong - expected.sum()) < 3 * np.sqrt((expected * (1 - expected)).sum())
    for name, view in found.second_poses.items():
        assert view.probability + found.views[name].probability == pytest.approx(1)


def test_the_verdict_names_the_views(far: tuple[list[Pose], Calibration]) -> None:
    _, found = far
    assert found.verdict is not None
    assert found.verdict.word == "usable"
    (reason,) = (r for r in found.verdict.reasons if "tilted the other way" in r)
    assert reason.startswith(", ".join(list(found.second_poses)[:3]))


def test_a_target_that_fills_the_image_has_one_pose() -> None:
    true = poses(6, 2, 800.0)
    found = located(seen(true, 0.2))
    assert found.second_poses == {}
    assert all(view.probability == 1 for view in found.views.values())
    assert max(turn(view.pose, pose) for view, pose in zip(found.views.values(), true, strict=True)) < 0.5


@pytest.mark.parametrize("long", [False, True])
def test_files_have_both_poses(
    far: tuple[list[Pose], Calibration], long: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, found = far
    if long:
        monkeypatch.setattr(calibration_yaml, "_MOST_VIEWS", 4)
    write_calibration(replace(found, network=None), tmp_path / "camera.yaml")
    again = read_calibration(tmp_path / "camera.yaml")
    assert list(again.second_poses) == list(found.second_poses)
    for name, view in found.second_poses.items():
        assert (again.second_poses[name].pose.R == view.pose.R).all()
        assert again.second_poses[name].probability == view.probability
        assert again.views[name].probability == found.views[name].probability


def test_json_has_both_poses(far: tuple[list[Pose], Calibration]) -> None:
    _, found = far
    written = for_json(calibration_json(found)["second_poses"])
    assert list(written) == list(found.second_poses)
    for name, (first, second) in written.items():
        assert first["R"] == found.views[name].pose.R.tolist()
        assert second["t"] == found.second_poses[name].pose.t.tolist()
        assert first["probability"] + second["probability"] == pytest.approx(1)

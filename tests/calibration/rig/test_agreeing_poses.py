"""Small flat targets have two poses in each image; a rig takes those on which both cameras agree."""

from __future__ import annotations

import numpy as np
import pytest
from support.real_data import RealFiles

from neurocal_cli import Camera, Correspondences, Intrinsics, Pose, calibrate, fit_stereo, read_points
from neurocal_cli.calibration.rig.rig import StereoRig

CAMERA = Camera(Intrinsics(1000.0, 1000.0, 639.5, 359.5), image_size=(1280, 720))
BOARD = np.array([[20.0 * c, 20.0 * r, 0.0] for r in range(3) for c in range(4)]) - [30, 20, 0]
RIG = Pose.from_euler(0.02, -0.1, 0.01, np.array([-200.0, 3.0, 10.0]))


def rig_of(n: int, distance: float, seed: int) -> StereoRig:
    rng = np.random.default_rng([n, seed])
    sides: list[list[np.ndarray]] = [[], []]
    for _ in range(n):
        pose = Pose.from_euler(
            *rng.uniform(-0.6, 0.6, 3), rng.uniform([-0.2, -0.1, 1], [0.2, 0.1, 1]) * distance
        )
        seen = pose.to_camera(BOARD)
        for side, points in zip(sides, (seen, RIG.to_camera(seen)), strict=True):
            side.append(CAMERA.project(points)[0] + 0.2 * rng.normal(size=(len(BOARD), 2)))
    names, world = np.repeat([f"{k:02d}" for k in range(n)], len(BOARD)), np.tile(BOARD, (n, 1))
    cameras = [
        calibrate(
            Correspondences(world, np.concatenate(side), names, CAMERA.image_size),
            type=3,
            intrinsics=CAMERA,
            target="given",
        )
        for side in sides
    ]
    assert all(camera.second_poses for camera in cameras)
    return fit_stereo(*cameras)


def test_no_pair_is_left_out_for_its_second_pose() -> None:
    for seed in range(4):
        rig = rig_of(16, 2000.0, seed)
        assert not rig.left_out
        assert rig.left.second_poses == {}
        assert rig.right.second_poses == {}
        assert not any("moved" in reason for reason in rig.verdict.reasons)
        assert abs(rig.baseline - np.linalg.norm(RIG.t)) < 4 * rig.std["baseline"]


@pytest.mark.slow
def test_errors_of_the_rig_are_as_large_as_stated() -> None:
    z = [
        (rig.baseline - np.linalg.norm(RIG.t)) / rig.std["baseline"]
        for seed in range(60)
        for rig in [rig_of(16, 2000.0, seed)]
    ]
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_a_reported_rig_of_a_small_board_is_whole(real_files: RealFiles) -> None:
    left, right = (read_points(real_files(f"field_reports/smallrig2000_{side}.csv")[0]) for side in "lr")
    camera = Camera(Intrinsics(1000.0, 1000.0, 640.0, 400.0), image_size=(1280, 800))
    sides = [calibrate(side, type=3, intrinsics=camera) for side in (left, right)]
    assert all(side.second_poses for side in sides)
    assert not fit_stereo(*sides).left_out


def test_the_scale_of_a_reported_rig_of_a_wrongly_described_grid_is_unknown(real_files: RealFiles) -> None:
    """The tags' spacing is 0.30, described as 0.25; the baseline is 120.42 mm."""
    sides = [calibrate(read_points(real_files(f"field_reports/apr_{side}.csv")[0])) for side in "lr"]
    rig = fit_stereo(*sides)
    assert 3.0 < rig.std["baseline"] < 8.0
    assert abs(rig.baseline - 120.42) < 2 * rig.std["baseline"]
    assert rig.verdict is not None
    assert rig.verdict.word != "good"
    assert "no print is so far off" in rig.verdict.reasons[0]

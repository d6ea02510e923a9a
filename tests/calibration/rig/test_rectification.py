"""Rectification: rows correspond, and OpenCV says the same."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.rigs import random_rig, sides

from neurocal_cli import Pose, StereoRig
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.calibration.rig.rectification import rectified_pair, rectify
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import DegenerateGeometryError, InputError, UsageError
from neurocal_cli.files.rig_yaml import format_ros_pair
from neurocal_cli.files.yaml_text import parse_yaml

POSES = {
    "side by side": Pose.from_euler(0.02, 0.05, -0.01, np.array([-80.0, 3.0, 5.0])),
    "verging": Pose.from_euler(0.1, 0.3, 0.05, np.array([-300.0, 20.0, 60.0])),
    "the other side": Pose.from_euler(0.02, -0.1, 0.01, np.array([90.0, 5.0, -5.0])),
    "above each other": Pose.from_euler(0.2, 0.02, 0.05, np.array([5.0, -80.0, 10.0])),
}


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return calibrate_stereo(*sides(random_rig(np.random.default_rng(1), "verging", 4), 0.1), skew=False)


def bent(rig: StereoRig) -> StereoRig:
    cameras = [
        replace(c, distortion_model="plumb_bob", distortion=np.array(k))
        for c, k in ((rig.left, [-0.2, 0.05, 1e-3, -5e-4, 0]), (rig.right, [-0.15, 0.02, 0, 1e-3, 0]))
    ]
    return replace(rig, cameras=dict(zip(("left", "right"), cameras, strict=True)))


def posed(rig: StereoRig, pose: Pose) -> StereoRig:
    """The rig with its right camera elsewhere."""
    return replace(rig, poses={"left": rig.poses["left"], "right": pose})


@pytest.mark.parametrize("alpha", [None, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("name", POSES)
def test_opencv_says_the_same(name: str, alpha: float | None, rig: StereoRig) -> None:
    cv2 = pytest.importorskip("cv2")
    if alpha is not None and int(cv2.__version__.split(".")[0]) < 5:
        pytest.skip("before version 5 OpenCV lets images end a pixel further out")
    for one, tolerance in (
        (posed(rig, POSES[name]), 1e-4),
        (posed(bent(rig), POSES[name]), 3.0),
    ):
        found = rectify(one, alpha)
        assert found is not None
        # OpenCV takes the lens off the corners in five rounds, some pixels short where it bends much.
        k = [np.concatenate([c.distortion, np.zeros(5)])[:5] for c in (one.left, one.right)]
        expected = cv2.stereoRectify(
            one.left.K, k[0], one.right.K, k[1], one.left.image_size, one.R, one.t.reshape(3, 1),
            alpha=-1 if alpha is None else alpha,
        )  # fmt: skip
        ours = found.R1, found.R2, found.P1, found.P2, found.Q
        for a, b in zip(ours[:2], expected, strict=False):
            assert a == pytest.approx(b, abs=1e-12)
        for a, b in zip((found.P1[:, :3], found.P2[:, :3]), expected[2:4], strict=True):
            assert a == pytest.approx(b[:, :3], abs=tolerance)
        assert found.P2[:, 3] == pytest.approx(expected[3][:, 3], rel=1e-5 if tolerance < 1 else 0.01)
        assert pytest.approx(expected[4], abs=tolerance) == found.Q


@pytest.mark.parametrize("name", POSES)
def test_points_fall_on_one_row_and_q_brings_them_back(name: str, rig: StereoRig) -> None:
    one = posed(rig, POSES[name])
    found = rectify(one, 0.5)
    assert found is not None
    rng = np.random.default_rng(2)
    X = rng.uniform(-1, 1, (50, 3)) * [200, 150, 100] + [0, 0, 900]

    def image(R: Array, P: Array, points: Array) -> Array:
        rectified = points @ R.T
        m = np.column_stack([rectified, np.ones(50)]) @ P.T
        return np.asarray(m[:, :2] / m[:, 2:])

    left = image(found.R1, found.P1, X)
    # P2 is for points in the left rectified frame: the baseline is in it.
    right = image(found.R1, found.P2, X)
    seen = image(found.R2, np.column_stack([found.P2[:, :3], np.zeros(3)]), X @ one.R.T + one.t)
    assert right == pytest.approx(seen, abs=1e-9)
    across = 0 if name == "above each other" else 1
    assert left[:, across] == pytest.approx(right[:, across], abs=1e-9)
    disparity = (left - right)[:, 1 - across]
    back = np.column_stack([left, disparity, np.ones(50)]) @ found.Q.T
    assert back[:, :3] / back[:, 3:] == pytest.approx(X @ found.R1.T, rel=1e-9)


def test_without_one_image_size_there_is_none(rig: StereoRig) -> None:
    nothing = replace(rig.left, points=replace(rig.left.points, image_size=None))
    assert rectify(replace(rig, cameras={**rig.cameras, "left": nothing})) is None
    with pytest.raises(InputError, match="images of one known size"):
        format_ros_pair(replace(rig, cameras={**rig.cameras, "left": nothing}))
    with pytest.raises(UsageError, match="between 0 and 1"):
        rectify(rig, 2.0)


def test_ros_files_are_in_metres(rig: StereoRig) -> None:
    found = rectify(rig)
    assert found is not None
    left, right = (parse_yaml(text, "f") for text in format_ros_pair(rig))
    assert np.array(left["rectification_matrix"]["data"]) == pytest.approx(found.R1.ravel())
    assert np.array(right["rectification_matrix"]["data"]) == pytest.approx(found.R2.ravel())
    P2 = np.array(right["projection_matrix"]["data"]).reshape(3, 4)
    assert P2[0, 3] == pytest.approx(found.P2[0, 3] / 1000)
    assert -P2[0, 3] / P2[0, 0] == pytest.approx(rig.baseline / 1000)
    points = replace(rig.left.points, unit="squares")
    with pytest.raises(InputError, match="'squares'; use one of m, dm, cm, mm"):
        format_ros_pair(replace(rig, cameras={**rig.cameras, "left": replace(rig.left, points=points)}))


@pytest.mark.parametrize("degrees", [90.0, 180.0, 270.0, 175.0])
def test_the_image_of_a_camera_upside_down_or_on_its_side_is_turned_up(
    degrees: float, rig: StereoRig
) -> None:
    turn = Pose.from_euler(0.0, 0.0, np.radians(degrees), np.zeros(3)).R
    found = rectify(posed(rig, Pose.exact(turn @ rig.R, turn @ rig.t)))
    upright = rectify(rig)
    assert found is not None
    assert upright is not None
    few = np.radians(5.0) if degrees == 175 else 1e-12
    assert pytest.approx(upright.R1, abs=few) == found.R1
    assert pytest.approx(upright.R2 @ turn.T, abs=few) == found.R2
    assert found.P2[0, 3] < 0


def test_cameras_back_to_back_are_not_rectified(rig: StereoRig) -> None:
    for angles in ((0.0, np.pi, 0.0), (np.radians(165.0), 0.0, 0.0)):
        opposite = posed(rig, Pose.from_euler(angles[0], angles[1], angles[2], rig.t))
        assert rectify(opposite) is None
        with pytest.raises(DegenerateGeometryError, match="face away from each other"):
            rectified_pair(opposite)


@cache
def wide_rig(seed: int) -> StereoRig:
    points = sides(random_rig(np.random.default_rng(seed), "wide", 4), 0.1)
    return calibrate_stereo(*points, skew=False, distortion="none", target="given")


@pytest.mark.parametrize(("alpha", "least"), [(0.0, 0), (0.5, 1), (1.0, 4)])
def test_rigs_whose_axes_differ_too_much_are_refused_by_that_cause(alpha: float, least: int) -> None:
    refused = 0
    for seed in range(4):
        wide = wide_rig(seed)
        assert rectified_pair(wide).cameras[0].A[0, 0] > 0
        found = rectify(wide, alpha)
        assert found is not None
        if found.P1[0, 0] > 0:
            continue
        refused += 1
        with pytest.raises(DegenerateGeometryError, match="optical axes of the cameras differ so much"):
            rectified_pair(wide, alpha)
    assert refused >= least

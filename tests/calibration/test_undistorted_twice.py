"""Points that are undistorted already say so, and a camera with distortion for them is warned of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run, succeed
from support.made_calibration import made_calibration
from support.places import SAMPLES

from neurocal_cli import (
    Camera,
    Correspondences,
    calibrate,
    evaluate_camera,
    evaluate_stereo,
    read_calibration,
    read_points,
    read_stereo_rig,
    undistort_points,
)
from neurocal_cli.calibration.rig.evaluation import evaluate_stereo_rig
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.errors import InputError
from neurocal_cli.files.points_csv import format_points, write_points
from neurocal_cli.files.result_files import write_calibration

BEFORE = "the points are undistorted already"
LENS = Distortion("k1", np.array([-0.2]))


@pytest.fixture
def points() -> Correspondences:
    pinhole = made_calibration(3).points
    camera = camera_with(LENS)
    u, v = camera_with(Distortion()).normalised_points(*pinhole.pixels.T)
    return replace(pinhole, pixels=np.column_stack(camera.image_points(u, v)))


def camera_with(distortion: Distortion) -> Camera:
    made = made_calibration(3)
    return Camera(made.intrinsics, distortion, made.image_size)


@pytest.fixture
def straight(points: Correspondences) -> Correspondences:
    return undistort_points(points, camera_with(LENS))


@pytest.mark.parametrize("shape", ["plane", "cylinder", "equirectangular"])
def test_a_file_of_undistorted_points_says_so(points: Correspondences, shape: str, tmp_path: Path) -> None:
    straight = undistort_points(points, camera_with(LENS), to=shape)
    assert (points.undistorted, straight.undistorted) == ("", shape)
    write_points(straight, tmp_path / "straight.csv")
    assert f"# undistorted: {shape}\n" in (tmp_path / "straight.csv").read_text()
    assert read_points(tmp_path / "straight.csv").undistorted == shape


def test_a_pinhole_leaves_points_as_they_are_called(points: Correspondences) -> None:
    pinhole = camera_with(Distortion())
    assert "undistorted" not in format_points(undistort_points(points, pinhole))
    twice = undistort_points(undistort_points(points, camera_with(LENS)), pinhole)
    assert twice.undistorted == "plane"


def test_points_undistorted_on_anything_else_are_refused(points: Correspondences, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="undistorted must be one of plane, cylinder, equirectangular"):
        replace(points, undistorted="cone")
    path = tmp_path / "cone.csv"
    path.write_text("# undistorted: cone\n" + format_points(points))
    with pytest.raises(ValueError, match=r"cone.csv:1: undistorted is 'cone'; write one of plane, cyl"):
        read_points(path)


def test_undistort_warns_of_the_second_time(points: Correspondences, tmp_path: Path) -> None:
    camera, first, second = (str(tmp_path / name) for name in ("camera.yaml", "first.csv", "second.csv"))
    write_points(points, tmp_path / "points.csv")
    write_calibration(calibrate(points, distortion="k1", skew=False), camera)
    once = run("undistort", camera, tmp_path / "points.csv", "-o", first)
    assert (once.exit_code, once.stderr) == (0, "")
    twice = succeed("undistort", camera, first, "-o", second)
    assert twice.stderr.startswith(f"warning: {first}: {BEFORE}")
    assert "give the points as they were measured" in twice.stderr


def test_type_3_and_evaluation_warn_of_a_camera_with_distortion(
    points: Correspondences, straight: Correspondences
) -> None:
    for camera, given, warned in (
        (camera_with(LENS), straight, True),
        (camera_with(LENS), points, False),
        (camera_with(Distortion()), straight, False),
    ):
        for found in (calibrate(given, type=3, intrinsics=camera), evaluate_camera(camera, given)):
            assert any(BEFORE in text for text in found.warnings) == warned


def test_a_camera_of_undistorted_points_may_have_distortion(
    points: Correspondences, straight: Correspondences, tmp_path: Path
) -> None:
    write_calibration(calibrate(straight, distortion="k1", skew=False), tmp_path / "camera.yaml")
    rest = read_calibration(tmp_path / "camera.yaml")
    assert rest.points.undistorted == "plane"
    assert evaluate_camera(rest, straight).warnings == ()
    assert calibrate(straight, type=3, intrinsics=rest).warnings == ()
    measured = calibrate(points, distortion="k1", skew=False)
    assert BEFORE in evaluate_camera(measured, straight).warnings[0]


def test_two_cameras_are_warned_of_as_one_is() -> None:
    both = [read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right")]
    left, right = (calibrate(points, distortion="k1", skew=False) for points in both)
    straight = undistort_points(both[0], left), undistort_points(both[1], right)
    warnings = evaluate_stereo(left, right, straight).warnings
    assert sum(BEFORE in text for text in warnings) == 2
    assert not any(BEFORE in text for text in evaluate_stereo(left, right).warnings)


def test_files_of_which_only_some_are_undistorted_are_noted(
    points: Correspondences, straight: Correspondences, tmp_path: Path
) -> None:
    labels = np.char.add("new", np.asarray(points.view_names)[points.view_index])
    write_points(replace(points, view=labels), tmp_path / "measured.csv")
    write_points(straight, tmp_path / "straight.csv")
    notes: list[str] = []
    both = read_points([tmp_path / "straight.csv", tmp_path / "measured.csv"], notes=notes)
    assert both.undistorted == "plane"
    assert len(notes) == 1
    assert "measured.csv: the points of other files are undistorted" in notes[0]


def test_rectify_warns_of_points_that_are_undistorted_already(tmp_path: Path) -> None:
    stereo = [SAMPLES / f"stereo_{side}.csv" for side in ("left", "right")]
    run("stereo", *stereo, "--no-skew", "--distortion", "k1", "-o", tmp_path / "rig.yaml")
    straight = [tmp_path / path.name for path in stereo]
    for path, out in zip(stereo, straight, strict=True):
        write_points(undistort_points(read_points(path), read_stereo_rig(tmp_path / "rig.yaml").left), out)
    for points, count in ((stereo, 0), (straight, 2)):
        result = succeed("rectify", tmp_path / "rig.yaml", *points, "-o", tmp_path / f"out{count}")
        assert result.stderr.count(BEFORE) == count


def test_evaluating_a_rig_warns_once_of_each_file(tmp_path: Path) -> None:
    stereo = [SAMPLES / f"stereo_{side}.csv" for side in ("left", "right")]
    run("stereo", *stereo, "--no-skew", "--distortion", "k1", "-o", tmp_path / "rig.yaml")
    rig = read_stereo_rig(tmp_path / "rig.yaml")
    left, right = (undistort_points(read_points(path), rig.left) for path in stereo)
    found = evaluate_stereo_rig(rig, (left, right))
    assert sum(BEFORE in text for text in found.warnings) == 2


def test_triangulate_says_that_a_rig_of_undistorted_points_needs_such_pixels(tmp_path: Path) -> None:
    stereo = [SAMPLES / f"stereo_{side}.csv" for side in ("left", "right")]
    run("stereo", *stereo, "--no-skew", "--distortion", "k1", "-o", tmp_path / "rig.yaml")
    rig, straight = read_stereo_rig(tmp_path / "rig.yaml"), tmp_path / "straight.csv"
    write_points(undistort_points(read_points(stereo[0]), rig.left), straight)
    run("stereo", straight, stereo[1], "--no-skew", "-o", tmp_path / "straight.yaml")
    for name, said in (("rig", False), ("straight", True)):
        result = run("triangulate", tmp_path / f"{name}.yaml", SAMPLES / "matches.csv")
        assert ("left camera was calibrated from undistorted points" in result.stderr) == said
        assert "right camera was calibrated from undistorted points" not in result.stderr

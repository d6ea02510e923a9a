"""Coefficients of the direct linear transformation project as the cameras do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.command_line import refused, run, succeed

from neurocal_cli import Intrinsics, Pose, calibrate, calibrate_rig, read_points
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.exchange.capture import dlt_coefficients
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.result_files import write_result

SAMPLES = Path(__file__).parents[2] / "sample_data"
WORLD = np.random.default_rng(0).uniform(-50, 150, (20, 3))


def written(source: Path, *words: str) -> Array:
    succeed("convert", str(source), "--to", "dlt", *words, "-o", str(source.with_suffix(".csv")))
    return np.loadtxt(source.with_suffix(".csv"), delimiter=",", ndmin=2)


def seen(column: Array) -> Array:
    """Pixels of the world's points by the coefficients of one camera."""
    upper = np.column_stack([WORLD, np.ones(len(WORLD))]) @ column[:8].reshape(2, 4).T
    return np.asarray(upper / (1 + WORLD @ column[8:])[:, None])


def test_each_view_of_a_camera_is_a_column(tmp_path: Path) -> None:
    camera = calibrate(read_points(SAMPLES / "flat.csv"), distortion="none", target="given")
    write_result(camera, tmp_path / "camera.yaml")
    L = written(tmp_path / "camera.yaml")
    assert L.shape == (11, len(camera.views))
    for column, view in zip(L.T, camera.views.values(), strict=True):
        there = WORLD @ view.pose.R.T + view.pose.t
        np.testing.assert_allclose(seen(column), camera.camera.project(there)[0], rtol=1e-9)


def test_each_camera_of_a_rig_is_a_column(tmp_path: Path) -> None:
    points = {f"cam{k}": read_points(SAMPLES / f"rig_cam{k}.csv") for k in range(3)}
    rig = calibrate_rig(points, skew=False, distortion="none")
    write_result(rig, tmp_path / "rig.yaml")
    L = written(tmp_path / "rig.yaml")
    first = next(iter(rig.cameras["cam0"].views.values())).pose
    for column, (name, pose) in zip(L.T, rig.poses.items(), strict=True):
        there = (WORLD @ first.R.T + first.t) @ pose.R.T + pose.t
        np.testing.assert_allclose(seen(column), rig.cameras[name].camera.project(there)[0], rtol=1e-9)


def test_what_has_no_coefficients_is_refused(tmp_path: Path) -> None:
    camera = tmp_path / "camera.yaml"
    write_result(calibrate(read_points(SAMPLES / "fisheye.csv"), distortion="fisheye"), camera)
    result = run("convert", str(camera), "--to", "dlt")
    refused(result, "DLT has no distortion model fisheye")
    assert run("convert", str(SAMPLES / "flat.csv"), "--to", "dlt").exit_code == 1
    with pytest.raises(InputError, match="hold a pose"):
        dlt_coefficients(CameraSet((Camera(Intrinsics(800.0, 800.0, 320.0, 240.0)),)))


@pytest.mark.parametrize("depth", [0.0, 1e-12])
def test_an_origin_beside_the_camera_has_no_coefficients(depth: float) -> None:
    pose = Pose(np.eye(3), np.array([100.0, 0.0, depth]))
    with pytest.raises(InputError, match="plane of the camera"):
        dlt_coefficients(CameraSet((Camera(Intrinsics(800.0, 800.0, 320.0, 240.0)),), poses={"a": pose}))

"""``neurocal resize``: cameras and rigs of resized, binned and cropped images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.command_line import refused, run, succeed
from support.made_calibration import made_calibration
from support.places import SAMPLES
from support.rigs import random_rig

from neurocal_cli import read_calibration, read_points, write_calibration, write_points, write_rig
from neurocal_cli.files.exchange.format_table import CameraSet
from neurocal_cli.files.exchange.neurocal import as_stereo
from neurocal_cli.files.rig_yaml import read_stereo_rig

POINTS = np.random.default_rng(2).uniform([-1, -0.8, 3], [1, 0.8, 6], (50, 3))


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    write_calibration(made_calibration(3), tmp_path / "camera.yaml")
    return tmp_path / "camera.yaml"


@pytest.mark.parametrize(
    ("words", "scale", "corner", "size"),
    [
        (["--to", 320, 120], (0.5, 0.25), (0, 0), (320, 120)),
        (["--scale", 2], (2.0, 2.0), (0, 0), (1280, 960)),
        (["--binning", 3], (1 / 3, 1 / 3), (0, 0), (213, 160)),
        (["--crop", 40, 30, 500, 400], (1.0, 1.0), (40, 30), (500, 400)),
    ],
)
def test_pixels_move_as_the_image_does(
    words: list[object],
    scale: tuple[float, float],
    corner: tuple[int, int],
    size: tuple[int, int],
    camera: Path,
) -> None:
    out = camera.with_name("new.yaml")
    succeed("resize", camera, *words, "-o", out)
    old, new = read_calibration(camera), read_calibration(out)
    assert new.image_size == size
    # The edges of a scaled image, -1/2 and w - 1/2, stay edges.
    expected = (old.camera.project(POINTS)[0] + 0.5) * scale - 0.5 - np.array(corner)
    assert np.abs(new.camera.project(POINTS)[0] - expected).max() < 1e-9
    factors = {"alpha_u": scale[0], "u0": scale[0], "alpha_v": scale[1], "v0": scale[1]}
    for name, std in old.std.items():
        assert new.std[name] == pytest.approx(factors.get(name, 1.0) * std, rel=1e-12)
    for k, name in enumerate(new.covariance_names):
        assert new.covariance[k, k] == pytest.approx(new.std[name] ** 2, rel=1e-9)
    assert list(new.views) == list(old.views)
    for name, view in new.views.items():
        assert np.array_equal(view.pose.D, old.views[name].pose.D)


def test_the_resized_camera_is_that_of_resized_points(tmp_path: Path) -> None:
    """Calibrated from points of images of half the size: the same camera with the same std."""
    from dataclasses import replace

    given = read_points(SAMPLES / "flat.csv")
    half = replace(given, pixels=(given.pixels + 0.5) / 2 - 0.5, image_size=(320, 240))
    write_points(half, tmp_path / "half.csv")
    for name, points in (("whole", SAMPLES / "flat.csv"), ("half", tmp_path / "half.csv")):
        words = ["--distortion", "k1", "--target", "given", "-o", tmp_path / f"{name}.yaml"]
        succeed("calibrate", points, *words)
    succeed("resize", tmp_path / "whole.yaml", "--to", 320, 240, "-o", tmp_path / "r.yaml")
    resized, expected = read_calibration(tmp_path / "r.yaml"), read_calibration(tmp_path / "half.yaml")
    assert np.abs(resized.K - expected.K).max() < 1e-3
    for name, std in expected.std.items():
        assert resized.std[name] == pytest.approx(std, rel=0.02)
    assert resized.rmse_px == pytest.approx(expected.rmse_px, rel=0.02)


@pytest.mark.parametrize("ending", ["yaml", "json"])
def test_a_rig_is_resized(ending: str, tmp_path: Path) -> None:
    scene = random_rig(np.random.default_rng(6), "verging", 2, "k1k2")
    cameras = CameraSet((scene.camera(0), scene.camera(1)), (scene.rig,), unit="mm")
    write_rig(as_stereo(cameras), tmp_path / f"rig.{ending}")
    out = tmp_path / f"half.{ending}"
    succeed("resize", tmp_path / f"rig.{ending}", "--scale", 0.5, "-o", out)
    old, new = read_stereo_rig(tmp_path / f"rig.{ending}"), read_stereo_rig(out)
    assert np.array_equal(new.pose.D, old.pose.D)
    for one, other in ((old.left, new.left), (old.right, new.right)):
        pixels = (one.camera.project(POINTS)[0] + 0.5) / 2 - 0.5
        assert np.nanmax(np.abs(other.camera.project(POINTS)[0] - pixels)) < 1e-9
    (tmp_path / "matches.csv").write_text("uL,vL,uR,vR\n150,100,155,102\n")
    succeed("triangulate", out, tmp_path / "matches.csv")


def test_a_rig_of_three_cameras_is_resized(tmp_path: Path) -> None:
    lines = [
        f"cam{k}: {{camera_model: pinhole, distortion_model: radtan, distortion_coeffs: [0.1, 0, 0, 0], "
        f"intrinsics: [400, 400, 320, 240], resolution: [640, 480]{t}}}"
        for k, t in enumerate(["", *[", T_cn_cnm1: [[1,0,0,-0.1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"] * 2])
    ]
    (tmp_path / "chain.yaml").write_text("\n".join(lines))
    succeed("resize", tmp_path / "chain.yaml", "--binning", 2, "-o", tmp_path / "new.yaml")
    again = run("resize", tmp_path / "new.yaml", "--scale", 2, "--json", "-o", tmp_path / "old.yaml")
    found = json.loads(again.stdout)["cameras"]
    assert [(one["image_size"], one["alpha_u"], one["u0"]) for one in found] == [([640, 480], 400, 320)] * 3


def test_a_camera_of_another_program_is_resized(tmp_path: Path) -> None:
    tree = {
        "K": [[600, 0, 320], [0, 600, 240], [0, 0, 1]],
        "D": [0.1, 0, 0, 0, 0.1],
        "image_size": [640, 480],
    }
    (tmp_path / "camera.json").write_text(json.dumps(tree))
    result = succeed("resize", tmp_path / "camera.json", "--to", 1280, 960)
    assert "camera_matrix: {rows: 3, cols: 3, data: [1200.0, 0.0, 640.5, 0.0, 1200.0, 480.5" in result.stdout


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ([], 2, "give one of --to W H, --scale S, --crop U V W H and --binning N"),
        (["--scale", 0.5, "--binning", 2], 2, "give one of --to W H"),
        (["--crop", 600, 0, 100, 100], 1, "--crop 600 0 100 100 reaches out of the image of 640 x 480 px"),
        (["--scale", 1e-4], 1, "nothing is left of an image of 640 x 480 px"),
    ],
)
def test_a_wrong_request_is_refused(words: list[object], code: int, message: str, camera: Path) -> None:
    result = run("resize", camera, *words)
    assert (result.exit_code, result.stdout) == (code, "")
    assert message in result.stderr


def test_a_size_that_is_not_known_is_needed_for_another(tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text('{"K": [[600, 0, 320], [0, 600, 240], [0, 0, 1]]}')
    result = run("resize", tmp_path / "camera.json", "--to", 320, 240)
    refused(result, "the size of the images is not known; give --scale instead of --to")
    succeed("resize", tmp_path / "camera.json", "--scale", 0.5)


def test_a_stretched_image_is_told(camera: Path) -> None:
    result = run("resize", camera, "--to", 640, 360, "-o", camera.with_name("new.yaml"))
    assert "if their middle was cut out and scaled, give first --crop 0 60 640 360" in result.stderr


def test_images_of_another_size_name_the_line_to_type(camera: Path, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("# image_size: 320 240\nX,Y,Z,u,v\n0,0,0,1,2\n")
    result = run("undistort", camera, tmp_path / "points.csv", "-o", tmp_path / "new.csv")
    assert "neurocal resize CAMERA.yaml --to 320 240 -o RESIZED.yaml" in result.stderr

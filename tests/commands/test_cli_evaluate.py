"""``neurocal evaluate camera``: its table, its JSON, held-out points."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from support.command_line import refused, run
from support.made_calibration import made_calibration, made_points, pose_of

from neurocal_cli import Correspondences, evaluate_camera, read_calibration, write_calibration, write_points


def evaluate(*words: object, stdin: bytes | None = None) -> Result:
    return run("evaluate", "camera", *words, stdin=stdin)


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.yaml"
    write_calibration(made_calibration(2), path)
    return path


def test_json_holds_what_the_library_gives(camera: Path) -> None:
    result = evaluate(camera, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    values = json.loads(result.stdout)
    expected = evaluate_camera(read_calibration(camera))
    assert values["n_points"] == 380
    assert (values["rmse_px"], values["max_px"]) == (expected.rmse_px, expected.max_px)
    assert values["views"] == {name: view.rmse_px for name, view in expected.views.items()}
    assert (values["n_behind"], values["fitted_views"]) == (0, [])


def test_the_table_is_plain_text_when_piped(camera: Path) -> None:
    result = evaluate(camera)
    assert result.exit_code == 0
    assert result.stdout.isascii()
    assert "\x1b" not in result.stdout
    assert [line.split()[0] for line in result.stdout.splitlines() if line.startswith("view")] == [
        "view",
        "view00",
        "view01",
    ]


def test_the_calibration_is_read_from_stdin(camera: Path) -> None:
    assert evaluate("-", stdin=camera.read_bytes()).stdout == evaluate(camera).stdout


def test_other_points_of_known_views_use_the_calibrated_poses(camera: Path, tmp_path: Path) -> None:
    write_points(made_points(2, noise=1.0), tmp_path / "p.csv")
    values = json.loads(evaluate(camera, tmp_path / "p.csv", "--json").stdout)
    assert values["rmse_px"] == pytest.approx(np.sqrt(2), rel=0.1)
    assert values["fitted_views"] == []


def test_new_views_are_fitted_marked_and_told(camera: Path, tmp_path: Path) -> None:
    write_points(made_points(2, first=1), tmp_path / "p.csv")
    result = evaluate(camera, tmp_path / "p.csv")
    assert result.exit_code == 0, result.stderr
    pose = {
        line.split()[0]: line.split()[-1] for line in result.stdout.splitlines() if line.startswith("view0")
    }
    assert pose == {"view01": "calibrated", "view02": "fitted"}
    assert "note: view02: not in the calibration" in result.stderr
    assert json.loads(evaluate(camera, tmp_path / "p.csv", "--json").stdout)["fitted_views"] == ["view02"]


def test_points_behind_the_camera_are_warned_of_and_null_in_json(camera: Path, tmp_path: Path) -> None:
    behind = -pose_of(0).R.T @ pose_of(0).t - 50 * pose_of(0).R[2]
    write_points(Correspondences(behind[None], np.zeros((1, 2)), ["view00"]), tmp_path / "p.csv")
    result = evaluate(camera, tmp_path / "p.csv", "--json")
    assert result.exit_code == 0
    assert "warning: 1 of 1 points lie behind the camera" in result.stderr
    assert json.loads(result.stdout)["rmse_px"] is None
    assert "NaN" not in result.stdout


@pytest.mark.parametrize("content", ["", "a: [", "3", "image_width: 640\n"])
def test_a_file_that_is_no_calibration_is_said_in_one_line(content: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(content)
    result = evaluate(path)
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith(f"Error: {path}")
    assert len(result.stderr.splitlines()) == 1


def test_a_file_without_points_says_what_to_do(camera: Path) -> None:
    text = camera.read_text()
    camera.write_text(text[: text.index("  observations:")])
    result = evaluate(camera)
    refused(result, "observations")
    assert "; " in result.stderr


def test_images_of_another_size_are_refused(camera: Path, tmp_path: Path) -> None:
    write_points(replace(made_points(), image_size=(320, 240)), tmp_path / "p.csv")
    result = evaluate(camera, tmp_path / "p.csv")
    refused(result, "320 x 240")


def test_stdin_is_not_read_twice() -> None:
    result = evaluate("-", "-")
    assert result.exit_code == 2
    assert "only once" in result.stderr


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo terminal")
def test_a_camera_file_of_ros_is_judged_by_points_with_fitted_poses(tmp_path: Path) -> None:
    ros = tmp_path / "ros.yaml"
    ros.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: c\ncamera_matrix: {rows: 3, cols: 3, "
        "data: [600, 0, 320, 0, 610, 240, 0, 0, 1]}\ndistortion_model: plumb_bob\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    write_points(made_points(2), tmp_path / "p.csv")
    result = evaluate(ros, tmp_path / "p.csv", "--json")
    assert result.exit_code == 0, result.stderr
    values = json.loads(result.stdout)
    assert values["fitted_views"] == ["view00", "view01"]
    assert values["rmse_px"] < 0.5
    assert "note: only the intrinsic parameters and the distortion are used" in result.stderr
    assert evaluate(ros).exit_code == 1


def test_a_file_that_is_no_camera_is_refused_with_points_too(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("a: 1\n")
    write_points(made_points(1), tmp_path / "p.csv")
    result = evaluate(tmp_path / "c.yaml", tmp_path / "p.csv")
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1

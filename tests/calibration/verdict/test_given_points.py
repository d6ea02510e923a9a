"""A camera that is judged by points of the user's: their poses, and the verdict."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.scenes import random_flat_set
from support.slow_cases import slow_but
from support.wrong_inputs import CAMERA, board, flat, poses, seen

from neurocal_cli import Calibration, Correspondences, calibrate, evaluate_camera, write_calibration
from neurocal_cli.calibration.drift import drift_since
from neurocal_cli.calibration.evaluation import judged_by_points
from neurocal_cli.files.points_csv import write_points


@cache
def found() -> Calibration:
    return calibrate(flat(1), distortion="none", skew=False)


def other_images(focal: float = 600.0, seed: int = 9) -> Correspondences:
    """New images of the board, with the names of those that the camera was calibrated from."""
    A = CAMERA.A @ np.diag([focal / 600.0, focal / 600.0, 1.0])
    return seen(board(), poses(10, seed), A, seed)


def word(points: Correspondences) -> str:
    assert found().verdict is not None
    return judged_by_points(found().verdict, found(), evaluate_camera(found(), points)).word


def test_other_images_of_known_names_get_poses_of_their_own() -> None:
    evaluation = evaluate_camera(found(), other_images())
    assert evaluation.renamed == found().points.view_names
    assert evaluation.rmse_px < 1.1 * found().rmse_px
    assert word(other_images()) == "good"


def test_points_of_the_same_images_keep_their_poses_though_a_third_is_wrong() -> None:
    points = found().points
    pixels = points.pixels + np.where(np.arange(len(points)) % 3 == 0, 50.0, 0.0)[:, None]
    assert evaluate_camera(found(), replace(points, pixels=pixels)).fitted_views == ()
    assert evaluate_camera(found(), points.select(points.world[:, 0] > 60)).fitted_views == ()


def test_files_without_a_view_column_do_not_share_a_pose() -> None:
    def third(points: Correspondences) -> Correspondences:
        rows = slice(3 * 93, 4 * 93)
        return Correspondences(points.world[rows], points.pixels[rows], image_size=points.image_size)

    camera = calibrate(third(flat(1)), type=2, skew=False, image_center=(318.0, 243.0), distortion="none")
    evaluation = evaluate_camera(camera, third(other_images()))
    assert evaluation.renamed == ("view",)
    assert evaluation.rmse_px < 1.0


def test_an_error_of_100_px_is_never_good() -> None:
    wrong = replace(found().points, pixels=found().points.pixels + np.array([100.0, 0.0]))
    # Two points of each view cannot have a pose of their own: the calibrated one stays.
    two = wrong.select(np.arange(len(wrong)) % 93 < 2)
    assert evaluate_camera(found(), two).rmse_px == pytest.approx(100, abs=1)
    assert word(two) == "poor"


@pytest.mark.parametrize("focal", slow_but((582.0,), (582.0, 618.0)))
def test_points_of_another_zoom_are_not_good(focal: float) -> None:
    new = other_images(focal)
    assert word(new.select(new.view_index < 4)) != "good"


def test_points_of_the_same_camera_may_be_less_accurate() -> None:
    points = other_images()
    noise = np.random.default_rng(4).normal(0, 0.6, points.pixels.shape)
    evaluation = evaluate_camera(found(), replace(points, pixels=points.pixels + noise))
    assert found().verdict is not None
    assert evaluation.fit is not None
    drift = drift_since(found(), evaluation.fit.points)
    assert drift is not None
    assert not drift.different
    assert judged_by_points(found().verdict, found(), evaluation, drift).word == "good"


def test_points_behind_the_camera_are_poor() -> None:
    points = found().points.select(np.arange(3))
    pose = found().views["view00"].pose
    behind = replace(points, world=points.world - 1e4 * pose.R[2])
    assert word(behind) == "poor"


@pytest.mark.parametrize(
    "trials", [pytest.param(range(8), id="8"), pytest.param(range(200), id="200", marks=pytest.mark.slow)]
)
def test_new_views_of_good_cameras_are_good(trials: range) -> None:
    """3 to 12 views to calibrate from, 1 to 8 new ones, 0.05 to 1 px of noise: no word changes."""
    changed = 0
    for trial in trials:
        rng = np.random.default_rng([trial, 11])
        n, new, noise = int(rng.integers(3, 13)), int(rng.integers(1, 9)), 10 ** rng.uniform(-1.3, 0)
        scene = random_flat_set(rng, n + new, False, cols=int(rng.integers(5, 10)), rows=6)
        points = scene.points(noise, rng)
        camera = calibrate(points.select(points.view_index < n), distortion="none", skew=False)
        evaluation = evaluate_camera(camera, points.select(points.view_index >= n))
        assert camera.verdict is not None
        changed += judged_by_points(camera.verdict, camera, evaluation) != camera.verdict
    assert changed <= len(trials) // 100


def test_the_command_says_that_a_name_has_other_points_and_judges_them(tmp_path: Path) -> None:
    write_calibration(found(), tmp_path / "camera.yaml")
    new = other_images(720.0)
    write_points(new.select(new.view_index < 4), tmp_path / "new.csv")
    result = run("evaluate", "camera", tmp_path / "camera.yaml", tmp_path / "new.csv", "--json")
    assert "other points than the calibration has under this name" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    verdict = json.loads(result.stdout)["verdict"]
    assert verdict["word"] == "poor"
    assert any("on the given points" in reason for reason in verdict["reasons"])

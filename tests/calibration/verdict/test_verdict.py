"""The evidence that a verdict rests on, and the verdict on real data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run
from support.distorted import bent_set
from support.places import SAMPLES
from support.real_data import RealFiles
from support.scenes import Scene, pinhole, random_flat_set, table_1
from support.slow_cases import slow_but
from support.targets import board, views_of
from support.wrong_inputs import flat

from neurocal_cli import Calibration, Correspondences, Pose, calibrate, read_points
from neurocal_cli.calibration.verdict.evidence import Evidence
from neurocal_cli.calibration.verdict.rules import assess, reach_verdict
from neurocal_cli.files.calibration_yaml import format_calibration, read_calibration
from neurocal_cli.files.result_files import write_calibration

BENT = SAMPLES / "bent.csv"


def moved_pixels(true: Calibration, other: Calibration, pixels: np.ndarray, depth: float) -> np.ndarray:
    """Where another calibration sees what the first one sees at these pixels and a depth."""
    points = true.camera.unproject(pixels)
    points *= depth / points[:, 2:]
    back = []
    for name, view in true.views.items():
        world = (points - view.pose.t) @ view.pose.R
        pose = other.views[name].pose
        back.append(world @ pose.R.T + pose.t)
    seen, _ = other.camera.project(np.mean(back, axis=0))
    return seen - pixels


@pytest.mark.slow
@pytest.mark.parametrize(("lens", "trials"), [("none", 200), ("k1k2", 200)])
def test_the_projection_uncertainty_is_that_of_many_calibrations(lens: str, trials: int) -> None:
    scene, _ = bent_set(lens, 12)
    truth = calibrate(scene.points(), distortion=lens, skew=False, outliers="keep")
    told = Evidence(calibrate(noisy(scene, 0), distortion=lens, skew=False, outliers="keep")).projection
    assert told is not None
    squared = np.zeros((len(told.depths), len(told.pixels)))
    for trial in range(trials):
        other = calibrate(noisy(scene, trial), distortion=lens, skew=False, outliers="keep")
        for k, depth in enumerate(told.depths):
            squared[k] += (moved_pixels(truth, other, told.pixels, depth) ** 2).sum(axis=1)
    std = np.sqrt(squared / trials)
    # One noise realisation sets the level of what is told: about 3 %; 200 trials tell 5 %.
    assert told.std.mean(axis=1) == pytest.approx(std.mean(axis=1), rel=1.4 / np.sqrt(trials))
    assert told.std == pytest.approx(std, rel=3.5 / np.sqrt(trials))


def noisy(scene: Scene, trial: int):
    return scene.points(0.2, np.random.default_rng([trial, 5]))


@pytest.mark.slow
def test_halves_of_good_data_agree_as_their_deviations_say() -> None:
    scene = random_flat_set(np.random.default_rng(4), 8, False)
    values = [Evidence(pinhole(noisy(scene, trial), skew=False)).disagreement for trial in range(40)]
    assert np.mean(values) == pytest.approx(1.0, abs=0.4)


@pytest.mark.slow
def test_the_error_on_data_left_out_is_that_on_new_data() -> None:
    """On views of the same camera that it does not know, poses fitted."""
    from neurocal_cli.calibration.evaluation import evaluate_camera

    told, found = [], []
    for seed in range(30):
        scene = random_flat_set(np.random.default_rng([seed, 1]), 12, False, cols=8, rows=6)
        points = noisy(scene, seed)
        camera = pinhole(points.select(points.view_index < 6), skew=False)
        told.append(Evidence(camera).held_out_px)
        found.append(evaluate_camera(camera, points.select(points.view_index >= 6)).rmse_px)
    assert np.mean(told) == pytest.approx(np.mean(found), rel=0.03)


def test_a_file_is_judged_as_the_result_was(tmp_path: Path) -> None:
    found = calibrate(flat(3))
    write_calibration(found, tmp_path / "camera.yaml")
    back = read_calibration(tmp_path / "camera.yaml")
    assert back.verdict == found.verdict
    assert assess(back).word == found.verdict.word == "good"
    for name, value in assess(back).measures.items():
        assert value == pytest.approx(found.verdict.measures[name], rel=1e-6, nan_ok=True)
    assert format_calibration(back) == format_calibration(found)


@pytest.mark.parametrize("type", slow_but((1, 4), [1, 2, 3, 4]))
def test_every_problem_type_is_judged(type: int) -> None:
    scene = table_1()
    found = calibrate(scene.points(0.1, np.random.default_rng(1)), **scene.given(type))
    assert assess(found).word == "good", assess(found).reasons


def test_few_views_on_one_side_of_the_image_are_told_where_to_add_some() -> None:
    points = flat(5)
    corner = (points.pixels > [330, 200]).all(axis=1)
    verdict = assess(calibrate(points.select(corner), skew=False))
    assert verdict.word != "good"
    assert any("left" in advice for advice in verdict.advice)


def test_a_calibration_without_an_image_size_is_judged_without_the_image() -> None:
    found = calibrate(replace(flat(6), image_size=None))
    evidence = Evidence(found)
    assert evidence.projection is None
    assert np.isnan(evidence.coverage.image)
    assert assess(found).word == "good"


def test_zhangs_views_are_good_with_their_lens_and_not_without(zhang: Correspondences) -> None:
    assert assess(calibrate(zhang)).word == "good"
    assert assess(calibrate(zhang, distortion="none")).word == "usable"


def test_poses_with_points_behind_the_camera_are_poor() -> None:
    found = calibrate(flat(10))
    name, view = next(iter(found.views.items()))
    for depth in (0.0, -500.0):
        # The first point lies in the camera's plane, or behind it.
        first = found.points.world[found.points.view_index == 0][0]
        t = view.pose.t + np.array([0.0, 0.0, depth - view.pose.R[2] @ first - view.pose.t[2]])
        edited = replace(found, views={**found.views, name: replace(view, pose=Pose(view.pose.R, t))})
        verdict = assess(edited)
        assert verdict is not None
        assert verdict.word == "poor"
        assert "behind the camera" in verdict.reasons[0]


def test_a_board_that_flexes_does_not_excuse_two_cameras() -> None:
    """An error above the noise floor as of a board held by hand; halves of the views agree or do not."""
    cal = calibrate(read_points(str(BENT)), skew=False)
    assert cal.target is not None
    measured = Evidence(cal)
    told = {"_precision": (cal.rmse_px / 1.5, 1.5), "disagreement": 4.0, "correlation": 0.0}
    vars(measured).update(told)
    assert reach_verdict(measured).reasons == cal.verdict.reasons
    vars(measured).update(disagreement=18.0)
    (first, *_) = reach_verdict(measured).reasons
    assert first.startswith("the results of two halves of the data differ by 4.2 times as much")


@pytest.mark.slow
def test_two_real_cameras_are_not_good(tmp_path: Path, real_files: RealFiles) -> None:
    images = [*real_files("opencv_stereo/left*.jpg"), *real_files("opencv_stereo/right*.jpg")]
    words = ["--cols", 9, "--rows", 6, "--square", 25, "-o", tmp_path / "points.csv"]
    assert run("detect", *images, *words).exit_code == 0
    points = read_points(tmp_path / "points.csv")
    right = np.char.startswith(points.view_names, "right")[points.view_index]
    for distortion in ("k1k2", "auto"):
        assert calibrate(points, distortion=distortion).verdict.word != "good"
        assert calibrate(points.select(right), distortion=distortion).verdict.word != "poor"


def test_a_leaning_board_is_not_good() -> None:
    """It stands upright in all views, so that it can hardly be told from leaning image axes."""
    K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])
    lean = board()[:, [1, 0, 2]] * [0.01, 0, 0]
    for seed in range(2):
        rng = np.random.default_rng(seed)
        points, *_ = views_of(K, np.zeros(0), "none", lambda: lean, 10, 0.2, rng, roll=0.15)
        verdict = calibrate(points).verdict
        assert verdict is not None
        assert verdict.word == "usable"
        assert any("off a right angle" in reason for reason in verdict.reasons)

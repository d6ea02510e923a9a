"""Results as text."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.made_calibration import made_calibration, pose_of
from support.wrong_inputs import corner

from neurocal_cli import Camera, Correspondences, Intrinsics, Pose, calibrate, evaluate_camera
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.commands.show.camera_report import calibration_report, evaluation_report
from neurocal_cli.commands.show.text import Report, align, rounded
from neurocal_cli.commands.streams import for_json


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (556.01234, 0.4321, ("556.01", "0.43")),
        (556.01234, 4.321, ("556.0", "4.3")),
        (556.01234, 43.21, ("556", "43")),
        (5560.1234, 432.1, ("5560", "430")),
        (1.5, 0.0996, ("1.50", "0.10")),
        (-0.00012345, 0.0000021, ("-0.0001234", "0.0000021")),
        (556.0, 1e-14, ("556.000000000", "1.0e-14")),
        (556.0123, 0.0, ("556.0123", "0")),
        (556.0123, float("nan"), ("556.0123", "unknown")),
        (1e30, 1e28, (f"{1e30:.0f}", f"{1e28:.0f}")),
    ],
)
def test_a_value_is_rounded_by_its_deviation(value: float, std: float, text: tuple[str, str]) -> None:
    assert rounded(value, std) == text


def test_columns_line_up() -> None:
    assert align([["name", "x"], ["a", "10"]]) == ["name   x", "a     10"]


def test_a_calibration_shows_each_parameter_with_deviation_and_relative_deviation() -> None:
    lines = calibration_report(made_calibration()).splitlines()
    assert lines[0] == "camera: type 1 (nothing given), 190 points in 1 view, 640 x 480 px"
    row = {line.split()[0]: line.split() for line in lines if "[" in line}
    assert row["alpha_u"] == ["alpha_u", "[px]", "600.00", "0.43", "0.072", "%"]
    assert row["theta"] == ["theta", "[rad]", "1.57100", "0.00010", "0.0064", "%"]
    assert row["t_z"] == ["t_z", "[mm]", "900.00", "0.50", "0.056", "%"]


def test_a_deviation_beyond_the_value_is_a_plain_percentage() -> None:
    calibration = made_calibration()
    text = calibration_report(replace(calibration, std={**calibration.std, "u0": 605.0}))
    value = calibration.camera.intrinsics.u0
    (row,) = (line.split() for line in text.splitlines() if line.startswith("u0"))
    assert row[-2:] == [f"{100 * 605.0 / value:.0f}", "%"]


def test_given_parameters_are_marked_fixed() -> None:
    calibration = made_calibration()
    given = replace(
        calibration, type=2, fixed=frozenset({"u0", "v0"}), std={**calibration.std, "u0": 0.0, "v0": 0.0}
    )
    text = calibration_report(given)
    assert "type 2 (image centre given)" in text
    assert [line.split()[0] for line in text.splitlines() if line.endswith("fixed")] == ["u0", "v0"]


def test_a_given_pose_is_marked_fixed() -> None:
    calibration = made_calibration()
    view = replace(calibration.views["view00"], fixed=True)
    text = calibration_report(replace(calibration, type=4, views={"view00": view}))
    assert sum(line.endswith("fixed") for line in text.splitlines()) == 6


def test_only_the_worst_of_many_views_are_listed() -> None:
    calibration = made_calibration(25)
    lines = calibration_report(calibration).splitlines()
    shown = [line.split()[0] for line in lines if line.startswith("view") and line.split()[0] != "view"]
    by_error = sorted(calibration.views, key=lambda name: -calibration.views[name].rmse_px)
    assert shown == by_error[:20]
    assert "the 20 views with the largest error, of 25 views" in lines


def test_the_report_tells_how_the_training_went() -> None:
    text = calibration_report(made_calibration())
    assert "2 of 3 random starts agreed, 33 iterations, loss 0.4300 px" in text
    assert "0.4400 px before, 0.4200 px after 4 iterations" in text
    assert text.endswith("converged: the reprojection error is at a minimum")


def test_a_calibration_without_a_network_is_reported() -> None:
    assert "network" not in calibration_report(replace(made_calibration(), network=None))


def test_an_evaluation_lists_axes_and_views() -> None:
    evaluation = evaluate_camera(made_calibration(2))
    overall, views = map(align, evaluation_report(evaluation, None, Report()).tables)
    assert any(line.startswith(f"both  {evaluation.rmse_px:.4f}") for line in overall)
    assert [line.split()[-1] for line in views[1:]] == ["calibrated"] * 2


def test_json_has_the_promised_keys_and_all_digits() -> None:
    evaluation = evaluate_camera(made_calibration(2))
    values = json.loads(json.dumps(evaluation_report(evaluation, None, Report()).tree, allow_nan=False))
    assert values["rmse_px"] == evaluation.rmse_px
    assert values["views"] == {name: view.rmse_px for name, view in evaluation.views.items()}
    names = {"n_points", "rmse_px", "max_px", "views", "n_behind", "fitted_views"}
    assert set(values) == names | {"rms_u", "rms_v", "bias_u", "bias_v"}


def test_json_has_null_for_an_error_that_does_not_exist() -> None:
    behind = -pose_of(0).R.T @ pose_of(0).t - 50 * pose_of(0).R[2]
    points = Correspondences(behind[None], np.zeros((1, 2)), ["view00"])
    evaluation = evaluate_camera(made_calibration(), points)
    report = evaluation_report(evaluation, None, Report())
    values = for_json(report.tree)
    assert values["rmse_px"] is None
    assert values["views"] == {"view00": None}
    json.dumps(values, allow_nan=False)
    assert "-" in report.tables[1][1]


def test_names_cannot_break_the_table() -> None:
    calibration = replace(made_calibration(), camera_name="a\nb\x1b[31m")
    assert calibration_report(calibration).splitlines()[0].startswith("a\\nb\\x1b[31m: type 1")


def test_starts_of_several_views_are_told_apart() -> None:
    text = calibration_report(made_calibration(2))
    assert "networks: 3 random starts for 2 views, at least 2 agreed in each view, 33 iterations" in text


@pytest.mark.parametrize(
    ("model", "errors", "told"),
    [
        ("k1", {"none": 1.0, "k1": 0.2, "fisheye": 0.3}, "coefficients:"),
        ("k1", {"none": 1.0, "k1": 0.2, "k1k2": 0.199}, "coefficients:"),
        ("fisheye", {"none": 1.0, "k1": 0.2, "fisheye": 0.199}, "coefficients:"),
        (
            "k1",
            {"none": 1.0, "k1": 0.2, "fisheye": 0.199},
            "coefficients among ordinary lenses, because the points do not decidedly favour a fisheye:",
        ),
        ("none", {"none": 0.6, "k1": 0.4}, "coefficients among the models that the points support:"),
    ],
)
def test_the_summary_says_among_which_models_the_lens_was_chosen(
    model: str, errors: dict[str, float], told: str
) -> None:
    calibration = replace(made_calibration(3), lens_choice=errors, distortion_model=model)
    calibration = replace(calibration, distortion=np.zeros(len(coefficient_names(model))), judgement=None)
    std = dict(calibration.std) | dict.fromkeys(coefficient_names(model), 1.0)
    line = f"distortion model: {model}, chosen by error and number of {told}"
    assert line in calibration_report(replace(calibration, std=std)).splitlines()


def test_a_fisheye_that_predicts_better_but_not_decidedly_is_told_of() -> None:
    """One wide view with the centre given: the fisheye was excluded before errors were compared."""
    lens = Distortion("fisheye", np.array([0.02, -0.01, 0.004, -0.001]))
    camera = Camera(Intrinsics(150.0, 150.0, 318.0, 243.0), lens, (640, 480))
    rng = np.random.default_rng(0)
    pose = Pose.from_euler(
        0.75 + 0.1 * rng.normal(), 0.3 * rng.normal() - 0.5, 0.05, np.array([-90, -60, 120.0])
    )
    world = corner()
    pixels, seen = camera.project(world @ pose.R.T + pose.t)
    rows = seen & (pixels > 0).all(axis=1) & (pixels < [639, 479]).all(axis=1)
    noisy = pixels[rows] + 0.3 * rng.normal(size=(rows.sum(), 2))
    points = Correspondences(world[rows], noisy, image_size=(640, 480))
    found = calibrate(points, type=2, image_center=(318, 243), skew=False)
    assert found.lens_choice["fisheye"] < found.lens_choice[found.distortion_model]
    assert "among ordinary lenses" in calibration_report(found)

"""The reprojection error of a camera, on its own points and on others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.made_calibration import CAMERA, made_calibration, made_points, pose_of, two_planes
from support.plain_projection import project

from neurocal_cli import Correspondences, NeurocalError, evaluate_camera


def test_error_is_that_of_projecting_each_point_alone() -> None:
    calibration = made_calibration(3)
    evaluation = evaluate_camera(calibration)
    expected = [
        project(calibration.K, calibration.views[str(view)].pose, world[None])[0][0] - pixel
        for view, world, pixel in zip(
            calibration.points.view, calibration.points.world, calibration.points.pixels, strict=True
        )
    ]
    np.testing.assert_allclose(evaluation.residuals, expected, rtol=0, atol=1e-10)
    lengths = np.hypot(*np.transpose(expected))
    assert evaluation.rmse_px == pytest.approx(np.sqrt(np.mean(lengths**2)), rel=1e-12)
    assert evaluation.max_px == pytest.approx(lengths.max(), rel=1e-12)


def test_errors_of_the_axes_and_of_the_views_add_up_to_the_whole() -> None:
    evaluation = evaluate_camera(made_calibration(4))
    assert evaluation.rms_u**2 + evaluation.rms_v**2 == pytest.approx(evaluation.rmse_px**2, rel=1e-12)
    views = evaluation.views.values()
    total = sum(view.n_points * view.rmse_px**2 for view in views)
    assert total == pytest.approx(evaluation.n_points * evaluation.rmse_px**2, rel=1e-12)
    assert max(view.max_px for view in views) == evaluation.max_px


def test_each_view_has_the_error_that_its_calibration_states() -> None:
    calibration = made_calibration(3)
    evaluation = evaluate_camera(calibration)
    for name, view in calibration.views.items():
        assert evaluation.views[name].rmse_px == pytest.approx(view.rmse_px, rel=1e-10)


def test_bias_is_predicted_minus_observed() -> None:
    calibration = made_calibration(2, noise=0)
    moved = replace(calibration.points, pixels=calibration.points.pixels - [0.25, -0.5])
    evaluation = evaluate_camera(calibration, moved)
    assert (evaluation.bias_u, evaluation.bias_v) == pytest.approx((0.25, -0.5), abs=1e-9)
    assert evaluation.rmse_px == pytest.approx(np.hypot(0.25, 0.5), abs=1e-9)


def test_the_order_of_the_points_does_not_matter() -> None:
    calibration = made_calibration(3)
    order = np.random.default_rng(3).permutation(len(calibration.points))
    there, here = evaluate_camera(calibration, calibration.points.select(order)), evaluate_camera(calibration)
    assert there.rmse_px == pytest.approx(here.rmse_px, rel=1e-12)
    for name, view in here.views.items():
        assert there.views[name].rmse_px == pytest.approx(view.rmse_px, rel=1e-12)


def test_points_behind_the_camera_are_counted_and_in_no_average() -> None:
    calibration = made_calibration(1, noise=0)
    behind = -pose_of(0).R.T @ pose_of(0).t - 50 * pose_of(0).R[2]
    world = np.vstack([two_planes(), behind])
    pixels = np.vstack([calibration.points.pixels, [0, 0]])
    evaluation = evaluate_camera(calibration, Correspondences(world, pixels, ["view00"] * len(world)))
    assert (evaluation.n_points, evaluation.n_behind) == (191, 1)
    assert evaluation.rmse_px == pytest.approx(0, abs=1e-9)
    assert evaluation.views["view00"].n_behind == 1
    assert "1 of 191 points lie behind the camera" in evaluation.warnings[0]


def test_an_error_without_any_point_in_front_does_not_exist() -> None:
    calibration = made_calibration(1)
    behind = -pose_of(0).R.T @ pose_of(0).t - 50 * pose_of(0).R[2]
    evaluation = evaluate_camera(calibration, Correspondences(behind[None], [[0, 0]], ["view00"]))
    assert np.isnan([evaluation.rmse_px, evaluation.max_px, evaluation.views["view00"].rmse_px]).all()


def test_a_view_that_the_calibration_does_not_know_gets_a_fitted_pose() -> None:
    calibration = made_calibration(2)
    both = made_points(2, first=1)  # one known view, one new
    evaluation = evaluate_camera(calibration, both)
    assert evaluation.fitted_views == ("view02",)
    assert evaluation.views["view02"].rmse_px < 1.2 * evaluation.views["view01"].rmse_px
    assert not evaluation.views["view01"].fitted


def test_fitting_new_poses_does_not_hide_wrong_intrinsic_parameters() -> None:
    wrong = replace(made_calibration(1), intrinsics=replace(CAMERA, alpha_u=1.2 * CAMERA.alpha_u))
    assert evaluate_camera(wrong, made_points(1, first=5)).rmse_px > 3


def test_points_of_images_of_another_size_are_refused() -> None:
    other = replace(made_points(), image_size=(1280, 960))
    with pytest.raises(NeurocalError, match="1280 x 960 differs from the camera's 640 x 480"):
        evaluate_camera(made_calibration(), other)


def test_points_in_another_unit_are_warned_of_when_poses_are_reused() -> None:
    (warning,) = evaluate_camera(made_calibration(), replace(made_points(), unit="inch")).warnings
    assert "inch" in warning
    assert "mm" in warning


def test_the_lens_is_part_of_the_prediction() -> None:
    straight = made_calibration()
    bent = replace(straight, distortion_model="plumb_bob", distortion=np.array([-0.2, 0, 0, 0, 0]))
    assert evaluate_camera(bent).rmse_px > evaluate_camera(straight).rmse_px + 0.1


def test_ten_thousand_views_are_evaluated_at_once() -> None:
    one = made_calibration(1)
    names = [f"v{k}" for k in range(10_000)]
    views = dict.fromkeys(names, one.views["view00"])
    points = Correspondences(
        np.tile(two_planes()[::19], (10_000, 1)),
        np.tile(one.points.pixels[::19], (10_000, 1)),
        np.repeat(names, 10),
    )
    evaluation = evaluate_camera(replace(one, views=views, points=points))
    assert len(evaluation.views) == 10_000


def test_intrinsic_parameters_alone_are_judged_with_all_poses_fitted() -> None:
    points = made_points(2)
    evaluation = evaluate_camera(CAMERA, points)
    assert evaluation.fitted_views == points.view_names
    assert evaluation.rmse_px < evaluate_camera(made_calibration(2)).rmse_px
    with pytest.raises(NeurocalError, match="give the points"):
        evaluate_camera(CAMERA)

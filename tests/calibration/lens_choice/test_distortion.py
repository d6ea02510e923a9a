"""Distortion estimated with everything else, or given."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.distorted import through
from support.plain_projection import project
from support.scenes import Scene, board_midpoints, random_flat_set, table_1
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Correspondences, calibrate, evaluate_camera, read_calibration
from neurocal_cli.adjustment.reprojection import normal_blocks, residuals
from neurocal_cli.adjustment.views import batches_of
from neurocal_cli.calibration.lens_choice.monotonic_fit import where_not_monotonic
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError, InputError, UsageError
from neurocal_cli.files.result_files import write_calibration

LENSES = {
    "k1": [-0.25],
    "k1k2": [-0.28, 0.12],
    "plumb_bob": [-0.28, 0.12, 1e-3, -8e-4, -0.02],
    "rational": [0.3, -0.1, 1e-3, 5e-4, 0.02, 0.55, -0.02, 0.01],
    "fisheye": [0.05, -0.02, 0.01, -0.003],
}


def flat_points(model: str, sigma: float = 0.0, seed: int = 0) -> tuple[Scene, Correspondences]:
    """Twelve views of a large board that fills a wide image."""
    rng = np.random.default_rng(7)
    scene = random_flat_set(rng, 12, False, cols=11, rows=8, f=900, width=1000)
    noise = sigma * np.random.default_rng(seed).normal(size=scene.pixels.shape)
    pixels = through(scene, model, LENSES[model]).pixels + noise
    return scene, Correspondences(scene.world, pixels, scene.view, scene.image_size)


@pytest.mark.parametrize("model", list(LENSES))
def test_columns_of_the_lens_are_those_of_differences(model: str) -> None:
    rng = np.random.default_rng(2)
    local, pixels = rng.uniform(-1, 1, (40, 3)), rng.uniform(-1, 1, (40, 2))
    batches = batches_of(local, pixels, None, np.repeat([0, 1], 20), 2)
    R = np.tile(np.eye(3), (2, 1, 1))
    t = np.array([[0.1, 0.2, 3.0], [-0.2, 0.1, 4.0]])
    state = CameraState(np.array([[2.0, 0.1, 1.9, 0.05, -0.1]]), R, t, model, np.array(LENSES[model]))
    normal, _ = normal_blocks(batches, state)
    r0 = residuals(batches, state)
    n = 5 + len(state.k)

    def moved(column: int, step: float) -> Array:
        by_camera, by_pose = np.zeros((1, n)), np.zeros((2, 6))
        if column < 5:
            by_camera[0, column] = step
        elif column < 11:
            by_pose[:, column - 5] = step
        else:
            by_camera[0, column - 6] = step
        return residuals(batches, state.moved(by_camera, by_pose))

    for column in range(11 + len(state.k)):
        slope = (moved(column, 1e-6) - moved(column, -1e-6)) / 2e-6
        # The residual is observed minus predicted: minus the derivative, times the residual.
        expected = -(slope * r0).sum(axis=(1, 2))
        assert normal[:, column, -1] == pytest.approx(expected, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("model", slow_but(("plumb_bob",), [name for name in LENSES if name != "rational"]))
def test_noise_free_views_give_the_lens_back(model: str) -> None:
    scene, points = flat_points(model)
    calibration = calibrate(points, distortion=model, target="given")
    assert calibration.converged
    assert calibration.rmse_px < 1e-7
    truth = scene.intrinsics.values()
    assert np.abs(calibration.intrinsics.values() - truth)[:4].max() < 1e-3
    assert calibration.distortion == pytest.approx(np.array(LENSES[model]), abs=1e-6)


def test_coefficients_that_depend_on_each_other_are_refused() -> None:
    _, points = flat_points("rational")
    with pytest.raises(DegenerateGeometryError, match="all coefficients of the distortion model rational"):
        calibrate(points, distortion="rational")


@pytest.mark.parametrize("model", ["k1k2", "plumb_bob", "rational"])
def test_opencv_reaches_the_same_minimum(model: str) -> None:
    cv2 = pytest.importorskip("cv2")
    _, points = flat_points(model, 0.2)
    # No size: rational coefficients fitted within the board may fold at the corners.
    size, points = points.image_size, replace(points, image_size=None)
    flags = {
        "k1k2": cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        "plumb_bob": 0,
        "rational": cv2.CALIB_RATIONAL_MODEL,
    }[model]
    views = range(points.n_views)
    world = [points.world[points.view_index == k].astype(np.float32) for k in views]
    pixels = [points.pixels[points.view_index == k].astype(np.float32) for k in views]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    rms, K, *_ = cv2.calibrateCamera(world, pixels, size, None, None, flags=flags, criteria=criteria)
    calibration = calibrate(points, distortion=model, skew=False)
    assert calibration.rmse_px <= rms * (1 + 1e-5)  # OpenCV takes pixels in single precision
    if model != "rational":
        assert calibration.rmse_px == pytest.approx(rms, rel=1e-4)
        assert calibration.K[[0, 1], [0, 1]] == pytest.approx(K[[0, 1], [0, 1]], rel=1e-4)


def test_zhangs_views_give_the_published_lens(zhang: Correspondences) -> None:
    calibration = calibrate(zhang, distortion="k1k2", target="given")
    K = calibration.K
    assert (K[0, 0], K[1, 1]) == pytest.approx((832.5, 832.53), abs=0.01)
    assert K[0, 1] == pytest.approx(0.204494, abs=1e-4)
    assert (K[0, 2], K[1, 2]) == pytest.approx((303.959, 206.585), abs=0.002)
    assert calibration.distortion == pytest.approx([-0.228601, 0.190353], abs=1e-5)
    assert calibration.rmse_px == pytest.approx(0.3364, abs=1e-4)


@pytest.mark.parametrize("type", slow_but((1, 4), (1, 2, 4)))
def test_one_view_of_a_folded_target_gives_its_lens(type: int) -> None:
    scene = table_1()
    points = Correspondences(scene.world, through(scene, "k1", [-0.2]).pixels, scene.view, scene.image_size)
    calibration = calibrate(points, distortion="k1", **scene.given(type))
    assert calibration.distortion == pytest.approx([-0.2], abs=1e-9)
    assert np.abs(calibration.intrinsics.values() - scene.intrinsics.values())[:4].max() < 1e-5


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """A camera with a lens, from its file."""
    path = tmp_path_factory.mktemp("lens") / "camera.yaml"
    write_calibration(calibrate(flat_points("plumb_bob", 0.1)[1], distortion="plumb_bob"), str(path))
    return read_calibration(str(path))


def test_type_3_takes_the_lens_of_the_given_camera(camera: Calibration) -> None:
    posed = calibrate(camera.points, type=3, intrinsics=camera)
    assert posed.converged
    assert np.array_equal(posed.distortion, camera.distortion)
    assert posed.distortion_model == "plumb_bob"
    assert posed.std["k1"] == 0.0
    assert posed.rmse_px == pytest.approx(camera.rmse_px, rel=1e-6)
    for name, view in camera.views.items():
        assert posed.views[name].pose.t == pytest.approx(view.pose.t, abs=1e-3)


def test_a_file_with_a_lens_evaluates_as_it_was_calibrated(camera: Calibration) -> None:
    assert evaluate_camera(camera).rmse_px == pytest.approx(camera.rmse_px, rel=1e-12)
    assert evaluate_camera(camera).max_px == pytest.approx(camera.max_px, rel=1e-12)


def test_a_lens_that_could_not_have_seen_a_pixel_is_refused() -> None:
    scene, points = flat_points("k1")
    camera = Camera(scene.intrinsics, Distortion("k1", [-3.0]))
    with pytest.raises(InputError, match="maps nothing to"):
        calibrate(points, type=3, intrinsics=camera)


def test_a_lens_that_folds_inside_the_image_is_refused() -> None:
    # Points only near the centre, a strong barrel, and a tiny board: the corners are extrapolated.
    scene = table_1()
    board = np.column_stack([4.0 * board_midpoints(9, 6), np.zeros(93)])
    rng = np.random.default_rng(3)
    worlds, pixels, names = [], [], []
    for k, pose in enumerate(random_flat_set(rng, 6, False, cols=9, rows=6, f=500).poses.values()):
        near = board - board.mean(axis=0)
        seen, _ = project(scene.intrinsics.A, type(pose)(pose.R, np.array([0, 0, 300.0])), near)
        centred = Scene(near, seen, [], scene.intrinsics, {}, (352, 240))
        worlds.append(near)
        pixels.append(through(centred, "k1", [-3.2]).pixels)
        names += [f"v{k}"] * len(near)
    points = Correspondences(np.concatenate(worlds), np.concatenate(pixels), names, (352, 240))
    with pytest.raises(DegenerateGeometryError, match=r"is not monotonic .* inside the image"):
        calibrate(points, distortion="k1")


def test_a_given_lens_may_fold_in_corners_that_no_point_reaches() -> None:
    scene = random_flat_set(np.random.default_rng(3), 4, False, cols=9, rows=6, f=900)
    scene = through(scene, "k1", [-0.5])
    points = scene.points(0.1, np.random.default_rng(0))
    centre = np.array([scene.intrinsics.u0, scene.intrinsics.v0])
    middle = points.select(np.hypot(*(points.pixels - centre).T) < 250)
    camera = Camera(scene.intrinsics, Distortion("k1", [-0.5]))
    assert where_not_monotonic(camera.distortion, camera.A, middle) == "image"
    found = calibrate(middle, type=3, intrinsics=camera, outliers="keep")
    assert found.rmse_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)


def test_a_lens_of_type_3_cannot_be_chosen() -> None:
    scene = table_1()
    with pytest.raises(UsageError, match="uses the distortion of the given camera"):
        calibrate(scene.points(), type=3, intrinsics=scene.intrinsics, distortion="k1")


def test_coefficients_that_are_noise_are_named() -> None:
    scene = random_flat_set(np.random.default_rng(7), 8, False, cols=11, rows=8, f=900, width=1000)
    calibration = calibrate(scene.points(0.3, np.random.default_rng(1)), distortion="plumb_bob")
    assert any("not significantly different from 0" in warning for warning in calibration.warnings)


def test_too_many_coefficients_are_refused() -> None:
    with pytest.raises(InputError, match="k1k2 needs 2"):
        Distortion("k1k2", np.array([0.1, 0.2, 0.3]))


@pytest.mark.slow
@pytest.mark.parametrize("trials", [150])
def test_reported_std_is_true_with_a_lens(trials: int) -> None:
    names = (*INTRINSIC_NAMES[:4], "k1", "k2")
    errors, stds = [], []
    for seed in range(trials):
        scene, points = flat_points("k1k2", 0.3, seed)
        calibration = calibrate(points, distortion="k1k2", skew=False)
        found = np.concatenate([calibration.intrinsics.values()[:4], calibration.distortion])
        errors.append(found - np.concatenate([scene.intrinsics.values()[:4], LENSES["k1k2"]]))
        stds.append([calibration.std[name] for name in names])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.mean(np.square(stds), axis=0))
    # The relative standard error of an rms over n trials is 1 / sqrt(2 n); three and a half of them.
    assert np.abs(ratio - 1).max() < 3.5 / np.sqrt(2 * trials)


@pytest.mark.parametrize("model", ["rational", "eucm"])
def test_a_named_model_with_coefficients_that_no_point_determines_is_said_to_have_them(model: str) -> None:
    """On a camera without distortion rational folds the image back, and alpha of eucm is 0."""
    rng = np.random.default_rng(4)
    scene = random_flat_set(rng, 10, False, cols=9, rows=7, f=1100, width=1280)
    points = scene.points(0.1, rng)
    said = "the points do not determine the coefficients of the distortion model .* as a camera without"
    if model == "rational":
        with pytest.raises(DegenerateGeometryError, match=said):
            calibrate(points, distortion=model)
        return
    found = calibrate(points, distortion=model)
    assert any(re.match(said, text) for text in found.warnings)
    assert found.verdict is not None
    assert "increase --starts" not in found.verdict.advice

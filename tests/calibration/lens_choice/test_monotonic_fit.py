"""Lenses that would fold back in corners that no point reaches are fitted so that they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.distorted import SIGMA, bent_set, new_views, through
from support.places import SAMPLES
from support.plain_projection import project
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Correspondences, calibrate, read_points
from neurocal_cli.calibration.lens_choice import given_model
from neurocal_cli.calibration.lens_choice.monotonic_fit import MonotonicFit, where_not_monotonic
from neurocal_cli.calibration.rig.fit import fit_rig
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion, distort_with_jacobian
from neurocal_cli.camera.geometry import rotation_step
from neurocal_cli.camera.monotonic import radial_slope
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.simulation.rigs import SimulatedRig

LENSES = {
    "k1": [-0.2],
    "k1k2": [-0.3, 0.1],
    "k1k2p1p2": [-0.3, 0.1, 0.001, -0.002],
    "plumb_bob": [-0.3, 0.1, 0.001, -0.002, 0.03],
    "rational": [0.3, 0.1, 0.001, -0.002, 0.02, 0.5, 0.1, 0.03],
    "fisheye": [0.02, -0.01, 0.003, -0.001],
}
# The best fit of each folds back in a corner, the true lens does not.
FOLDING = [("k1k2", 38), ("k1k2", 74), ("k1k2", 130), ("k1k2p1p2", 74), ("k1k2p1p2", 130)]


def noisy(model: str, seed: int, draw: int = 1) -> Correspondences:
    scene, _ = bent_set(model, seed)
    return scene.points(SIGMA, np.random.default_rng([seed, draw]))


def free_fit(points: Correspondences, model: str) -> Calibration:
    """Where the image ends is not known, so nothing folds back before."""
    return calibrate(replace(points, image_size=None), distortion=model, skew=False)


@pytest.mark.parametrize("model", LENSES)
def test_the_slope_and_its_derivatives_are_those_of_differences(model: str) -> None:
    k, r, h = np.array(LENSES[model]), np.linspace(0.05, 1.2, 9), 1e-6
    slope, by_k = radial_slope(model, k, r)
    without = np.where(np.isin(np.arange(len(k)), (2, 3)) & (model != "fisheye"), 0.0, k)
    radius = np.tan(r) if model == "fisheye" else r
    _, (along, *_), _ = distort_with_jacobian(model, without, radius, np.zeros_like(r))
    assert slope == pytest.approx(along * (1 + radius**2 if model == "fisheye" else 1.0), rel=1e-12)
    for n in range(len(k)):
        step = h * (np.arange(len(k)) == n)
        difference = (radial_slope(model, k + step, r)[0] - radial_slope(model, k - step, r)[0]) / (2 * h)
        assert by_k[:, n] == pytest.approx(difference, abs=1e-7)


def test_a_lens_with_all_the_slope_that_is_asked_for_is_free() -> None:
    penalty = MonotonicFit(np.linspace(0.1, 0.5, 5), 100.0, 0.1)
    state = CameraState(np.ones((1, 5)), np.eye(3)[None], np.zeros((1, 3)), "k1", np.array([-0.2]))
    by_camera, missing = penalty(state)
    assert not by_camera.any()
    assert not missing.any()
    by_camera, missing = penalty(replace(state, k=np.array([-2.0])))
    assert missing.any()
    assert (by_camera[missing > 0, 5] > 0).all()  # more k1, more slope


@pytest.mark.parametrize(("model", "seed"), slow_but(FOLDING[:1], FOLDING))
@pytest.mark.parametrize("asked", ["auto", "the model"])
def test_a_fold_where_no_point_is_goes_and_new_views_are_predicted_better(
    model: str, seed: int, asked: str, request: pytest.FixtureRequest
) -> None:
    if (model, seed, asked) == ("k1k2p1p2", 74, "auto"):
        why = "p1 is 3.3 std off 0, which is too little evidence to select p1 and p2: k1k2 is"
        request.applymarker(pytest.mark.xfail(reason=why))
    points = noisy(model, seed)
    found = calibrate(points, distortion="auto" if asked == "auto" else model, skew=False)
    free = free_fit(points, model)
    assert found.distortion_model == model
    assert where_not_monotonic(Distortion(model, free.distortion), free.K, points) == "image"
    assert where_not_monotonic(Distortion(model, found.distortion), found.K, points) is None
    assert found.converged
    assert free.rmse_px < found.rmse_px < 1.01 * free.rmse_px
    scene, k = bent_set(model, seed)
    new = new_views(scene, model, k, seed)
    assert new.error(found) < 0.98 * new.error(free)
    assert any("corners" in text for text in found.warnings)


@pytest.mark.parametrize(("model", "seed"), [("k1k2", 3), ("plumb_bob", 3), ("fisheye", 1)])
def test_a_lens_that_does_not_fold_is_the_same_to_the_last_bit(model: str, seed: int) -> None:
    points = noisy(model, seed)
    found, free = calibrate(points, distortion=model, skew=False), free_fit(points, model)
    assert np.array_equal(found.distortion, free.distortion)
    assert np.array_equal(found.K, free.K)
    assert not any("corners" in text for text in found.warnings)


def test_points_that_deny_every_lens_without_a_fold_are_refused() -> None:
    # A true k1k2 and plenty of points: k1 alone follows them only with a fold.
    points = noisy("k1k2", 130)
    with pytest.raises(DegenerateGeometryError, match=r"k1 is not monotonic .* inside the image"):
        calibrate(points, distortion="k1", skew=False)


def of_an_endoscope(alpha: float, k: list[float], rng: np.random.Generator) -> Calibration:
    """A camera whose corners are beyond the image of 50 or 30 degrees from the axis, and show nothing."""
    lens = Distortion("k1k2p1p2", np.array(k))
    camera = Camera(Intrinsics(alpha, alpha, 637.0, 481.0), lens, (1280, 960))
    board = np.array([(25.0 * x - 100, 25.0 * y - 75, 0.0) for y in range(7) for x in range(9)])
    frames = {}
    for name in "abcdefghijkl":
        turn = np.append(rng.uniform(-0.7, 0.7, 2), rng.uniform(-1, 1))
        t = np.append(rng.uniform(-130, 130, 2), rng.uniform(220, 400) * alpha / 675.0)
        frames[name] = Pose(rotation_step(turn[None])[0], t)
    seen = SimulatedRig({"cam": camera}, {"cam": Pose(np.eye(3), np.zeros(3))}, board, frames)
    return calibrate(seen.points(0.05, rng)["cam"])


@pytest.mark.parametrize(("alpha", "k"), [(675.0, [-0.32, 0.04]), (1660.0, [-0.71, 0.07])])
def test_points_near_the_fold_of_a_true_lens_do_not_make_it_a_pinhole(alpha: float, k: list[float]) -> None:
    found = of_an_endoscope(alpha, [*k, 0.0, 0.0], np.random.default_rng(2))
    assert found.rmse_px < 1.1 * 0.05 * np.sqrt(2)
    assert found.intrinsics.alpha_u == pytest.approx(alpha, abs=5 * found.std["alpha_u"])


@pytest.mark.parametrize("seed", [0, 5])
def test_an_ordinary_lens_is_decentred_even_if_a_fisheye_stands_for_it(seed: int) -> None:
    found = of_an_endoscope(1660.0, [-0.71, 0.07, -3.4e-4, 1e-4], np.random.default_rng(seed))
    assert found.distortion_model == "fisheye"
    assert found.intrinsics.v0 == pytest.approx(481.0, abs=4 * found.std["v0"])  # 5.0 and 5.7 if p1 may be 0


def test_a_fisheye_need_not_see_the_corners() -> None:
    # A picture of 200 degrees across its diagonal: the corners lie beyond 90 degrees.
    A, lens = (
        np.array([[180.0, 0, 319.5], [0, 180.0, 239.5], [0, 0, 1]]),
        Distortion("fisheye", [0.02, 0.0, 0.0, 0.0]),
    )
    points = Correspondences(np.zeros((1, 3)), np.array([[330.0, 250.0]]), image_size=(640, 480))
    assert where_not_monotonic(lens, A, points) is None
    assert where_not_monotonic(Distortion("fisheye", [-0.2, 0.0, 0.0, 0.0]), A, points) == "image"


@pytest.mark.slow
def test_standard_deviations_are_not_too_small() -> None:
    scene, k = bent_set("k1k2", 130)
    errors = []
    for draw in range(60):
        found = calibrate(noisy("k1k2", 130, draw), distortion="k1k2", skew=False, outliers="keep")
        truth = {"alpha_u": scene.intrinsics.alpha_u, "k1": k[0], "k2": k[1]}
        value = {"alpha_u": found.intrinsics.alpha_u, "k1": found.distortion[0], "k2": found.distortion[1]}
        errors.append([(value[name] - truth[name]) / found.std[name] for name in truth])
    assert (np.sqrt(np.mean(np.square(errors), axis=0)) < 1.2).all()


def test_a_rig_keeps_a_lens_from_folding() -> None:
    scene, k = bent_set("k1k2", 38)
    view = np.array(scene.view)
    poses = {name: Pose(pose.R, pose.t - [60.0, 0, 0]) for name, pose in scene.poses.items()}
    pixels = np.concatenate(
        [project(scene.intrinsics.A, poses[v], scene.world[view == v])[0] for v in scene.poses]
    )
    other = through(replace(scene, pixels=pixels, poses=poses), "k1k2", k)
    right = other.points(SIGMA, np.random.default_rng([38, 5]))
    left = noisy("k1k2", 38)
    cameras = [calibrate(points, distortion="k1k2", skew=False) for points in (left, right)]
    rig = fit_rig({"left": cameras[0], "right": cameras[1]}, refine_cameras=True).pair("left", "right")
    lens = Distortion("k1k2", rig.left.distortion)
    assert where_not_monotonic(lens, rig.left.K, cameras[0].points) is None
    assert any("the distortion model k1k2 of the left camera" in text for text in rig.warnings)
    for found, name, true in zip(rig.left.distortion, ("k1", "k2"), k, strict=True):
        assert found == pytest.approx(true, abs=4 * rig.left.std[name])
    assert rig.baseline == pytest.approx(60.0, abs=4 * rig.std["baseline"])


def test_a_wide_lens_without_a_polynomial_is_not_fitted_with_the_slopes_of_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = read_points(SAMPLES / "fisheye.csv")

    found = calibrate(points, distortion="omnidir", skew=False, target="given")
    monkeypatch.setattr(given_model, "folds_back", lambda problem, state: "image")
    again = calibrate(points, distortion="omnidir", skew=False, target="given")
    np.testing.assert_array_equal(again.distortion, found.distortion)

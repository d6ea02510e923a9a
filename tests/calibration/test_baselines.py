"""The methods of comparison: exact without noise, at the same minimum with it, refusals with reasons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import run, succeed
from support.distorted import through
from support.scenes import Scene, pinhole, random_flat_set, random_solid, table_1

from neurocal_cli import Calibration, Correspondences, calibrate, read_calibration, write_points
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.calibration.other_methods.calibrate_by import calibrate_by
from neurocal_cli.calibration.other_methods.linear import smallest
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.errors import NeurocalError, UsageError

SEED = st.integers(0, 10_000)


def error(calibration: Calibration, scene: Scene) -> float:
    """Largest error of an intrinsic parameter, in alphas and radians; and of a rotation."""
    K = scene.intrinsics
    off = np.abs(calibration.intrinsics.values() - K.values()) / np.array([*[K.alpha_u] * 4, 1.0])
    turned = max(np.abs(view.pose.R - scene.poses[name].R).max() for name, view in calibration.views.items())
    return float(max(off.max(), turned))


@settings(max_examples=15, deadline=None)
@given(seed=SEED, type=st.sampled_from([1, 2, 3, 4]), skew=st.booleans())
def test_linear_is_exact_on_solid_targets(seed: int, type: int, skew: bool) -> None:
    rng = np.random.default_rng(seed)
    scene = random_solid(rng, type, skew)
    if len(scene.world) < 9:
        return
    assert error(calibrate(scene.points(), method="linear", skew=skew, **scene.given(type)), scene) < 1e-6


@settings(max_examples=15, deadline=None)
@given(seed=SEED, type=st.sampled_from([1, 2, 3, 4]), skew=st.booleans())
def test_linear_is_exact_on_flat_boards(seed: int, type: int, skew: bool) -> None:
    rng = np.random.default_rng(seed)
    scene = random_flat_set(rng, 5, skew)
    assert error(calibrate(scene.points(), method="linear", skew=skew, **scene.given(type)), scene) < 1e-6


@settings(max_examples=15, deadline=None)
@given(seed=SEED, type=st.sampled_from([1, 2, 3, 4]), flat=st.booleans())
def test_nonlinear_ends_at_the_minimum_that_the_network_finds(seed: int, type: int, flat: bool) -> None:
    """Two implementations that share the projection alone."""
    rng = np.random.default_rng(seed)
    scene = random_flat_set(rng, 4, True) if flat else table_1()
    points = scene.points(0.3, rng)
    ours = pinhole(points, target="given", **scene.given(type))
    theirs = calibrate(points, method="nonlinear", **scene.given(type))
    assert theirs.rmse_px == pytest.approx(ours.rmse_px, rel=1e-9)
    assert theirs.intrinsics.values() == pytest.approx(ours.intrinsics.values(), rel=1e-4)
    assert theirs.std == pytest.approx(ours.std, rel=1e-3, abs=1e-12)


@pytest.mark.parametrize("n_views", [5, 30])  # dense, and sparse
def test_nonlinear_estimates_a_distortion_too(n_views: int) -> None:
    rng = np.random.default_rng(5)
    scene = random_flat_set(rng, n_views, False, cols=9, rows=6, width=640, f=700)
    points = through(scene, "k1k2", [-0.2, 0.05]).points(0.2, rng)
    ours = calibrate(points, distortion="k1k2", outliers="keep")
    theirs = calibrate(points, distortion="k1k2", method="nonlinear")
    assert theirs.rmse_px == pytest.approx(ours.rmse_px, rel=1e-8)
    assert theirs.distortion == pytest.approx(ours.distortion, rel=1e-3)


def test_nonlinear_of_a_given_lens_ends_where_the_network_does() -> None:
    rng = np.random.default_rng(6)
    scene = random_flat_set(rng, 3, False, cols=9, rows=6, width=640, f=700)
    points = through(scene, "k1k2", [-0.2, 0.05]).points(0.2, rng)
    known = calibrate(points, distortion="k1k2", outliers="keep")
    ours, theirs = (
        calibrate(points, type=3, intrinsics=known, method=method, outliers="keep")
        for method in ("neuro", "nonlinear")
    )
    assert theirs.rmse_px == pytest.approx(ours.rmse_px, rel=1e-9)


def test_linear_does_not_depend_on_the_coordinates() -> None:
    """As |p3| = 1 has it; p34 = 1 has not."""
    scene, rng = table_1(), np.random.default_rng(7)
    points = scene.points(1.0, rng)
    one = calibrate(points, method="linear")
    far = replace(points, world=points.world * 0.1 + np.array([30.0, -500.0, 70.0]))
    assert calibrate(far, method="linear").intrinsics.values() == pytest.approx(
        one.intrinsics.values(), rel=1e-8
    )


def test_linear_works_where_the_worlds_origin_is_in_the_focal_plane() -> None:
    """There p34 is 0."""
    scene = table_1()
    pose = scene.poses["view"]
    origin = -pose.t[2] * pose.R[2]  # depth 0
    points = replace(scene.points(), world=scene.world - origin)
    found = calibrate(points, method="linear")
    assert abs(found.views["view"].pose.t[2]) < 1e-8
    assert found.intrinsics.values() == pytest.approx(scene.intrinsics.values(), rel=1e-9)


def test_linear_is_worse_with_noise_and_says_that_it_does_not_minimise() -> None:
    scene = table_1()
    points = scene.points(1.0, np.random.default_rng(0))
    linear, nonlinear = (calibrate(points, method=method) for method in ("linear", "nonlinear"))
    assert linear.rmse_px > 1.01 * nonlinear.rmse_px
    assert linear.converged
    assert "does not minimise" in linear.stop_reason
    assert "does not minimise" in linear.warnings[0]
    assert linear.network is None
    assert nonlinear.warnings == ()
    assert nonlinear.verdict is not None
    assert linear.verdict is not None


def test_opencv_ends_at_the_same_minimum_without_skew() -> None:
    rng = np.random.default_rng(8)
    scene = random_flat_set(rng, 6, False, cols=9, rows=6, width=640, f=700)
    for model in ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob"):
        points = through(scene, "k1", [-0.2]).points(0.2, rng)
        ours = calibrate(points, distortion=model, skew=False, outliers="keep")
        theirs = calibrate_by("opencv", problem_for(points, 1, distortion=Distortion(model)))
        assert theirs.rmse_px == pytest.approx(ours.rmse_px, rel=1e-4)
        assert "theta" in theirs.fixed


def test_the_constrained_problem_is_solved() -> None:
    rng = np.random.default_rng(9)
    rows = rng.normal(size=(4, 20, 7))
    solution = smallest(rows, 3)
    assert np.linalg.norm(solution[:, 4:], axis=1) == pytest.approx(np.ones(4))
    squares = ((rows @ solution[..., None]) ** 2).sum(axis=(1, 2))
    others = solution[None] + 1e-3 * rng.normal(size=(200, *solution.shape))
    others /= np.linalg.norm(others[..., 4:], axis=-1, keepdims=True)
    assert (((rows @ others[..., None]) ** 2).sum(axis=(2, 3)) >= squares).all()


FLAT = random_flat_set(np.random.default_rng(10), 3, False)
ONE_BOARD = FLAT.points().select(FLAT.points().view_index == 0)
FEW = table_1().points().select(np.arange(0, 440, 90))


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (ONE_BOARD, {"method": "linear"}, "one view of one plane cannot determine"),
        (FEW, {"method": "linear", "type": 2, "image_center": (172.0, 121.0)}, "5 different points"),
        (FLAT.points(), {"method": "linear", "distortion": "k1"}, "estimates no distortion"),
        (FLAT.points(), {"method": "nonlinear", "distortion": "plumb-line"}, "needs the method neuro"),
        (FLAT.points(), {"method": "tsai", "distortion": "k1k2"}, "estimates k1 alone"),
        (FLAT.points(), {"method": "tsai", **FLAT.given(4)}, "estimates poses"),
        (replace(FLAT.points(), image_size=None), {"method": "tsai"}, "needs the image centre"),
        (FLAT.points(), {"method": "linear", "target": "free"}, "target free needs the method neuro"),
        (FLAT.points(), {"method": "dlt"}, "method must be one of neuro, linear, nonlinear, tsai"),
        (
            Correspondences(table_1().world * [1, 1, -1], table_1().pixels),
            {"method": "nonlinear"},
            "only a mirrored camera",
        ),
    ],
)
def test_what_a_method_cannot_do_is_refused(
    points: Correspondences, options: dict[str, object], message: str
) -> None:
    with pytest.raises(NeurocalError, match=message):
        calibrate(points, **options)  # type: ignore[arg-type]


def test_opencv_refuses_what_it_has_not() -> None:
    with pytest.raises(UsageError, match="types 1 and 2"):
        calibrate_by("opencv", problem_for(FLAT.points(), 3, intrinsics=FLAT.intrinsics))


@pytest.mark.parametrize("method", ["linear", "nonlinear", "tsai"])
def test_the_command_writes_a_file_of_each_method(method: str, tmp_path: Path) -> None:
    points, camera = tmp_path / "points.csv", tmp_path / "camera.yaml"
    scene = random_flat_set(np.random.default_rng(11), 4, False)
    write_points(scene.points(0.1, np.random.default_rng(12)), points)
    done = succeed("calibrate", points, "--method", method, "--no-skew", "-o", camera)
    assert ("does not minimise" in done.stderr) == (method != "nonlinear")
    again = read_calibration(camera)
    assert (again.method, again.trainer, again.network) == (method, "none", None)
    succeed("evaluate", "camera", camera)
    refused = run("calibrate", points, "--method", method, "--trainer", "backprop")
    assert refused.exit_code == 2
    assert "--trainer backprop needs --method neuro" in refused.stderr

"""Lenses fitted to points at many settings and to known cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline, RegularGridInterpolator
from simulated_zoom import SimulatedZoom
from support.real_data import RealFiles
from support.zoom_laws import FLOOR, HIGH, LOW, between, covered, grid, seen, truth

from neurocal import fit_lens
from neurocal_cli.calibration.evaluation import evaluate_camera
from neurocal_cli.calibration.zoom.evaluation import (
    _baseline_error,
    _rms,
    _squares,
    baselines_of,
    evaluate_lens,
    grid_axes,
    spline_matrix,
)
from neurocal_cli.calibration.zoom.fit import LensCameras, fit_lens_cameras
from neurocal_cli.calibration.zoom.initialisation import _predicts_better
from neurocal_cli.calibration.zoom.judgement import judge_lens
from neurocal_cli.calibration.zoom.open_terms import monomials, powers_up_to
from neurocal_cli.calibration.zoom.parameter_networks import Budget, fit_committee
from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.calibration.zoom.zoom_lens import ZoomLens, camera_at
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import rotation_step
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError, InputError, NeurocalError, UsageError
from neurocal_cli.observations.points import Correspondences

FEW = ((0, 2),)  # a topology that a smooth lens needs no more than


@cache
def smooth() -> ZoomLens:
    return fit_lens(seen("c", grid(5, 3), seed=1), distortion="none", topologies=FEW)


def columns(lens: LensPoints) -> dict[str, np.ndarray]:
    return dict(zip(lens.controls, lens.settings[lens.point_setting].T, strict=True))


def test_a_smooth_lens_is_known_between_its_settings() -> None:
    evaluation = evaluate_lens(smooth(), seen("c", between(5, 3), seed=2))
    assert evaluation.rmse_px < 1.12 * FLOOR  # 15 settings are few
    assert evaluation.rmse_px < 0.5 * evaluation.baselines["lookup_joint"]
    assert smooth().converged
    assert smooth().rmse_px == pytest.approx(FLOOR, rel=0.05)
    assert not smooth().rejected
    assert (
        covered(smooth(), "c", between(5, 3)) > 0.7
    )  # one lens; the errors of its settings are not independent


def test_the_verdict_on_a_lens() -> None:
    good = judge_lens(smooth(), evaluate_lens(smooth(), seen("c", between(5, 3), seed=2)).rmse_px)
    assert good is not None
    assert (good.word, good.reasons) == ("good", ())
    noisier = evaluate_lens(smooth(), seen("c", between(5, 3), seed=2, sigma=1.0))
    assert judge_lens(smooth(), noisier.rmse_px, noisier.noise_px).word == "good"
    changed = evaluate_lens(smooth(), seen("a", between(5, 3), seed=2, sigma=1.0))
    assert judge_lens(smooth(), changed.rmse_px, changed.noise_px).word == "poor"
    far = judge_lens(smooth(), 2.0)
    assert far is not None
    assert far.word == "poor"
    assert "error at the given points is 2 px" in far.reasons[0]
    coarse = judge_lens(replace(smooth(), left_out_px=0.4))
    assert coarse is not None
    assert coarse.word == "usable"
    assert "changes too much between the settings" in coarse.reasons[0]


def test_the_error_by_setting_adds_up_to_the_whole() -> None:
    evaluation = evaluate_lens(smooth(), seen("c", between(5, 3), seed=2))
    squares = [s.n_points * s.rmse_px**2 for s in evaluation.settings]
    assert np.sqrt(sum(squares) / evaluation.n_points) == pytest.approx(evaluation.rmse_px, rel=1e-12)
    assert evaluation.max_px == max(s.max_px for s in evaluation.settings)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_lens() -> None:
    points = seen("c", grid(4, 3), seed=3, side=4)
    one, two = (fit_lens(points, distortion="none", topologies=((0, 1),), seed=7) for _ in range(2))
    np.testing.assert_array_equal(one.predict(one.settings).covariance, two.predict(two.settings).covariance)
    np.testing.assert_array_equal(one.predict(one.settings).local, two.predict(two.settings).local)


@pytest.mark.slow
def test_a_lens_of_one_control() -> None:
    settings = grid(7, 2)[::2]
    points = seen("c", settings, seed=4)
    lens = fit_lens(points, distortion="none", topologies=FEW)
    assert lens.controls == ("zoom",)
    middle = settings[:-1] + 0.5 * np.diff(settings, axis=0)
    evaluation = evaluate_lens(lens, seen("c", middle, seed=5))
    assert evaluation.rmse_px < 1.05 * FLOOR
    assert "thin_plate" not in evaluation.baselines
    camera = camera_at(lens, np.array([700.0]))
    assert camera.std["alpha_u"] > 0


@pytest.mark.slow
def test_settings_need_no_grid() -> None:
    rng = np.random.default_rng(6)
    settings = LOW + rng.uniform(0, 1, (20, 2)) * (HIGH - LOW)
    settings = np.vstack([settings, grid(2, 2)])
    lens = fit_lens(seen("c", settings, seed=7), distortion="none", topologies=FEW)
    evaluation = evaluate_lens(lens, seen("c", between(4, 4), seed=8))
    assert evaluation.rmse_px < 1.05 * FLOOR
    assert "lookup" not in evaluation.baselines
    assert evaluation.rmse_px < evaluation.baselines["thin_plate_joint"]


@pytest.mark.slow
def test_distortion_is_chosen_and_follows_the_zoom() -> None:
    lens = fit_lens(seen("c", grid(5, 3), seed=9, bends=True), topologies=((0, 2),))
    assert lens.model == "k1"
    k1 = lens.predict(between(5, 3)).local[:, -1]
    true = -0.25 + 0.32 * (between(5, 3)[:, 0] - LOW[0]) / (HIGH[0] - LOW[0])
    np.testing.assert_allclose(k1, true, atol=0.03)
    evaluation = evaluate_lens(lens, seen("c", between(5, 3), seed=10, bends=True))
    assert evaluation.rmse_px < 1.12 * FLOOR


def test_a_richer_model_must_predict_settings_better_in_sum_and_in_proportion() -> None:
    """Simulated settings of focus, with k2 of 0.05 and without: one in seven tells most of it."""
    without = [0.0600, 0.0410, 0.0402, 0.0395, 0.0410, 0.0390, 0.0375]
    gains = [0.052, -0.004, 0.002, 0.003, 0.015, 0.006, 0.021]
    keys = [(float(k),) for k in range(7)]
    known = dict(zip(keys, without, strict=True))
    assert _predicts_better({key: known[key] * np.exp(-g) for key, g in zip(keys, gains, strict=True)}, known)
    assert not _predicts_better({key: 1.001 * known[key] for key in keys}, known)
    assert not _predicts_better(
        {**known, keys[0]: 0.055, **{key: 1.03 * known[key] for key in keys[1:]}}, known
    )


@pytest.mark.slow
def test_no_distortion_is_chosen_where_there_is_none() -> None:
    assert fit_lens(seen("c", grid(5, 3), seed=11), topologies=((0, 2),)).model == "none"


@pytest.mark.slow
def test_a_setting_with_wrong_pixels_is_left_out() -> None:
    points = seen("c", grid(5, 3), seed=12, side=5)
    pixels = points.points.pixels.copy()
    bad = points.point_setting == 7
    pixels[bad] += np.random.default_rng(0).normal(size=(bad.sum(), 2)) * 8
    spoilt = LensPoints.grouped(replace(points.points, pixels=pixels), columns(points))
    lens = fit_lens(spoilt, distortion="none", topologies=FEW)
    assert [r.setting for r in lens.rejected] == [tuple(points.settings[7])]
    assert any("left out" in warning for warning in lens.warnings)
    verdict = judge_lens(lens)
    assert verdict is not None
    assert verdict.word == "usable"
    assert "1 of 15 settings contradict the others and were left out" in verdict.reasons[0]
    assert evaluate_lens(lens, seen("c", between(5, 3), seed=13)).rmse_px < 1.15 * FLOOR
    kept = fit_lens(spoilt, distortion="none", topologies=((0, 2),), outliers="keep")
    assert not kept.rejected
    assert kept.rmse_px > 3 * lens.rmse_px
    worst = judge_lens(kept)
    assert worst is not None
    assert worst.word in ("usable", "poor")
    assert any("that of the other settings" in reason for reason in worst.reasons)


@pytest.mark.slow
def test_a_setting_under_a_wrong_name_is_left_out() -> None:
    points = seen("c", grid(6, 3), seed=14, side=5)
    named = columns(points)
    wrong = points.point_setting == 8
    named["zoom"] = np.where(wrong, named["zoom"] + 130.0, named["zoom"])
    lens = fit_lens(LensPoints.grouped(points.points, named), distortion="none", topologies=FEW)
    assert len(lens.rejected) == 1
    assert lens.rejected[0].setting[0] == points.settings[8, 0] + 130
    assert "standard deviations" in lens.rejected[0].reason


@pytest.mark.slow
def test_nothing_is_left_out_of_a_lens_that_bends_sharply() -> None:
    lens = fit_lens(seen("a", grid(7, 5), seed=15, side=5), distortion="none", topologies=((1, 2), (2, 2)))
    assert not lens.rejected


def test_the_camera_at_a_setting_is_judged_like_any_other() -> None:
    lens = smooth()
    setting = between(5, 3)[3]
    camera = camera_at(lens, setting, "tele")
    there = truth("c", setting[None])
    assert abs(camera.intrinsics.alpha_u - there["alpha_u"][0]) < 5 * camera.std["alpha_u"]
    assert camera.std["theta"] > 0
    points = seen("c", setting[None], seed=16).points
    # A view that the camera does not name gets a pose of its own; one that is named `view` has the lens's.
    assert evaluate_camera(camera, points).rmse_px < 1.1 * FLOOR
    unnamed = replace(points, view=None)
    evaluation = evaluate_camera(camera, unnamed)
    assert not evaluation.fitted_views
    assert evaluation.rmse_px < 1.15 * FLOOR
    with pytest.raises(InputError, match="has no points"):
        evaluate_camera(camera)


def test_settings_outside_are_refused_unless_asked_for() -> None:
    lens = smooth()
    with pytest.raises(InputError, match="outside the calibrated range, 100 to 2100"):
        lens.setting_of({"zoom": 3000.0, "focus": 450.0})
    setting, warnings = lens.setting_of({"zoom": 2300.0, "focus": 450.0}, extrapolate=True)
    assert len(warnings) == 1
    with pytest.raises(InputError, match="outside the calibrated range, 100 to 2100"):
        camera_at(lens, setting)
    camera = camera_at(lens, setting, extrapolate=True)
    assert camera.intrinsics.alpha_u > 0
    assert list(camera.warnings) == warnings
    with pytest.raises(InputError, match=r"does not determine the camera|no valid camera"):
        camera_at(lens, np.array([9000.0, 450.0]), extrapolate=True)
    with pytest.raises(InputError, match="setting must be an array of real numbers"):
        camera_at(lens, [1250.0, "far"])  # type: ignore[list-item]
    for wrong in (1250.0, [], [1250.0], [[1250.0, 400.0]], None):
        with pytest.raises(InputError, match="has 2 controls, zoom and focus; give a list of 2 numbers"):
            camera_at(lens, wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="give rows of 2 numbers"):
        lens.predict(setting)
    for values in ({"zoom": 500.0, "focus": None}, {"zoom": None, "focus": 1.0}):
        with pytest.raises(UsageError, match="needs a value"):
            lens.setting_of(values)
    with pytest.raises(InputError, match="finite"):
        lens.setting_of({"zoom": np.nan, "focus": 1.0})


@pytest.mark.slow
def test_a_lens_of_a_moving_board() -> None:
    """Boards in five poses at each of six zooms: no t_z, a pose for each view."""
    rng = np.random.default_rng(17)
    zooms = np.linspace(0, 1000, 6)
    worlds, pixels, names, zoom = [], [], [], []
    for s, z in enumerate(np.repeat(zooms, 5)):
        alpha, u0 = 800 * np.exp(0.0009 * z), 320 + 0.003 * z
        board, seen_at = board_view(alpha, u0, rng)
        worlds.append(board)
        pixels.append(seen_at + 0.1 * rng.normal(size=seen_at.shape))
        names += [f"view{s}"] * len(board)
        zoom += [z] * len(board)
    points = Correspondences(np.concatenate(worlds), np.concatenate(pixels), names, (640, 480))
    lens = fit_lens(
        LensPoints.grouped(points, {"zoom": np.array(zoom)}), distortion="none", skew=False, topologies=FEW
    )
    assert not lens.still
    assert lens.names == ("alpha_u", "alpha_v", "u0", "v0")
    # A pose of each view's own takes up nearly all that a wrong focal length would do to its pixels.
    assert lens.left_out_px < 1.5 * 0.1 * np.sqrt(2)
    assert judge_lens(lens).word == "good"
    at = np.array([[300.0], [700.0]])
    prediction = lens.predict(at)
    true = 800 * np.exp(0.0009 * at[:, 0])
    assert (np.abs(prediction.local[:, 0] - true) < 4 * prediction.std[:, 0]).all()
    assert prediction.std[:, 0].max() < 0.004 * true.max()
    camera = camera_at(lens, at[0])
    assert camera.fixed == {"theta"}
    assert not camera.views
    evaluation = evaluate_lens(lens, LensPoints.grouped(points, {"zoom": np.array(zoom)}))
    assert evaluation.rmse_px < 1.1 * 0.1 * np.sqrt(2)
    assert np.isfinite(evaluation.baselines["spline_joint"])


@pytest.mark.parametrize(("views", "seed"), [((4, 4, 1, 4), 0), ((4, 4, 1, 4), 2), ((4, 1, 4, 4, 1, 4), 4)])
def test_a_setting_with_one_view_is_never_left_out(views: tuple[int, ...], seed: int) -> None:
    """One view of a flat board does not determine a camera, so the setting rests on the others."""
    points, centres = zooming(
        lambda z: [-0.12 + 0.2 * (z - 24) / 46, 0.0, 0.0, 0.0],
        views,
        seed,
    )
    lens = fit_lens(points, distortion="k1", skew=False, target="given", topologies=((0, 0),))
    assert not lens.rejected
    assert lens.converged
    assert lens.rmse_px < 1.05 * 0.09 * np.sqrt(2)
    assert lens.noise_floor_px < 1.1 * 0.09 * np.sqrt(2)
    prediction = lens.predict([[z] for z in centres])
    away = (prediction.local[:, 0] - [41.7 * z for z in centres]) / prediction.std[:, 0]
    assert np.abs(away).max() < 4


def test_a_setting_without_poses_is_named() -> None:
    """Its one view shows one row of the board, which no camera determines a pose from."""
    points, _ = zooming(lambda z: [-0.1, 0.0, 0.0, 0.0], (4, 4, 1, 4), 0)
    of_one = points.point_setting == 2
    row = ~of_one | (points.points.world[:, 1] == 0.0)
    few = LensPoints.grouped(points.points.select(row), {"zoom": points.columns["zoom"][row]})
    with pytest.raises(DegenerateGeometryError, match=r"at zoom 54\.66.*; or leave this setting out"):
        fit_lens(few, distortion="k1", skew=False, target="given", topologies=((0, 0),))


def zooming(
    k: Callable[[float], list[float]], views: Sequence[int] = (5,) * 12, seed: int = 5
) -> tuple[LensPoints, dict[float, float]]:
    """Some views of a board at each zoom, and the true u0; k1, k2, p1 and p2 follow the zoom."""
    rng = np.random.default_rng(seed)
    board = np.array([(60.0 * x, 60.0 * y, 0.0) for y in range(8) for x in range(11)])
    worlds, pixels, names, zoom, centres = [], [], [], [], {}
    for z in np.repeat(np.linspace(24.0, 70.0, len(views)), views).tolist():
        alpha, centres[z] = 41.7 * z, 750 + 6 * np.sin((z - 24) / 20)
        A = Intrinsics(alpha, alpha, centres[z], 500 - 4 * np.cos((z - 24) / 25))
        R = rotation_step(rng.uniform(-0.6, 0.6, (1, 3)))[0]
        depth = 0.44 * alpha * rng.uniform(1.2, 1.9)
        centre = np.append(depth / alpha * rng.uniform(-250, 250, 2), depth)
        camera = Camera(A, Distortion("k1k2p1p2", np.array(k(z))), (1500, 1000))
        seen_at, _ = camera.project((board - [300.0, 210.0, 0.0]) @ R.T + centre)
        worlds.append(board)
        pixels.append(seen_at + 0.09 * rng.normal(size=seen_at.shape))
        names += [f"view{len(worlds)}"] * len(board)
        zoom += [z] * len(board)
    points = Correspondences(np.concatenate(worlds), np.concatenate(pixels), names, (1500, 1000))
    return LensPoints.grouped(points, {"zoom": np.array(zoom)}), centres


@pytest.mark.slow
def test_decentring_that_lowers_the_error_by_little_is_chosen() -> None:
    """Each setting alone takes p1 and p2 for a shift of the centre, and the error grows by 1 % only."""
    points, centres = zooming(
        lambda z: [-0.2 + 0.002 * z, 0.05, 3e-4 * np.sin((z - 24) / 15), -4e-4 * np.cos((z - 24) / 18)]
    )
    lens = fit_lens(points, skew=False, target="given")
    assert lens.model == "k1k2p1p2"
    away = [
        (lens.predict([[z]]).local[0, 2] - u0) / camera_at(lens, [z]).std["u0"] for z, u0 in centres.items()
    ]
    assert np.sqrt(np.mean(np.square(away))) < 2.0


@pytest.mark.slow
def test_settings_that_a_richer_lens_fits_are_not_left_out() -> None:
    """Only the wide end needs k2."""
    lens = fit_lens(
        zooming(lambda z: [-0.1, 0.1 * np.exp((24 - z) / 2), 0.0, 0.0])[0], skew=False, target="given"
    )
    assert not lens.rejected


def board_view(alpha: float, u0: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    board = np.column_stack(
        [(np.stack(np.meshgrid(range(8), range(6)), -1).reshape(-1, 2) - [3.5, 2.5]) * 25, np.zeros(48)]
    )
    R = rotation_step(rng.uniform(-1, 1, 3) * [0.8, 0.8, 0.3])
    camera = board @ R.T + np.array([*rng.uniform(-10, 10, 2), 0.55 * alpha])
    return board, alpha * camera[:, :2] / camera[:, 2:] + np.array([u0, 240.0])


def test_known_cameras_are_followed_and_their_noise_is_told() -> None:
    rng = np.random.default_rng(18)
    zoom = np.linspace(20, 70, 30)
    alpha = 100 * zoom * (1 + 0.02 * rng.normal(size=30))
    table = {
        "zoom": zoom,
        "alpha_u": alpha,
        "alpha_v": alpha * 1.001,
        "u0": 640 + rng.normal(size=30),
        "v0": np.full(30, 480.0),
    }
    lens = fit_lens_cameras(LensCameras.of(table), topologies=((1, 0),))
    assert lens.known
    prediction = lens.predict(zoom[:, None])
    assert np.sqrt(np.mean((prediction.local[:, 0] / (100 * zoom) - 1) ** 2)) < 0.012
    camera = camera_at(lens, np.array([35.0]))
    assert abs(camera.intrinsics.alpha_u - 3500) < 4 * camera.std["alpha_u"]
    assert camera.intrinsics.v0 == pytest.approx(480, abs=1e-3)
    assert "theta" in camera.fixed


def known_cameras(count: int, seed: int) -> tuple[LensCameras, dict[str, np.ndarray], np.ndarray]:
    """Cameras with 0.2 % of noise in alpha and 1 px in u0 and v0, and the truth at nine zooms."""
    lens, rng = SimulatedZoom(pitch=0.006, image_size=(1280, 720), wander=8.0), np.random.default_rng(seed)
    zoom, checked = (np.column_stack([np.linspace(0, 3000, n), np.zeros(n)]) for n in (count, 9))
    table = {name: lens.parameters(zoom)[name] for name in ("alpha_u", "alpha_v", "u0", "v0")}
    table["alpha_u"], table["alpha_v"] = np.outer(
        [1, 0.998], table["alpha_u"] * (1 + 0.002 * rng.normal(size=count))
    )
    table |= {name: table[name] + rng.normal(size=count) for name in ("u0", "v0")}
    cameras = LensCameras.of({"zoom": zoom[:, 0], **table}, image_size=lens.image_size)
    return cameras, lens.parameters(checked), checked[:, :1]


def test_networks_through_all_known_cameras_do_not_make_them_exact() -> None:
    cameras, _, _ = known_cameras(5, 0)
    lens = fit_lens_cameras(cameras, topologies=((1, 0), (2, 0)))
    std = lens.predict(cameras.settings).std[:, :4] / [*2 * [0.002 * cameras.local[:, 0].min()], 1, 1]
    assert (std > 0.2).all()
    assert (np.median(std, axis=0) < 5).all()
    assert not lens.warnings


def test_given_distances_stay_and_their_errors_are_told() -> None:
    cameras, _, _ = known_cameras(12, 0)
    errors = 5 * np.random.default_rng(1).normal(size=12)
    t_z = 1500 - 0.02 * cameras.settings[:, 0] + errors
    with_t_z = replace(cameras, names=(*cameras.names, "t_z"), local=np.column_stack([cameras.local, t_z]))
    lens = fit_lens_cameras(with_t_z, topologies=((0, 0),))
    np.testing.assert_array_equal(with_t_z.local[:, 4], t_z)
    prediction = lens.predict(cameras.settings)
    away = prediction.local[:, 4] - (t_z - errors)
    assert np.sqrt(np.mean((away / prediction.std[:, 4]) ** 2)) < 2


def test_a_wrong_number_in_a_table_of_cameras_is_told() -> None:
    for name, row, factor, reason in (
        ("alpha_u", 2, 2.0, "the camera at zoom 1500 contradicts"),
        ("u0", 0, 10.0, "centre at zoom 0 lies outside the image"),
    ):
        cameras, _, _ = known_cameras(5, 1)
        local = cameras.local.copy()
        local[row, cameras.names.index(name)] *= factor
        verdict = judge_lens(fit_lens_cameras(replace(cameras, local=local), topologies=((0, 0),)))
        assert verdict.word == "poor"
        assert any(reason in text for text in verdict.reasons)


def test_three_cameras_do_not_tell_their_errors() -> None:
    lens = fit_lens_cameras(known_cameras(3, 1)[0], topologies=((0, 0),))
    assert "too few to tell their errors" in lens.warnings[0]


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 4, 5, 7, 12, 20])
def test_the_errors_of_known_cameras_are_told(count: int) -> None:
    errors, contradicted = [], 0
    for seed in range(200, 212):
        cameras, true, at = known_cameras(count, seed)
        lens = fit_lens_cameras(cameras)
        prediction = lens.predict(at)
        truth_there = np.column_stack([true[name] for name in cameras.names])
        errors.append((prediction.local - truth_there) / prediction.std[:, :4])
        contradicted += any("contradicts" in reason for reason in judge_lens(lens).reasons)
    over_std = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    assert (over_std < (1.3 if count < 12 else 1.7)).all()
    assert (over_std > (0.5 if count > 4 else 0.02)).all()
    assert contradicted <= 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"zoom": None}, "zoom or focus"),
        ({"u0": None}, "no column u0"),
        ({"alpha_u": np.array([1.0, -1, 2, 3, 4])}, "must be positive"),
        ({"zoom": np.full(5, 3.0)}, "one setting"),
        ({"v0": np.array([1.0, np.nan, 2, 3, 4])}, "finite"),
    ],
)
def test_known_cameras_that_cannot_be_used_are_refused(change: dict, message: str) -> None:
    table = {name: np.arange(1.0, 6) for name in ("zoom", "alpha_u", "alpha_v", "u0", "v0")}
    with pytest.raises(InputError, match=message):
        LensCameras.of(table | change)
    with pytest.raises(UsageError, match="seed must be"):
        fit_lens_cameras(LensCameras.of(table), seed=-1)


def test_points_that_cannot_be_used_are_refused() -> None:
    points = seen("c", grid(4, 3), seed=19, side=4)
    named = columns(points)
    with pytest.raises(InputError, match="no column zoom or focus"):
        LensPoints.grouped(points.points, {})
    with pytest.raises(InputError, match="finite"):
        LensPoints.grouped(
            points.points, {"zoom": np.where(np.arange(len(points.points)) == 5, np.nan, named["zoom"])}
        )
    with pytest.raises(InputError, match="two settings"):
        LensPoints.grouped(points.points, {"zoom": np.arange(float(len(points.points)))})
    with pytest.raises(InputError, match="one setting"):
        fit_lens(points.select(np.arange(12) == 3))
    with pytest.raises(InputError, match="too few"):
        fit_lens(points.select(np.isin(np.arange(12), [0, 1, 5])))
    for name in ("distortion", "training", "outliers", "camera"):
        with pytest.raises(UsageError, match=name):
            fit_lens(points, **{name: "other"})
    for topologies in (5, (2, 2), ((-1, 2),), ((2.5, 2),), ((1, 2), (3,))):
        with pytest.raises(UsageError, match="topologies must be pairs"):
            fit_lens(points, topologies=topologies)
    with pytest.raises(UsageError, match="seed must be"):
        fit_lens(points, seed=-1)
    with pytest.raises(NeurocalError, match="settings cannot be calibrated"):
        fit_lens(flat(points), distortion="none")


def flat(points: LensPoints) -> LensPoints:
    """Only the nearer of the two boards."""
    near = np.arange(len(points.points)) % 32 < 16
    return LensPoints.grouped(
        points.points.select(near), {name: c[near] for name, c in columns(points).items()}
    )


@pytest.mark.slow
def test_a_setting_with_few_points_rests_on_the_others() -> None:
    points = seen("c", grid(5, 3), seed=22, side=5)
    keep = (points.point_setting != 4) | (np.arange(len(points.points)) % 12 == 0)
    few = LensPoints.grouped(points.points.select(keep), {n: c[keep] for n, c in columns(points).items()})
    assert 3 <= (few.point_setting == 4).sum() <= 5
    lens = fit_lens(few, distortion="none", topologies=((0, 2),))
    assert any("depend on the others" in warning for warning in lens.warnings)
    assert lens.rmse[4] < 3 * FLOOR


@pytest.mark.slow
def test_a_camera_that_moved_is_told() -> None:
    points = seen("c", grid(4, 3), seed=20, side=4)
    world = points.points.world.copy()
    world += 40.0 * np.random.default_rng(0).normal(size=(12, 3))[points.point_setting]
    moved = LensPoints.grouped(replace(points.points, world=world), columns(points))
    try:
        lens = fit_lens(moved, distortion="none", topologies=((0, 2),))
    except NeurocalError:
        return
    assert judge_lens(lens).word == "poor"


def test_a_camera_that_moved_a_little_is_told() -> None:
    """With one view at each setting, `auto` takes the camera to be still."""
    points = seen("c", grid(5, 1), seed=20, side=5)
    steps = np.array([3.0, 0.0, 0.0]) * points.point_setting[:, None]
    moved = LensPoints.grouped(replace(points.points, world=points.points.world + steps), columns(points))
    lens = fit_lens(moved, distortion="none", topologies=FEW)
    assert lens.free_pose_px == pytest.approx(FLOOR, rel=0.05)
    assert lens.noise_floor_px > 1.3 * lens.free_pose_px
    verdict = judge_lens(lens)
    assert verdict.word != "good"
    assert any("moved between the settings" in reason for reason in verdict.reasons)
    assert any("--camera moving" in advice for advice in verdict.advice)
    assert smooth().free_pose_px == pytest.approx(smooth().noise_floor_px, rel=0.02)


def test_a_setting_in_another_unit_is_named() -> None:
    settings = np.column_stack([np.linspace(0, 3000, 9), np.zeros(9)])
    points = SimulatedZoom().points(settings, 4, 0.15, np.random.default_rng(21))
    zoom = columns(points)["zoom"]
    zoom[zoom == 1500] *= 1000
    with pytest.raises(DegenerateGeometryError, match=r"points: .* zoom 1500000 is far from the others"):
        fit_lens(LensPoints.grouped(points.points, {"zoom": zoom}), distortion="none", topologies=((0, 0),))


def test_interpolation_is_that_of_an_independent_library() -> None:
    rng = np.random.default_rng(21)
    z, f = np.sort(rng.uniform(-1, 1, 7)), np.sort(rng.uniform(-1, 1, 5))
    nodes = np.stack(np.meshgrid(z, f, indexing="ij"), -1).reshape(-1, 2)
    y = rng.normal(size=35)
    at = np.column_stack([rng.uniform(z[0], z[-1], 50), rng.uniform(f[0], f[-1], 50)])
    axes = grid_axes(nodes)
    assert axes is not None
    linear = RegularGridInterpolator((z, f), y.reshape(7, 5))(at)
    np.testing.assert_allclose(spline_matrix(axes, at, 1) @ y, linear, atol=1e-12)
    spline = RectBivariateSpline(z, f, y.reshape(7, 5), kx=3, ky=3).ev(*at.T)
    np.testing.assert_allclose(spline_matrix(axes, at, 3) @ y, spline, atol=1e-6 * np.abs(spline).max())
    assert grid_axes(nodes[1:]) is None
    powers = powers_up_to(nodes, 6)
    assert powers[:, 1].max() == 4  # five values tell no fifth power
    np.testing.assert_allclose(
        monomials(at, powers)[:, -1], at[:, 0] ** powers[-1, 0] * at[:, 1] ** powers[-1, 1]
    )


def test_the_simulated_zoom_obeys_its_law() -> None:
    lens = SimulatedZoom(k_wide=-0.2)
    p = lens.parameters(np.array([[0.0, 0.0], [3000.0, 0.0], [3000.0, 900.0]]))
    assert p["alpha_u"][0] == pytest.approx(9 / 0.012)
    assert p["alpha_u"][1] == pytest.approx(36 / 0.012)
    assert 1 / (p["alpha_u"][2] * 0.012) == pytest.approx(1 / 36 - 1 / 400)  # 1/f = 1/v + 1/d
    assert p["k1"].tolist() == [-0.2, 0.0, 0.0]
    points = lens.points(np.array([[0.0, 0.0], [3000.0, 900.0]]), 3, 0.0, np.random.default_rng(0))
    assert points.points.pixels.min() > 0
    assert (points.points.pixels < [640, 480]).all()


@dataclass
class Held:
    """Errors over the floor at the settings in between, by law."""

    networks: dict[str, float] = field(default_factory=dict)
    alone: dict[str, float] = field(default_factory=dict)
    alternating: dict[str, float] = field(default_factory=dict)
    baselines: dict[str, dict[str, float]] = field(default_factory=dict)
    cover: dict[str, float] = field(default_factory=dict)

    def take(self, law: str, bends: bool) -> None:
        """Fit a law five times; alternating once, beside the joint one of the same seed."""
        errors: dict[str, list[float]] = {}
        for seed in range(5):
            points = seen(law, grid(9, 5), seed, bends=bends)
            lens = fit_lens(points, distortion="k1" if bends else "none")
            held_out = seen(law, between(9, 5), 1000 + seed, bends=bends)
            x = lens.scaled(held_out.settings)
            errors.setdefault("networks", []).append(evaluate_lens(lens, held_out).rmse_px / FLOOR)
            errors.setdefault("alone", []).append(
                _rms(_squares(lens, held_out, one_at_a_time(lens, x), lens.static.constants)) / FLOOR
            )
            errors.setdefault("cover", []).append(covered(lens, law, between(9, 5)))
            for scale in {"log", lens.members[0].nets.scale}:
                for name, baseline in baselines_of(lens, scale).items():
                    error = _baseline_error(lens, held_out, *baseline(x), lens.tables.constants)
                    errors.setdefault(f"{name} {'log' if scale == 'log' else 'own'}", []).append(
                        error / FLOOR
                    )
        turns = fit_lens(points, distortion="k1" if bends else "none", training="alternating")
        self.alternating[law] = evaluate_lens(turns, held_out).rmse_px / FLOOR / errors["networks"][-1]
        mean = {name: float(np.mean(values)) for name, values in errors.items()}
        for into, name in ((self.networks, "networks"), (self.alone, "alone"), (self.cover, "cover")):
            into[law] = mean.pop(name)
        # On a logarithmic scale the networks' own is not another one.
        own = {name.replace("log", "own"): error for name, error in mean.items()}
        self.baselines[law] = own | mean


def one_at_a_time(lens: ZoomLens, x: np.ndarray) -> np.ndarray:
    """What networks say that learn one parameter at a time, from the static calibrations alone."""
    table, rng = lens.static, np.random.default_rng(0)
    settings = lens.scaled(lens.settings)
    members = fit_committee(
        settings, lens.names, table.local, table.normal.S, lens.variance, rng, Budget(), lambda share: None
    )
    return np.mean([nets.local(x) for nets in members], axis=0)


MOST = {"a": 1.04, "b": 1.01, "c": 1.01, "d": 1.02}  # what is reached, and a little for another machine


@pytest.mark.slow
@pytest.mark.parametrize("bends", [False, True], ids=["straight", "bends"])
def test_networks_beat_every_baseline_between_45_settings(bends: bool) -> None:
    """Means over five seeds at 32 settings; baselines on a logarithmic scale and on the networks' own."""
    held = Held()
    for law in MOST:
        held.take(law, bends)
    for law in MOST:
        assert held.networks[law] < MOST[law]
        assert held.networks[law] < held.alone[law]
        assert all(held.networks[law] <= error for error in held.baselines[law].values())
        assert held.alternating[law] == pytest.approx(1, abs=0.1)
        assert held.cover[law] > 0.9
    assert np.mean(list(held.cover.values())) < 0.99
    networks = np.mean(list(held.networks.values()))
    for name in held.baselines["a"]:
        assert networks < 0.8 * np.mean([held.baselines[law][name] for law in MOST])


@pytest.mark.slow
@pytest.mark.parametrize("law", ["a", "b", "c", "d", "e"])
def test_networks_are_not_behind_between_16_settings(law: str) -> None:
    """Means over two seeds."""
    errors = []
    for seed in (0, 1):
        lens = fit_lens(seen(law, grid(4, 4), seed), distortion="none")
        found = evaluate_lens(lens, seen(law, between(4, 4), 1000 + seed))
        errors.append(
            [found.rmse_px, *(found.baselines[f"{name}_joint"] for name in ("spline", "thin_plate"))]
        )
    networks, *others = np.mean(errors, axis=0)
    assert networks < 1.02 * min(others)


@pytest.mark.slow
def test_networks_beat_splines_where_tanh_of_zoom_and_focus_are_multiplied() -> None:
    lens = fit_lens(seen("e", grid(9, 5), seed=0), distortion="none")
    evaluation = evaluate_lens(lens, seen("e", between(9, 5), seed=1000))
    assert evaluation.rmse_px < 1.35 * FLOOR
    assert all(evaluation.rmse_px < error for error in evaluation.baselines.values())
    assert lens.left_out_px < 1.5 * FLOOR


@pytest.mark.slow
def test_a_real_lens_of_42_zooms_left_out_one_by_one(real_files: RealFiles) -> None:
    (table_file,) = real_files("zoom_sony24-70/sony_fe24-70gm_42settings.csv")
    data = np.genfromtxt(table_file, delimiter=",")
    names = ("zoom", "alpha_u", "alpha_v", "u0", "v0")
    errors = []
    for k in range(len(data)):
        rest = np.delete(data, k, axis=0)
        table = dict(zip(names, rest[:, :5].T, strict=True))
        lens = fit_lens_cameras(LensCameras.of(table))
        errors.append(lens.predict(data[k : k + 1, :1]).local[0, 0] - data[k, 1])
    error = np.sqrt(np.mean(np.square(errors)))
    assert error < 150  # px; a cubic 150, a line 158
    if error >= 147:  # a quadratic 147.1
        pytest.xfail("without one of the settings other networks are taken, 63 px farther off")

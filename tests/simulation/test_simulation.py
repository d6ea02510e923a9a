"""Simulated scenes, and what they tell of the methods: errors and the bound, random starts, rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.plain_projection import project
from support.scenes import random_flat_set, table_1

from neurocal_cli import Camera, Intrinsics, Pose, calibrate
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.calibration.other_methods.nonlinear import nonlinear
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.commands.boards import named_board
from neurocal_cli.commands.show.methods_report import (
    draw_rates,
    rates_report,
    simulation_report,
)
from neurocal_cli.commands.streams import for_json
from neurocal_cli.errors import InputError, NeurocalError
from neurocal_cli.observations.board import Board
from neurocal_cli.simulation.comparison import NoiseStudy, cramer_rao, study_noise
from neurocal_cli.simulation.scenes import (
    PAPER_BOARD,
    PAPER_CAMERA,
    PAPER_POSE,
    calibrated_scene,
    paper_scene,
    pictures,
    random_poses,
    scene_of,
    true_calibration,
    visible_points,
)
from neurocal_cli.simulation.starts import can_start, data_set, single_start, study_rates, study_starts

METHODS = ("neuro", "nonlinear", "linear", "tsai")
LENS = Camera(Intrinsics(700.0, 705.0, 320.0, 236.0), Distortion("k1", [-0.2]), (640, 480))
BOARD = Board.single(9, 6, 25.0)


@pytest.fixture(scope="module")
def study() -> NoiseStudy:
    return study_noise(paper_scene(), [0.2, 1.0], 16, METHODS, seed=1)


def test_the_papers_scene_is_that_of_table_1() -> None:
    scene, other = paper_scene(), table_1()
    assert len(scene.world) == 440
    pixels, depth = project(PAPER_CAMERA.A, PAPER_POSE, scene.world)
    assert scene.pixels == pytest.approx(pixels, abs=1e-10)
    assert depth.min() > 0
    assert sorted(map(tuple, scene.world.round(6))) == sorted(map(tuple, other.world.round(6)))
    assert ((scene.pixels > 0) & (scene.pixels < np.array([351, 239]))).all()


def test_without_noise_every_method_is_more_exact_than_the_papers_table(study: NoiseStudy) -> None:
    for one in study.methods.values():
        assert np.abs(one.exact).max() < 1e-8


def test_network_and_levenberg_marquardt_are_equal_and_at_the_bound(study: NoiseStudy) -> None:
    neuro = study.methods["neuro"]
    assert study.apart["neuro", "nonlinear"] < 1e-3
    ratio = neuro.rms / (study.sigma[:, None] * neuro.bound)
    assert ratio.max() < 1 + 3.5 / np.sqrt(2 * study.trials) + 0.05
    assert ratio.min() > 1 - 3.5 / np.sqrt(2 * study.trials)
    spread = np.sqrt(neuro.rms**2 - neuro.bias**2) / np.sqrt(study.trials)
    assert np.abs(neuro.bias / spread).max() < 4


def test_linear_is_the_least_robust(study: NoiseStudy) -> None:
    for name in ("alpha_v", "alpha_u", "t_z"):
        p = study.names.index(name)
        assert study.methods["linear"].rms[1, p] > 5 * study.methods["neuro"].rms[1, p]
        assert study.methods["linear"].rms[1, p] > 5 * study.methods["tsai"].rms[1, p]


def test_a_method_that_is_told_more_has_a_bound_of_its_own(study: NoiseStudy) -> None:
    tsai, neuro = study.methods["tsai"], study.methods["neuro"]
    given = [study.names.index(name) for name in ("u0", "v0", "theta")]
    assert (tsai.bound[given] == 0).all()
    assert (neuro.bound > 0).all()
    assert (tsai.bound <= neuro.bound * (1 + 1e-9)).all()
    assert (tsai.rms[:, given] == 0).all()


def test_the_bound_is_what_nearly_exact_points_report() -> None:
    scene = paper_scene()
    found = calibrate(scene.points(1e-5, np.random.default_rng(0)), distortion="none", outliers="keep")
    sigma = found.rmse_px * np.sqrt(440 / (880 - 11))
    std = [*found.std.values(), *found.views["view"].std.values()]
    assert np.array(std) / sigma == pytest.approx(cramer_rao(scene, "neuro"), rel=1e-3)


def test_the_number_of_processes_changes_nothing() -> None:
    one, two = (study_noise(paper_scene(), [0.5], 5, ("neuro", "linear"), seed=3, jobs=n) for n in (1, 2))
    for name in one.methods:
        assert np.array_equal(one.methods[name].rms, two.methods[name].rms)
    other = study_noise(paper_scene(), [0.5], 5, ("neuro",), seed=4)
    assert not np.array_equal(other.methods["neuro"].rms, one.methods["neuro"].rms)


def test_several_views_through_a_lens() -> None:
    poses = random_poses(LENS, BOARD, 5, np.random.default_rng(0))
    scene = scene_of(LENS, BOARD, poses)
    study = study_noise(scene, [0.1], 6, ("neuro", "nonlinear", "linear", "opencv"), seed=0)
    assert study.names == (
        "alpha_u",
        "alpha_v",
        "u0",
        "v0",
        "theta",
        "k1",
        "R_x",
        "R_y",
        "R_z",
        "t_x",
        "t_y",
        "t_z",
    )
    for name in ("neuro", "nonlinear"):
        one = study.methods[name]
        assert np.abs(one.exact).max() < 1e-6
        assert (one.rms[0] / (0.1 * one.bound)).max() < 2
    # It knows no distortion, and its errors are those of the lens.
    assert abs(study.methods["linear"].exact[0]) > 5


def test_random_poses_show_the_whole_board_from_its_front() -> None:
    for board in (BOARD, PAPER_BOARD):
        poses = random_poses(LENS, board, 8, np.random.default_rng(1))
        scene = scene_of(LENS, board, poses)
        assert ((scene.pixels >= 0) & (scene.pixels <= np.array([639, 479]))).all()
        normal = sum(plane.normal for plane in board.planes)
        assert all((pose.R @ normal)[2] > 0 for pose in poses.values())
    with pytest.raises(InputError, match="no image size"):
        random_poses(Camera(LENS.intrinsics), BOARD, 1, np.random.default_rng(1))
    with pytest.raises(InputError, match="cannot see all points"):
        scene_of(LENS, BOARD, {"behind": Pose(np.eye(3), np.array([0.0, 0.0, -500.0]))})


def test_a_calibration_is_simulated_with_its_own_points_and_poses() -> None:
    flat = random_flat_set(np.random.default_rng(2), 4, False)
    found = calibrate(flat.points(0.2, np.random.default_rng(3)), distortion="none", outliers="keep")
    scene = calibrated_scene(found)
    again = calibrate(scene.points(), distortion="none", outliers="keep")
    assert again.rmse_px < 1e-6
    assert again.intrinsics.values() == pytest.approx(found.intrinsics.values(), rel=1e-8)


def test_the_truth_as_a_calibration_has_no_error() -> None:
    truth = true_calibration(paper_scene())
    assert truth.fixed == {"alpha_u", "alpha_v", "u0", "v0", "theta"}
    found = calibrate(truth.points, type=3, intrinsics=truth, outliers="keep")
    assert found.rmse_px < 1e-9


@pytest.mark.slow
def test_single_starts_of_the_network_reach_the_minimum_and_plain_descent_often_does_not() -> None:
    pytest.importorskip("numba")
    study = study_starts(paper_scene(), 0.5, 6, seed=2)
    assert study.reached["lm"] == study.reached["backprop"] == 6
    assert study.reached["weights"] < 5
    assert study.reached["camera"] < 6


def test_a_start_of_plain_descent_that_is_right_ends_at_the_minimum_of_nonlinear() -> None:
    problem = problem_for(paper_scene().points(0.5, np.random.default_rng(1)), 1)
    rng = np.random.default_rng(5)
    ends = [single_start(problem, "camera", rng) for _ in range(12)]
    found = nonlinear(problem)
    assert found.minimised
    best = calibrate(problem.points, method="nonlinear").rmse_px
    assert min(ends) == pytest.approx(best, rel=1e-6)
    assert max(ends) > 1.01 * best


def test_a_flat_board_cannot_start_from_one_product() -> None:
    flat = random_flat_set(np.random.default_rng(2), 4, False)
    problem = flat.problem(flat.points(), 1)
    assert can_start(problem, "lm")
    assert not can_start(problem, "weights")
    type_4 = flat.problem(flat.points(), 4)
    assert single_start(type_4, "camera", np.random.default_rng(0)) == np.inf
    assert single_start(type_4, "lm", np.random.default_rng(0)) < 1e-6


def test_seventy_data_sets_vary() -> None:
    sets = [data_set(0, k) for k in range(70)]
    alpha = np.array([one.intrinsics.alpha_u / one.points.image_size[0] for one in sets])  # type: ignore[index]
    size = np.array([np.ptp(one.points.world, axis=0).max() for one in sets])
    assert alpha.max() / alpha.min() > 6
    assert size.max() / size.min() > 100


@pytest.mark.slow
def test_the_default_rates_converge_and_others_do_not() -> None:
    pytest.importorskip("numba")
    study = study_rates(12, seed=0, rates_weights=(0.05, 0.8), rates_gamma=(0.4,))
    assert study.default == (0.05, 0.4)
    assert study.converged.ravel().tolist() == [12, 0]
    assert study.calibrated == 12
    assert np.isnan(study.epochs[1, 0])
    pytest.importorskip("matplotlib")
    assert draw_rates(study, "svg").startswith(b"<?xml")
    report = rates_report(study)
    assert report.tables[0][1:] == [["0.05", "12"], ["0.8", "0"]]
    assert "12 of 12 data sets" in report.below[0]
    assert for_json(report.tree)["median_epochs"][1] == [None]


@pytest.mark.slow
def test_seventy_of_seventy_data_sets_converge_with_the_default_rates() -> None:
    study = study_rates(70, seed=0, rates_weights=(0.05,), rates_gamma=(0.4,))
    assert study.converged.ravel().tolist() == [70]
    assert study.calibrated == 70
    assert np.sqrt((study.alpha_u**2).mean()) == pytest.approx(1.0, abs=3.5 / np.sqrt(140))


def test_pictures_show_the_points_where_the_truth_says() -> None:
    from neurocal_cli import detect_points

    scene = paper_scene()
    drawn = list(pictures(scene))
    seen = visible_points(scene, drawn)
    assert 0 < len(seen) <= 440
    found = detect_points(drawn[0].image, PAPER_BOARD)
    place = {id_: k for k, id_ in enumerate(found.ids)}
    exact: dict[str, Array] = dict(zip(seen.point, seen.pixels, strict=True))  # type: ignore[arg-type]
    common = [id_ for id_ in exact if id_ in place]
    assert len(common) > 400
    off = np.array([found.pixels[place[id_]] - exact[id_] for id_ in common])
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05
    with pytest.raises(InputError, match="no board to render"):
        list(pictures(replace(scene, board=None)))


def test_pictures_show_the_circles_where_the_truth_says() -> None:
    from neurocal_cli import detect_points

    board = named_board("circles:7x5:20")
    scene = scene_of(PAPER_CAMERA, board, random_poses(PAPER_CAMERA, board, 1, np.random.default_rng(0)))
    drawn = list(pictures(scene))
    seen = visible_points(scene, drawn)
    assert len(seen) == 35
    found = detect_points(drawn[0].image, board)
    place = {id_: k for k, id_ in enumerate(found.ids)}
    assert seen.point is not None
    off = found.pixels[[place[id_] for id_ in seen.point]] - seen.pixels
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.1


def test_a_method_without_an_answer_is_counted() -> None:
    """A single flat view: no method can."""
    scene = scene_of(PAPER_CAMERA, BOARD, random_poses(PAPER_CAMERA, BOARD, 1, np.random.default_rng(0)))
    with pytest.raises(NeurocalError):
        calibrate(scene.points())
    study = study_noise(scene, [0.2], 3, ("linear",), seed=0)
    assert study.methods["linear"].failed.tolist() == [3]
    assert np.isnan(study.methods["linear"].rms).all()
    assert np.isnan(cramer_rao(scene, "linear")).all()
    assert np.isfinite(cramer_rao(scene, "tsai")).all()
    report = simulation_report(scene, 0, study, None, False)
    assert "nan" not in report.text()
    assert for_json(report.tree)["methods"]["linear"]["rms"]["t_x"] == [None]
    with pytest.raises(NeurocalError, match="one view of one plane"):
        study_starts(scene, 0.5, 2)

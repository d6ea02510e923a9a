"""Lenses from the images of straight lines alone, then the camera."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import run
from support.distorted import through
from support.real_data import RealFiles
from support.scenes import Scene, board_midpoints, random_flat_set, random_rotation, table_1
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Correspondences, calibrate, evaluate_camera, read_calibration
from neurocal_cli.adjustment.views import noise_model
from neurocal_cli.calibration.lens_choice.plumb_line import PlumbLine, fit_plumb_line, lines_in_pixels
from neurocal_cli.calibration.lens_choice.straight_lines import (
    FEWEST_ON_LINE,
    CollinearPoints,
    distorted_lines,
    find_lines,
)
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError, NeurocalError, UsageError
from neurocal_cli.files.points_csv import write_points
from neurocal_cli.files.result_files import write_calibration
from neurocal_cli.observations.board import Board

SIZE = (1000, 800)


def lens_scene(k: list[float], centre: tuple[float, float] = (499.5, 399.5), views: int = 12) -> Scene:
    """Views of a large board through a lens about a principal point of choice, noise-free."""
    flat = random_flat_set(np.random.default_rng(7), views, False, cols=11, rows=8, f=900, width=1000)
    camera = Intrinsics(900.0, 905.0, *centre)
    straight = np.column_stack([flat.pixels, np.ones(len(flat.pixels))]) @ np.linalg.inv(flat.intrinsics.A).T
    pinhole = replace(flat, intrinsics=camera, pixels=straight @ camera.A.T[:, :2])
    return replace(pinhole, pixels=through(pinhole, "k1k2p1p2", [*k, 0.0, 0.0][:4]).pixels, image_size=SIZE)


def seen_once(world: Array) -> Correspondences:
    return Correspondences(world, world[:, :2])


def as_sets(lines: CollinearPoints) -> set[frozenset[int]]:
    return {frozenset(part.tolist()) for part in np.split(lines.row, lines.first[1:])}


# Finding lines


@given(st.integers(0, 2**32 - 1), st.integers(4, 9), st.integers(4, 7))
@settings(max_examples=25, deadline=None)
def test_rows_and_columns_of_a_board_are_found_wherever_it_lies(seed: int, cols: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2)
    size = 10 ** rng.uniform(-1, 3)
    world = size * np.column_stack([grid, np.zeros(len(grid))]) @ random_rotation(rng) + 3 * size
    order = rng.permutation(len(world))
    place = np.argsort(order).reshape(rows, cols)
    found = as_sets(find_lines(seen_once(world[order])))
    assert {frozenset(line.tolist()) for line in [*place, *place.T]} <= found


@pytest.mark.parametrize("n", [20, 60])
def test_all_lines_that_are_found_are_lines(n: int) -> None:
    """Of a large target those through some of its points are found, of a small one all."""
    rng = np.random.default_rng(n)
    grid = 3.0 * board_midpoints(n, n)
    world = np.column_stack([grid, np.zeros(len(grid))]) @ random_rotation(rng)
    points = seen_once(world[rng.random(len(world)) < 0.9])
    lines = find_lines(points)
    assert (lines.counts >= FEWEST_ON_LINE).all()
    assert len(lines) > 3 * n
    for rows in np.split(lines.row, lines.first[1:]):
        assert len(set(rows.tolist())) == len(rows)
        assert np.linalg.svd(np.diff(points.world[rows], axis=0))[1][1] < 1e-9 * n


def test_lines_of_each_view_are_of_that_view() -> None:
    scene = random_flat_set(np.random.default_rng(1), 5, False, cols=6, rows=5)
    points = scene.points()
    points = points.select(np.random.default_rng(2).permutation(len(points))[: len(points) // 2])
    lines = find_lines(points)
    for rows in np.split(lines.row, lines.first[1:]):
        assert len(set(points.view_index[rows])) == 1


def test_a_folded_target_has_the_lines_of_its_boards() -> None:
    points = table_1().points()
    on_wall = points.world[:, 2] == 0
    sides = [set(on_wall[list(rows)]) for rows in as_sets(find_lines(points))]
    assert sides.count({True}) >= 4 * 11
    assert sides.count({False}) >= 4 * 11


def test_scattered_points_have_no_lines() -> None:
    world = np.random.default_rng(0).normal(size=(300, 3))
    assert len(find_lines(seen_once(world))) == 0
    with pytest.raises(DegenerateGeometryError, match=r"\(none\); give more points"):
        calibrate(seen_once(world), distortion="plumb-line")


def test_the_same_point_seen_often_is_no_line() -> None:
    assert len(find_lines(seen_once(np.ones((40, 3))))) == 0


@pytest.mark.slow
def test_of_very_many_lines_some_do() -> None:
    grid = np.stack(np.meshgrid(np.arange(300.0), np.arange(200.0)), -1).reshape(-1, 2)
    lines = find_lines(seen_once(np.column_stack([grid, np.zeros(len(grid))])))
    assert len(lines) > 100
    assert len(lines.row) <= 250_000


# Straightness


def test_derivatives_are_those_of_differences() -> None:
    """Of errors that are smallest over lines and feet, before and after each change."""
    points = lens_scene([-0.2, 0.1], views=3).points(0.3, np.random.default_rng(1))
    weights = np.column_stack(
        [np.linspace(0.5, 2, len(points)), np.full(len(points), 0.2), np.ones(len(points))]
    )
    whitening = noise_model(weights)[1]
    seen = lines_in_pixels(points, find_lines(points), np.array([480, 390]), 900.0, whitening)
    entries, k = np.array([1.0, 0.02, 0.98, 0.03, -0.02]), np.array([-0.21, 0.08, 0.01, -0.02])
    curves = distorted_lines(seen, entries, Distortion("k1k2p1p2", k))
    r, J, nu = curves.derivatives()
    assert np.hypot(*nu.T) == pytest.approx(1.0)
    for column in range(9):
        step = np.zeros(9)
        step[column] = 1e-5
        plus, minus = (
            curves.with_camera(entries + sign * step[:5], k + sign * step[5:]).fitted().errors()
            for sign in (1, -1)
        )
        # At errors that are not 0 the projection itself turns, which is of the errors' size.
        assert (minus - plus) / 2e-5 == pytest.approx(J[:, column], abs=20 * np.abs(r).max())
        assert ((minus - plus) / 2e-5) @ r == pytest.approx(J[:, column] @ r, abs=1e-7)


def test_distorted_lines_have_no_error() -> None:
    scene = lens_scene([-0.2, 0.1])
    lines = find_lines(scene.points())
    a, _, b, u0, v0 = (*scene.intrinsics.A[0, :2], scene.intrinsics.A[1, 1], *scene.intrinsics.A[:2, 2])
    seen = lines_in_pixels(scene.points(), lines, np.zeros(2), 1.0)
    curves = distorted_lines(seen, np.array([a, 0, b, u0, v0]), Distortion("k1k2", [-0.2, 0.1]))
    assert curves.valid
    assert np.abs(curves.errors()).max() < 1e-9


# The distortion from lines alone


@pytest.mark.parametrize(
    ("k", "centre"),
    slow_but(
        [([-0.4, 0.2], (535.0, 370.0)), ([0.3, -0.1], (450.0, 450.0))],
        itertools.product(
            ([-0.4, 0.2], [-0.2, 0.0], [0.3, -0.1]), ((499.5, 399.5), (535.0, 370.0), (450.0, 450.0))
        ),
    ),
)
def test_lines_tell_centre_and_lens_without_a_camera(k: list[float], centre: tuple[float, float]) -> None:
    scene = lens_scene(k, centre)
    scene = replace(scene, intrinsics=replace(scene.intrinsics, alpha_v=900.0))
    square = replace(scene, pixels=(scene.pixels - centre) * [1, 900 / 905] + centre)
    found = fit_plumb_line(square.points())
    assert found.centre == pytest.approx(centre, abs=1e-3)
    share = 900.0 / found.scale
    assert found.distortion.coefficients * [share**2, share**4] == pytest.approx(k, abs=1e-5)
    assert found.rms < 1e-6 < 0.5 < found.rms_before


def test_corrected_points_lie_on_lines() -> None:
    points = lens_scene([-0.3, 0.1], (530.0, 380.0)).points()
    corrected = fit_plumb_line(points).corrected(points)
    assert fit_plumb_line(corrected).rms_before < 0.02
    assert fit_plumb_line(points).rms_before > 1.0


def test_without_a_lens_the_centre_stays_in_the_middle() -> None:
    found = fit_plumb_line(lens_scene([0.0, 0.0]).points(0.2, np.random.default_rng(3)))
    assert np.abs(found.centre - [499.5, 399.5]).max() < 500
    assert np.abs(found.distortion.coefficients[0]) < 0.01


def monte_carlo_of_the_centre(trials: int) -> tuple[Array, Array]:
    scene = lens_scene([-0.25, 0.1], (530.0, 370.0), views=6)
    found = [fit_plumb_line(scene.points(0.2, np.random.default_rng(s))).centre for s in range(trials)]
    return np.array(found) - [530.0, 370.0], np.array([530.0, 370.0])


@pytest.mark.parametrize("trials", slow_but((16,), (16, 100)))
def test_the_centre_is_not_biased(trials: int) -> None:
    errors, _ = monte_carlo_of_the_centre(trials)
    assert np.abs(errors.mean(axis=0) / errors.std(axis=0)).max() < 3.5 / np.sqrt(trials)


# Lens and camera


@pytest.mark.parametrize(
    ("type", "k"),
    slow_but(
        [(1, [-0.3, 0.1]), (4, [0.0, 0.0])],
        itertools.product((1, 2, 4), ([-0.3, 0.1], [0.2, -0.05], [0.0, 0.0])),
    ),
)
def test_a_folded_target_without_noise_gives_lens_and_camera(type: int, k: list[float]) -> None:
    scene = table_1()
    points = Correspondences(scene.world, through(scene, "k1k2", k).pixels, scene.view, scene.image_size)
    found = calibrate(points, distortion="plumb-line", **scene.given(type))
    assert found.converged
    assert found.rmse_px < 1e-9
    assert found.distortion == pytest.approx([*k, 0.0, 0.0], abs=1e-8)
    assert found.intrinsics.values() == pytest.approx(scene.intrinsics.values(), rel=1e-7)
    if type != 4:
        assert found.views["view"].pose.t == pytest.approx(scene.poses["view"].t, abs=1e-5)


WIDE = [[-0.35, 0.12], [-0.35, 0.08], [-0.5, 0.2], [-0.246, 0.036], [0.3, 0.0]]


@pytest.mark.parametrize(("k", "widest"), slow_but([(WIDE[2], 0.6)], itertools.product(WIDE, (0.6, 1.3))))
def test_wide_lenses_come_close_to_the_joint_fit(k: list[float], widest: float) -> None:
    flat = random_flat_set(np.random.default_rng(7), 14, False, cols=13, rows=10, f=400, width=1000)
    straight = np.column_stack([flat.pixels, np.ones(len(flat.pixels))]) @ np.linalg.inv(flat.intrinsics.A).T
    near = np.hypot(straight[:, 0], straight[:, 1]) < widest
    noise = 0.2 * np.random.default_rng(0).normal(size=flat.pixels.shape)
    points = Correspondences(flat.world, through(flat, "k1k2", k).pixels + noise, flat.view).select(near)
    found = calibrate(points, distortion="plumb-line")
    assert found.converged
    assert found.rmse_px < 1.02 * calibrate(points, distortion="k1k2p1p2").rmse_px


@pytest.mark.parametrize("skew", [True, False])
def test_flat_views_without_noise_give_lens_and_camera(skew: bool) -> None:
    scene = lens_scene([-0.28, 0.12, 1e-3, -8e-4], (530.0, 420.0))
    found = calibrate(scene.points(), distortion="plumb-line", skew=skew)
    assert found.distortion == pytest.approx([-0.28, 0.12, 1e-3, -8e-4], abs=1e-8)
    assert found.intrinsics.values() == pytest.approx(scene.intrinsics.values(), rel=1e-7)
    assert found.distortion_model == "k1k2p1p2"
    assert ("theta" in found.fixed) == (not skew)
    assert found.straight_lines is not None
    assert found.straight_lines.n_points == len(scene.world)


def test_the_paper_s_own_rule_trains_on_the_corrected_points() -> None:
    scene = lens_scene([-0.25, 0.1], views=4)
    points = scene.points(0.2, np.random.default_rng(0))
    by_lm = calibrate(points, distortion="plumb-line")
    by_rule = calibrate(points, distortion="plumb-line", trainer="backprop")
    assert by_rule.distortion == pytest.approx(by_lm.distortion, abs=1e-6)


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=4, deadline=None)
def test_the_order_of_the_rows_does_not_matter(seed: int) -> None:
    points = lens_scene([-0.2, 0.05], views=4).points(0.3, np.random.default_rng(1))
    stated = np.random.default_rng(2).uniform([0.04, -0.02, 0.04], [0.2, 0.02, 0.2], (len(points), 3))
    points = replace(points, covariance=stated)
    shuffled = points.select(np.random.default_rng(seed).permutation(len(points)))
    a, b = (calibrate(p, distortion="plumb-line") for p in (points, shuffled))
    assert b.distortion == pytest.approx(a.distortion, abs=1e-7)
    assert pytest.approx(a.K, abs=1e-5) == b.K
    assert [b.std[name] for name in a.std] == pytest.approx(list(a.std.values()), rel=1e-4)


def test_covariances_of_the_pixels_count() -> None:
    """Points with ten times the noise that say so hardly hurt."""
    scene, rng = lens_scene([-0.25, 0.1]), np.random.default_rng(5)
    noisy = rng.random(len(scene.world)) < 0.3
    sigma = np.where(noisy, 2.0, 0.2)
    points = scene.points()
    points = replace(points, pixels=points.pixels + sigma[:, None] * rng.normal(size=points.pixels.shape))
    told = replace(points, covariance=np.column_stack([sigma**2, 0 * sigma, sigma**2]))
    told_std, untold_std = (
        calibrate(p, distortion="plumb-line", outliers="keep").std["k1"] for p in (told, points)
    )
    assert told_std < 0.3 * untold_std


def errors_and_stds(k: list[float], centre: tuple[float, float], trials: int) -> tuple[Array, Array]:
    scene = lens_scene(k, centre, views=8)
    names = ("alpha_u", "alpha_v", "u0", "v0", "k1", "k2", "p1", "p2")
    truth = np.array([*scene.intrinsics.values()[:4], *k, *[0.0] * (4 - len(k))])
    pose_truth = scene.poses["view0000"].t
    errors, stds = [], []
    for trial in range(trials):
        points = scene.points(0.3, np.random.default_rng(1000 + trial))
        found = calibrate(points, distortion="plumb-line", skew=False, seed=trial)
        assert found.converged
        view = found.views["view0000"]
        errors.append(
            [*np.r_[found.intrinsics.values()[:4], found.distortion] - truth, *view.pose.t - pose_truth]
        )
        stds.append([*[found.std[name] for name in names], *[view.std[n] for n in ("t_x", "t_y", "t_z")]])
    return np.array(errors), np.array(stds)


def check_statistics(k: list[float], centre: tuple[float, float], trials: int, extra: float) -> None:
    errors, stds = errors_and_stds(k, centre, trials)
    ratio = np.sqrt((errors**2).mean(axis=0) / (stds**2).mean(axis=0))
    # The relative standard error of an rms over n trials is 1 / sqrt(2 n), that of a mean 1 / sqrt(n).
    assert np.abs(ratio - 1).max() < extra + 3.5 / np.sqrt(2 * trials)
    assert np.abs(errors.mean(axis=0) / errors.std(axis=0)).max() < 3.5 / np.sqrt(trials)


@pytest.mark.slow
def test_std_is_true_and_nothing_biased() -> None:
    check_statistics([-0.25, 0.1], (530.0, 370.0), 20, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("centre", [(499.5, 399.5), (540.0, 360.0)])
@pytest.mark.parametrize(
    "k", [[-0.4, 0.2], [-0.3, 0.1, 1e-3, -2e-3], [-0.1, 0.0], [0.0, 0.0], [0.15, -0.05], [0.3, -0.1]]
)
def test_std_is_true_and_nothing_biased_for_many_lenses(k: list[float], centre: tuple[float, float]) -> None:
    check_statistics(k, centre, 400, 0.1 - 1.75 / np.sqrt(2 * 400))


@pytest.mark.parametrize("flat", slow_but((True,), (True, False)))
def test_wrong_points_are_set_aside_before_lines_tell_the_lens(flat: bool) -> None:
    rng = np.random.default_rng(3)
    scene = lens_scene([-0.25, 0.1], views=6) if flat else table_1()
    good = scene.points(0.2, rng)
    if not flat:
        good = replace(good, pixels=good.pixels + through(scene, "k1k2", [-0.25, 0.1]).pixels - scene.pixels)
    wrong = rng.choice(len(good), 4, replace=False)
    pixels = good.pixels.copy()
    pixels[wrong] += [[60.0, 20], [-30, 40], [15, -25], [0, 80]]
    found = calibrate(replace(good, pixels=pixels), distortion="plumb-line")
    kept = np.setdiff1d(np.arange(len(good)), wrong)
    clean = calibrate(good.select(kept), distortion="plumb-line", outliers="keep")
    assert found.n_rejected == 4
    assert found.distortion == pytest.approx(clean.distortion, abs=1e-9)


# Real data


def check_beside_joint(points: Correspondences, most: float) -> Calibration:
    found = calibrate(points, distortion="plumb-line")
    joint = calibrate(points, distortion="plumb_bob", target="given")
    assert found.converged
    assert found.rmse_px < most * joint.rmse_px
    return found


Detected = Callable[[str, int, int, float], Correspondences]


@pytest.fixture(scope="module")
def detected(real_files: RealFiles) -> Detected:
    """Points of the boards in real pictures: the pictures, columns, rows and the squares' side."""

    @cache
    def points(pattern: str, cols: int, rows: int, square: float) -> Correspondences:
        from neurocal_cli.detection.batch import DetectionOptions, detect_files

        board = Board.single(cols, rows, square)
        paths = [str(path) for path in real_files(pattern)]
        outcomes = detect_files(paths, DetectionOptions(board, "midpoints", None, False, True), 1)
        found = {f"v{n}": o.detection for n, o in enumerate(outcomes) if o.detection is not None}
        return Correspondences.from_detections(found, board.unit)

    return points


def test_zhangs_views_are_nearly_as_good_as_with_a_joint_fit(zhang: Correspondences) -> None:
    found = check_beside_joint(zhang, 1.02)
    assert found.distortion[:2] == pytest.approx([-0.2286, 0.1904], abs=0.01)
    assert found.intrinsics.alpha_u == pytest.approx(832.5, abs=5)


@pytest.mark.parametrize(
    ("pattern", "cols", "rows", "square"),
    [
        ("opencv_stereo/left0[1-5].jpg", 9, 6, 25.0),
        pytest.param("opencv_stereo/left[0-9]*.jpg", 9, 6, 25.0, marks=pytest.mark.slow),
        pytest.param("opencv_stereo/right[0-9]*.jpg", 9, 6, 25.0, marks=pytest.mark.slow),
        pytest.param("sony_chess/frame*.jpg", 4, 6, 30.0, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("weighted", slow_but((True,), (True, False)))
def test_photographs_are_nearly_as_good_as_with_a_joint_fit(
    detected: Detected, pattern: str, cols: int, rows: int, square: float, weighted: bool
) -> None:
    points = detected(pattern, cols, rows, square)
    check_beside_joint(points if weighted else replace(points, covariance=None), 1.15)


@pytest.mark.slow
def test_a_photograph_of_one_large_board_becomes_straight(detected: Detected) -> None:
    found = fit_plumb_line(detected("line_pattern/chessboard.jpg", 36, 25, 1.0))
    assert found.rms_before > 1.5
    assert found.rms < 0.42


# What is refused


def test_a_single_line_is_refused() -> None:
    x = np.arange(10.0)
    points = seen_once(np.column_stack([x, 0 * x, 0 * x]))
    with pytest.raises(DegenerateGeometryError, match=r"\(1\); give more points"):
        fit_plumb_line(points)


def test_lines_through_the_centre_only_are_refused() -> None:
    """A radial lens does not bend them."""
    spokes = [r * np.array([np.cos(a), np.sin(a), 0.0]) for a in np.linspace(0, 3, 7) for r in range(1, 8)]
    world = np.array(spokes)
    points = Correspondences(world, 50 * world[:, :2] + [500, 400], image_size=SIZE)
    with pytest.raises(DegenerateGeometryError, match="do not determine the distortion"):
        fit_plumb_line(points, np.array([500.0, 400.0]))


def test_points_all_at_one_pixel_are_refused() -> None:
    points = table_1().points()
    with pytest.raises(DegenerateGeometryError, match="seen at one pixel"):
        fit_plumb_line(replace(points, pixels=np.full((440, 2), 7.0)))


def test_a_point_that_the_lens_cannot_have_seen_is_named() -> None:
    points = lens_scene([-0.3, -0.1]).points()
    lens = fit_plumb_line(points)
    far = replace(points, pixels=np.where(np.arange(len(points))[:, None] == 3, 4000.0, points.pixels))
    with pytest.raises(
        DegenerateGeometryError, match=r"points, row 4: .* maps nothing to the pixel \(4000, 4000\)"
    ):
        lens.corrected(far)


def test_type_3_has_its_lens() -> None:
    scene = table_1()
    with pytest.raises(UsageError, match="uses the distortion of the given camera"):
        calibrate(scene.points(), distortion="plumb-line", **scene.given(3))


@pytest.mark.parametrize("seed", slow_but((0,), range(4)))
def test_nonsense_is_refused_or_warned_of(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = table_1().points() if seed % 2 else lens_scene([-0.2, 0.1], views=3).points()
    wrong = replace(
        points, pixels=points.pixels[rng.permutation(len(points))] + rng.normal(size=(len(points), 2))
    )
    try:
        found = calibrate(wrong, distortion="plumb-line")
    except NeurocalError:
        return
    assert any("fits its points only to" in text for text in found.warnings)


# Files and the command line


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    write_points(lens_scene([-0.25, 0.1], views=4).points(0.1, np.random.default_rng(0)), tmp_path / "p.csv")
    return tmp_path / "p.csv"


def test_the_command_writes_a_lens_that_evaluates_as_reported(csv: Path) -> None:
    camera = csv.with_name("camera.yaml")
    result = run("calibrate", csv, "--distortion", "plumb-line", "-o", camera)
    assert (result.exit_code, result.stdout) == (0, "")
    assert "straight lines: " in result.stderr
    assert "px before undistortion" in result.stderr
    found = read_calibration(camera)
    assert found.distortion_model == "k1k2p1p2"
    assert set(found.std) >= {"k1", "k2", "p1", "p2"}
    assert evaluate_camera(found).rmse_px == pytest.approx(found.rmse_px, rel=1e-9)
    text = camera.read_text()
    assert "\ndistortion_model: plumb_bob\n" in text
    assert "\n  straight_lines: {n_lines: " in text


def test_the_record_of_the_lines_reads_back(tmp_path: Path) -> None:
    points = lens_scene([-0.25, 0.1], views=4).points(0.1, np.random.default_rng(0))
    found = calibrate(points, distortion="plumb-line")
    write_calibration(found, tmp_path / "camera.yaml")
    assert read_calibration(tmp_path / "camera.yaml").straight_lines == found.straight_lines


def test_the_same_bytes_again(csv: Path) -> None:
    first, second = (run("calibrate", csv, "--distortion", "plumb-line").stdout for _ in range(2))
    assert first == second != ""


def test_what_has_no_lines_is_one_line_and_exit_status_1(tmp_path: Path) -> None:
    world = np.random.default_rng(0).normal(size=(20, 3))
    write_points(seen_once(world), tmp_path / "p.csv")
    result = run("calibrate", tmp_path / "p.csv", "--distortion", "plumb-line", "-o", tmp_path / "c.yaml")
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: {tmp_path}/p.csv: plumb-line finds too few straight lines")
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "c.yaml").exists()


def test_calibrating_loads_no_image_library(csv: Path) -> None:
    code = (
        "import sys; from neurocal_cli.commands import neurocal; "
        "neurocal(sys.argv[1:], standalone_mode=False); print(*sys.modules, file=sys.stderr)"
    )
    words = [sys.executable, "-c", code, "calibrate", str(csv), "--distortion", "plumb-line"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert {"cv2", "scipy", "matplotlib"}.isdisjoint(done.stderr.split())


def test_a_known_plumb_line_is_a_value() -> None:
    points = lens_scene([-0.25, 0.1], views=3).points()
    found = fit_plumb_line(points)
    assert isinstance(found, PlumbLine)
    assert found.record.n_lines == len(found.lines)

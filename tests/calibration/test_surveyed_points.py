"""Points whose standard deviations a survey states: found with the camera, and counted in what it reports."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run, succeed
from support.real_data import RealFiles
from support.slow_cases import slow_but
from support.surveyed import K, surveyed
from support.verdicts import verdict_on

from neurocal_cli import calibrate, read_calibration, read_points
from neurocal_cli.adjustment.board import system as system_module
from neurocal_cli.adjustment.board.find import sight_of
from neurocal_cli.adjustment.board.information import Information, information_of
from neurocal_cli.adjustment.board.posterior import known_sizes
from neurocal_cli.adjustment.board.prior import Prior, surveyed_prior
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.calibration.fit import fit
from neurocal_cli.calibration.rig.calibrate_rig import calibrate_stereo
from neurocal_cli.camera.geometry import rotation_step
from neurocal_cli.errors import InputError
from neurocal_cli.files.points_csv import write_points
from neurocal_cli.network.options import options_for
from neurocal_cli.observations.target import distinct_points

OPTIONS = {"distortion": "none", "skew": False}


def system(n_views: int) -> tuple[Information, Prior]:
    points, _, _ = surveyed(0, n=20, n_views=n_views)
    solution = fit(problem_for(points, 1, skew=False), options_for("lm", 20, 0))
    given, label, _ = distinct_points([points])
    assert points.world_std is not None
    stated = np.zeros_like(given)
    stated[label] = points.world_std
    return information_of([sight_of(solution.problem, solution.adjusted, label)], 20), surveyed_prior(
        given, stated
    )


def test_the_covariances_are_those_of_the_whole_dense_system(monkeypatch: pytest.MonkeyPatch) -> None:
    info, prior = system(3)
    f, P, n = len(info.cameras.shared) - 1, len(info.cameras.own), len(info.point)
    H = np.zeros((f + 6 * P + 3 * n,) * 2)
    c, q, d = slice(0, f), slice(f, f + 6 * P), slice(f + 6 * P, None)
    H[c, c] = info.cameras.shared[:-1, :-1]
    H[q, c] = info.cameras.cross[:, :, :-1].reshape(-1, f)
    H[d, c] = info.by_camera[..., :-1].reshape(-1, f)
    H[d, q] = info.pose_point.reshape(6 * P, 3 * n).T
    for k in range(P):
        H[f + 6 * k : f + 6 * k + 6, f + 6 * k : f + 6 * k + 6] = info.cameras.own[k]
    for k in range(n):
        at = slice(f + 6 * P + 3 * k, f + 6 * P + 3 * k + 3)
        H[at, at] = info.point[k] + 0.09 * np.diag((2 * prior.stated[k]) ** -2)
    inverse = np.linalg.inv(np.tril(H) + np.tril(H, -1).T)

    for points_first in (True, False):
        monkeypatch.setattr(system_module, "points_first", lambda *_, first=points_first: first)
        found = known_sizes(info, prior, {"stated": 2.0}, 0.09)
        np.testing.assert_allclose(found.camera, inverse[c, c], rtol=1e-6)
        np.testing.assert_allclose(found.std.ravel(), 0.3 * np.sqrt(np.diagonal(inverse)[d]), rtol=1e-6)
        for k in range(P):
            at = slice(f + 6 * k, f + 6 * k + 6)
            np.testing.assert_allclose(found.poses[k], inverse[at, at], rtol=1e-5, atol=1e-12)


def test_stated_standard_deviations_make_camera_and_points_better() -> None:
    points, _, true = surveyed(1)
    found, given = calibrate(points, **OPTIONS), calibrate(points, **OPTIONS, target="given")
    assert found.target is not None
    place = found.target.places(points.world[:60])
    assert np.square(found.target.found[place] - true).sum() < 0.5 * np.square(points.world[:60] - true).sum()
    assert abs(found.K[0, 0] - K[0, 0]) < 4 * found.std["alpha_u"] < 0.6 * 4 * given.std["alpha_u"]
    assert found.target.sizes["stated"] == 1
    assert any("sX,sY,sZ are not used" in text for text in given.warnings)
    assert not any("sX" in text for text in found.warnings)


def test_points_without_a_standard_deviation_are_held() -> None:
    points, _, _ = surveyed(2)
    std = np.array(points.world_std)
    held = np.tile(np.arange(60) < 20, 4)
    std[held] = 0
    found = calibrate(replace(points, world_std=std), **OPTIONS, outliers="keep")
    assert found.target is not None
    moved = np.abs(found.target.offsets).max(axis=1)
    exact = (found.target.stated == 0).all(axis=1)
    assert exact.sum() == 20
    assert moved[exact].max() < 1e-3 < moved[~exact].min()
    none = calibrate(replace(points, world_std=np.zeros_like(std)), **OPTIONS)
    assert none.K.tobytes() == calibrate(replace(points, world_std=None), **OPTIONS).K.tobytes()


@pytest.mark.parametrize(("stated", "said"), slow_but([(0.1, "small")], [(0.1, "small"), (10.0, "large")]))
def test_a_survey_that_is_wrong_about_itself_is_told_so_and_does_no_harm(stated: float, said: str) -> None:
    right = calibrate(surveyed(3)[0], **OPTIONS)
    wrong = calibrate(surveyed(3, stated=stated)[0], **OPTIONS)
    assert wrong.std["alpha_u"] == pytest.approx(right.std["alpha_u"], rel=0.1)
    assert verdict_on(wrong).word == "usable"
    (reason,) = [text for text in verdict_on(wrong).reasons if text.endswith("to match the residuals")]
    times, size = re.search(r"points are ([0-9.]+) times too (\w+)", reason).groups()
    assert size == said
    assert 8 < float(times) < 12.5


def test_points_that_take_in_all_of_the_error_are_told(real_files: RealFiles) -> None:
    found = calibrate(read_points(real_files("field_reports/lidars1.csv")[0]))
    assert "with the points as stated it is 4.17 px rms" in verdict_on(found).reasons[0]


@pytest.mark.parametrize("seed", [20, 27])
def test_what_the_lens_leaves_open_counts_where_the_points_take_in_all_of_the_error(seed: int) -> None:
    points = surveyed(seed, n=44, n_views=1, std=4.0, spread=0.0)[0]
    chosen, named = calibrate(points), calibrate(points, distortion="none")
    assert chosen.distortion_model == "none"
    assert chosen.rmse_px < 0.01
    assert chosen.std["u0"] > 1.5 * named.std["u0"]


def test_a_poor_point_is_no_outlier_and_a_wrong_one_is() -> None:
    points, _, _ = surveyed(4, std=0.05, spread=0.0)
    world, std = np.array(points.world), np.array(points.world_std)
    every = np.arange(len(points)) % 60
    world[every == 7] += [20.0, -15.0, 10.0]
    std[every == 7] = 20.0
    world[every == 8] += [20.0, -15.0, 10.0]
    found = calibrate(replace(points, world=world, world_std=std), **OPTIONS)
    assert found.rejected.points is not None
    assert found.n_rejected == 4
    assert np.unique(found.rejected.points.world, axis=0).tolist() == [world[8].tolist()]


def test_one_point_has_one_standard_deviation() -> None:
    points, _, _ = surveyed(5, n_views=2)
    std = np.array(points.world_std)
    std[70] *= 2
    with pytest.raises(InputError, match="this world point has another standard deviation"):
        calibrate(replace(points, world_std=std), **OPTIONS)


def test_one_view_and_given_cameras_and_poses_take_them_too() -> None:
    points, poses, _ = surveyed(6, n_views=1)
    for options in (OPTIONS, {"type": 3, "intrinsics": K}, {"type": 4, "extrinsics": poses, **OPTIONS}):
        found, given = calibrate(points, **options), calibrate(points, **options, target="given")
        assert found.target is not None
        assert found.rmse_px < 0.7 * given.rmse_px


def test_both_cameras_of_a_rig_see_the_same_survey() -> None:
    left, poses, _ = surveyed(7, n=30)
    right, _, true = surveyed(7, n=30)
    turn, shift = rotation_step(np.array([0.0, 0.1, 0.0])), np.array([-120.0, 0.0, 10.0])
    rng = np.random.default_rng(0)
    pixels = []
    for pose in poses.values():
        x = ((true @ pose.R.T + pose.t) @ turn.T + shift) @ K.T
        pixels.append(x[:, :2] / x[:, 2:] + 0.3 * rng.standard_normal((30, 2)))
    rig = calibrate_stereo(left, replace(right, pixels=np.concatenate(pixels)), **OPTIONS)
    assert rig.left.target is rig.right.target
    assert rig.left.target is not None
    assert rig.left.target.stated is not None
    assert abs(rig.baseline - np.linalg.norm(shift)) < 4 * rig.std["baseline"]


def test_the_columns_go_through_the_commands(tmp_path: Path) -> None:
    points, camera, again = tmp_path / "points.csv", tmp_path / "camera.yaml", tmp_path / "again.csv"
    write_points(surveyed(8)[0], points)
    done = succeed("calibrate", points, "--distortion", "none", "-o", camera)
    assert "surveyed points: found" in done.stderr
    stored = read_calibration(camera)
    assert stored.points.world_std is not None
    assert np.array_equal(stored.points.world_std, surveyed(8)[0].world_std)
    assert stored.target is not None
    assert stored.target.stated is not None
    assert stored.verdict == calibrate(surveyed(8)[0], distortion="none").verdict
    succeed("convert", points, "--to", "neurocal", "-o", again)
    assert again.read_text() == points.read_text()
    held = run("calibrate", points, "--distortion", "none", "--target", "given", "-o", tmp_path / "g.yaml")
    assert held.stderr.count("sX,sY,sZ") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_views", "stated"), [(1, 1.0), (4, 1.0), (1, 0.1), (4, 0.1), (1, 10.0), (4, 10.0)]
)
def test_errors_are_as_large_as_the_standard_deviations(n_views: int, stated: float) -> None:
    camera, poses = [], []
    for seed in range(200):
        points, true, _ = surveyed(1000 + seed, n_views=n_views, stated=stated)
        found = calibrate(points, **OPTIONS)
        wanted = {"alpha_u": K[0, 0], "alpha_v": K[1, 1], "u0": K[0, 2], "v0": K[1, 2]}
        camera.append([(getattr(found.intrinsics, p) - x) / found.std[p] for p, x in wanted.items()])
        for name, view in found.views.items():
            std = [view.std[p] for p in ("t_x", "t_y", "t_z")]
            poses.append((view.pose.t - true[name].t) / std)
    assert 0.9 < np.sqrt(np.square(camera).mean()) < 1.1
    assert 0.9 < np.sqrt(np.square(poses).mean()) < 1.1

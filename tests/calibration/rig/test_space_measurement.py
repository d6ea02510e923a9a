"""How well a rig measures at a distance, and where a camera was: the standard deviations hold for noise."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run, succeed
from support.noisy_flat_set import pose, trial
from support.places import SAMPLES

from neurocal_cli import (
    Calibration,
    Correspondences,
    Rig,
    StereoRig,
    calibrate,
    calibrate_rig,
    calibrate_stereo,
    read_points,
    triangulate,
)
from neurocal_cli.calibration.rig.space_uncertainty import _places
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.files.result_files import write_rig

DISTANCE = 1000.0  # mm
SIGMA = 0.1  # px


def calibrated(left: Correspondences, right: Correspondences) -> StereoRig:
    return calibrate_stereo(left, right, distortion="none", skew=False, target="given", outliers="keep")


@cache
def pair() -> StereoRig:
    return calibrated(*(read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right")))


@cache
def three() -> Rig:
    points = {f"cam{k}": read_points(SAMPLES / f"rig_cam{k}.csv") for k in range(3)}
    return calibrate_rig(points, distortion="k1k2", skew=False, target="given", outliers="keep")


def exact(camera: Calibration) -> Correspondences:
    """The points of a camera with the pixels that it predicts."""
    points, pixels = camera.points, np.empty((len(camera.points), 2))
    for k, name in enumerate(points.view_names):
        of_view = points.view_index == k
        inside = camera.views[name].pose.to_camera(points.world[of_view])
        pixels[of_view] = camera.camera.project(inside)[0]
    return replace(points, pixels=pixels)


def errors(trials: int) -> tuple[Array, Array]:
    """Errors of the depth of the middle and of a length, by calibrations from noisy points, and their std."""
    true = pair()
    sides = exact(true.left), exact(true.right)
    X = np.array([[0.0, 0, DISTANCE], [-100, 0, DISTANCE], [100, 0, DISTANCE]])
    pixels = true.left.camera.project(X)[0], true.right.camera.project(true.pose.to_camera(X))[0]
    found, stated = [], []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        noisy = [replace(one, pixels=one.pixels + rng.normal(0, SIGMA, (len(one), 2))) for one in sides]
        rig = calibrated(*noisy)
        at = rig.errors_at(DISTANCE)
        got = triangulate(rig, *pixels).points
        assert at.of_depth is not None
        found.append([got[0, 2] - DISTANCE, np.linalg.norm(got[2] - got[1]) - 200])
        stated.append([at.of_depth.by_calibration, at.of_length.by_calibration * 200 / at.length])
    return np.array(found), np.array(stated)


@pytest.mark.parametrize(
    ("trials", "low", "high"),
    [(8, 0.4, 2.0), pytest.param(150, 0.85, 1.2, marks=pytest.mark.slow)],
)
def test_points_in_space_scatter_as_their_std_says(trials: int, low: float, high: float) -> None:
    found, stated = errors(trials)
    ratio = np.sqrt((found**2).mean(axis=0) / (stated**2).mean(axis=0))
    assert (ratio > low).all(), ratio
    assert (ratio < high).all(), ratio


def test_the_share_of_the_pixels_is_that_of_triangulation() -> None:
    rig = pair()
    at = rig.errors_at(DISTANCE)
    X = np.array([[0.0, 0, DISTANCE]])
    pixels = rig.left.camera.project(X)[0], rig.right.camera.project(rig.pose.to_camera(X))[0]
    covariance = triangulate(rig, *pixels).space_covariance(rig.sigma)[0]
    assert at.of_depth is not None
    assert at.of_depth.by_pixel == pytest.approx(np.sqrt(covariance[2, 2]), rel=0.05)


def test_the_share_of_the_calibration_agrees_with_the_verdict() -> None:
    rig = pair()
    assert rig.verdict is not None
    depth, share = (rig.verdict.measures[name] for name in ("depth", "depth_share"))
    at = rig.errors_at(depth)
    assert at.of_depth is not None
    assert at.of_depth.by_calibration == pytest.approx(share * depth, rel=0.3)


def test_a_third_camera_makes_points_more_certain() -> None:
    whole = three()
    two = whole.pair("cam0", "cam1").errors_at(DISTANCE)
    all_of_them = whole.errors_at(DISTANCE)
    assert two.of_depth is not None
    assert all_of_them.of_depth is not None
    assert all_of_them.of_depth.by_pixel < 0.8 * two.of_depth.by_pixel


@pytest.mark.parametrize("distance", [0.0, -1.0, np.nan, 1.0])
def test_a_distance_at_which_nothing_is_seen_twice_is_refused(distance: float) -> None:
    with pytest.raises(InputError, match="distance"):
        pair().errors_at(distance)


def test_without_points_nothing_is_known() -> None:
    with pytest.raises(InputError, match="not written with --lean"):
        pair().lean.errors_at(DISTANCE)


@pytest.mark.parametrize(
    ("trials", "low", "high"),
    [(16, 1.6, 4.6), pytest.param(300, 2.6, 3.4, marks=pytest.mark.slow)],
)
def test_the_place_of_a_camera_scatters_as_its_covariance_says(trials: int, low: float, high: float) -> None:
    true = pose(3)
    squares = []
    for seed in range(trials):
        place = trial(seed).position("view3")
        assert place.covariance is not None
        off = place.point + true.R.T @ true.t
        squares.append(off @ np.linalg.solve(place.covariance, off))
    assert low < np.mean(squares) < high  # 3 on average


def test_a_given_place_is_exact_and_one_without_points_unknown() -> None:
    camera = trial(0)
    given = calibrate(camera.points, type=4, extrinsics=camera, distortion="none")
    assert given.position("view3").std.tolist() == [0.0, 0.0, 0.0]
    alone = replace(camera, points=Correspondences.none((640, 480), "mm"))
    assert alone.position("view3").covariance is None
    assert np.isnan(alone.position("view3").std).all()
    with pytest.raises(InputError, match="no view 'nowhere'"):
        camera.position("nowhere")


def test_the_commands_show_both(tmp_path: Path) -> None:
    for name, rig in (("rig.yaml", three()), ("pair.yaml", pair())):
        write_rig(rig, tmp_path / name)
        shown = succeed("evaluate", tmp_path / name, "--at", "1m")
        assert "at 1000 mm" in shown.stdout
        assert "its depth" in shown.stdout
        tree = json.loads(run("evaluate", tmp_path / name, "--at", "100cm", "--json").stdout)["at"]
        assert tree["depth"]["std"] == pytest.approx(
            np.hypot(tree["depth"]["pixels"], tree["depth"]["calibration"])
        )
    camera = tmp_path / "camera.yaml"
    run("calibrate", SAMPLES / "flat.csv", "--distortion", "none", "-o", camera)
    assert "camera in" in run("evaluate", camera, "--positions").stdout
    tree = json.loads(run("evaluate", camera, "--positions", "--json").stdout)["positions"]
    assert set(tree) == {f"view{k:02d}" for k in range(1, 11)}
    assert min(tree["view01"]["std"]) > 0


def test_of_points_equally_near_the_middle_rounding_does_not_choose() -> None:
    x, y = (part.ravel() for part in np.meshgrid(np.arange(6.0), np.arange(4.0)))
    grid, rng = np.column_stack([x, y, np.full(24, 1000.0)]), np.random.default_rng(1)
    assert {_places(grid + 1e-13 * rng.standard_normal(grid.shape)) for _ in range(20)} == {_places(grid)}

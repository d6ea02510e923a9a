"""The standard deviations of poses include the covariance of the camera that was given for them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import refused, run
from support.rigs import RigScene, random_rig, sides
from support.slow_cases import slow_but
from support.verdicts import verdict_on
from support.wrong_inputs import CAMERA, board, flat, poses, turned_poses

from neurocal_cli import (
    Calibration,
    Camera,
    Correspondences,
    Intrinsics,
    Pose,
    calibrate,
    evaluate_camera,
    fit_stereo,
    read_calibration,
    write_calibration,
    write_points,
)
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES
from neurocal_cli.files.exchange.reading import read_given_camera

SIZE = (640, 480)
TRUE = {
    "none": Camera(CAMERA, Distortion(), SIZE),
    "k1k2": Camera(CAMERA, Distortion("k1k2", np.array([-0.2, 0.06])), SIZE),
    "fisheye": Camera(CAMERA, Distortion("fisheye", np.array([0.03, -0.02, 0.0, 0.0])), SIZE),
}


def seen(camera: Camera, some: list[Pose], sigma: float, rng: np.random.Generator) -> Correspondences:
    world = board()
    pixels = np.concatenate([camera.project(world @ pose.R.T + pose.t)[0] for pose in some])
    names = np.repeat([f"new{k}" for k in range(len(some))], len(world))
    noisy = pixels + sigma * rng.normal(size=pixels.shape)
    return Correspondences(np.tile(world, (len(some), 1)), noisy, names, SIZE)


@cache
def calibrated(camera: Camera, sigma: float = 0.2) -> Calibration:
    points = seen(camera, [*poses(8, 3), *turned_poses(8, 4)], sigma, np.random.default_rng(1))
    return calibrate(points, distortion=camera.distortion.model, target="given")


def parameters(camera: Camera) -> Array:
    return np.array([*camera.intrinsics.values(), *camera.distortion.coefficients])


def with_parameters(calibration: Calibration, values: Array) -> Calibration:
    return replace(calibration, intrinsics=Intrinsics(*values[:5]), distortion=values[5:], judgement=None)


def errors_over_std(found: Calibration, true: list[Pose]) -> Array:
    """(V, 6) errors of the poses over their reported standard deviations."""
    rows = []
    for k, pose in enumerate(true):
        view = found.views[f"new{k}"]
        error = np.concatenate([view.pose.euler - pose.euler, view.pose.t - pose.t])
        rows.append(error / [view.std[name] for name in POSE_NAMES])
    return np.array(rows)


@pytest.mark.parametrize(("model", "trials"), slow_but([("k1k2", 40)], itertools.product(TRUE, (40, 400))))
def test_errors_of_poses_are_as_large_as_stated_if_the_camera_is_uncertain(model: str, trials: int) -> None:
    """The given camera is drawn from its own covariance; without it, the errors are 3 to 15 times larger."""
    true, own = TRUE[model], calibrated(TRUE[model])
    names = (*INTRINSIC_NAMES, *coefficient_names(model))
    assert own.covariance_names == names
    root = np.linalg.cholesky(own.covariance)
    new, errors, alone = poses(3, 5), [], []
    for trial in range(trials):
        rng = np.random.default_rng([trial, 6])
        given = with_parameters(own, parameters(true) + root @ rng.normal(size=len(names)))
        points = seen(true, new, 0.2, rng)
        options = {"type": 3, "target": "given", "outliers": "keep"}
        errors.append(errors_over_std(calibrate(points, intrinsics=given, **options), new))
        alone.append(errors_over_std(calibrate(points, intrinsics=given.camera, **options), new))
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 1)))
    slack = 1.0 if trials > 100 else 3.0  # few draws: the std of an rms of n errors is 1 / sqrt(2 n)
    assert abs(rms - 1.0).max() < 0.1 * slack, rms
    assert np.sqrt((np.array(alone) ** 2).mean(axis=(0, 1))).max() > 3.0


def test_an_exact_camera_leaves_the_standard_deviations_as_they_were() -> None:
    own, points = calibrated(TRUE["k1k2"]), seen(TRUE["k1k2"], poses(3, 5), 0.2, np.random.default_rng(2))
    exact = replace(own, covariance=0 * own.covariance)
    found, plain = (calibrate(points, type=3, intrinsics=one) for one in (exact, own.camera))
    known = calibrate(points, type=3, intrinsics=own)
    for name in found.views:
        assert found.views[name].std == pytest.approx(plain.views[name].std, rel=1e-12)
        assert found.views[name].pose.t.tolist() == plain.views[name].pose.t.tolist()
        assert all(known.views[name].std[one] > plain.views[name].std[one] for one in POSE_NAMES)
    assert (plain.given_names, plain.std, known.std) == ((), found.std, found.std)


def test_the_command_takes_the_covariance_from_the_file(tmp_path: Path) -> None:
    own, points = calibrated(TRUE["k1k2"]), seen(TRUE["k1k2"], poses(3, 5), 0.2, np.random.default_rng(2))
    write_calibration(own, tmp_path / "camera.yaml")
    write_points(points, tmp_path / "points.csv")
    given = ("calibrate", "--type", 3, tmp_path / "points.csv", "--intrinsics")
    assert run(*given, tmp_path / "camera.yaml", "-o", tmp_path / "poses.yaml").exit_code == 0
    # The result states its camera's covariance as well, so it can be given again.
    assert run(*given, tmp_path / "poses.yaml", "-o", tmp_path / "again.yaml").exit_code == 0
    expected = calibrate(points, type=3, intrinsics=own)
    for name in ("poses", "again"):
        found = read_calibration(tmp_path / f"{name}.yaml")
        assert found.given_names == own.covariance_names
        assert (found.given_covariance == own.covariance).all()
        for view, one in expected.views.items():
            assert found.views[view].std == pytest.approx(one.std, rel=1e-9)
    camera = read_given_camera(tmp_path / "camera.yaml")
    assert isinstance(camera, Calibration)
    assert camera.views == {}


def test_a_given_camera_within_its_own_uncertainty_is_not_doubted() -> None:
    """Four standard deviations of a small calibration are ten of the poses with an exact camera."""
    few = flat()
    own = calibrate(few.select(few.view_index < 3), skew=False, distortion="none", target="given")
    points = seen(TRUE["none"], poses(6, 5), 0.2, np.random.default_rng(3))
    root = np.linalg.cholesky(own.covariance)
    values = parameters(TRUE["none"])
    values[:4] += 2 * root @ [1.0, -1.0, 1.0, 1.0]
    given = with_parameters(own, values)
    doubted = calibrate(points, type=3, intrinsics=given.camera, target="given").verdict
    assert doubted is not None
    assert any("is given, but" in reason or "the given camera" in reason for reason in doubted.reasons)
    verdict = verdict_on(calibrate(points, type=3, intrinsics=given, target="given"))
    assert not any("is given, but" in reason or "the given camera" in reason for reason in verdict.reasons)


def test_poses_of_new_views_in_an_evaluation_have_it_too() -> None:
    own, points = calibrated(TRUE["none"]), seen(TRUE["none"], poses(3, 5), 0.2, np.random.default_rng(2))
    fits = [evaluate_camera(camera, points).fit for camera in (own, own.camera)]
    known, exact = (fit.views["new0"].std["t_z"] for fit in fits if fit is not None)
    assert known > 2 * exact


def two_cameras() -> tuple[RigScene, tuple[Calibration, Calibration]]:
    """A rig, and calibrations of its cameras from other views."""
    scene = random_rig(np.random.default_rng(6), "verging", 8, "k1k2")
    before = replace(scene, poses=random_rig(np.random.default_rng(50), "verging", 10, "k1k2").poses)
    left, right = (
        calibrate(points, distortion="k1k2", skew=False, target="given") for points in sides(before, 0.15)
    )
    return scene, (left, right)


@pytest.mark.parametrize("trials", [10, pytest.param(200, marks=pytest.mark.slow)])
def test_errors_of_a_rig_are_as_large_as_stated_if_its_cameras_are_uncertain(trials: int) -> None:
    """Without the covariance of the given cameras, rotations are 15 to 25 standard deviations off."""
    scene, own = two_cameras()
    true = [scene.camera(side) for side in (0, 1)]
    roots = [np.linalg.cholesky(camera.covariance) for camera in own]
    seen_by_both = scene.points(0), scene.points(1)
    depth = np.linalg.norm(scene.world @ scene.poses["01"].R.T + scene.poses["01"].t, axis=1)
    errors, of_poses, alone, depths = [], [], [], []
    for trial in range(trials):
        rng = np.random.default_rng([trial, 7])
        drawn = []
        for camera, one, root in zip(own, true, roots, strict=True):
            free = [(*INTRINSIC_NAMES, "k1", "k2").index(name) for name in camera.covariance_names]
            values = parameters(one)
            values[free] += root @ rng.normal(size=len(root))
            drawn.append(with_parameters(camera, values))
        points = [scene.points(side, 0.15, rng) for side in (0, 1)]
        options = {"type": 3, "target": "given", "outliers": "keep"}
        for result, exact in ((errors, False), (alone, True))[: 2 if trial < 4 or trials > 100 else 1]:
            cameras = [
                calibrate(some, intrinsics=given.camera if exact else given, **options)
                for some, given in zip(points, drawn, strict=True)
            ]
            rig = fit_stereo(cameras[0], cameras[1])
            error = np.concatenate([rig.pose.euler - scene.rig.euler, rig.t - scene.rig.t])
            std = [rig.std[name] for name in (*POSE_NAMES, "baseline")]
            result.append(np.append(error, rig.baseline - np.linalg.norm(scene.rig.t)) / std)
            if exact:
                continue
            view = rig.right.views["01"]
            off = np.concatenate(
                [view.pose.euler - scene.pose(1, "01").euler, view.pose.t - scene.pose(1, "01").t]
            )
            of_poses.append(off / [view.std[name] for name in POSE_NAMES])
            pixels = (side.pixels[: len(scene.world)] for side in seen_by_both)
            space = triangulate(rig.left, rig.right, rig.pose, *pixels).points
            measured = np.linalg.norm(space, axis=1)  # depths are those along the rays
            depths.append(np.median(measured / depth - 1) / verdict_on(rig).measures["depth_share"])
    slack = 0.1 if trials > 100 else 0.4
    for found in (errors, of_poses, depths):
        rms = np.sqrt((np.array(found) ** 2).mean(axis=0))
        assert np.abs(rms - 1).max() < slack, rms
    assert np.sqrt((np.array(alone) ** 2).mean(axis=0)).max() > 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda block: block["covariance"]["names"].__setitem__(0, "focal"), "names must be different names"),
        (lambda block: block["covariance"]["data"][0].__setitem__(0, -1.0), "negative eigenvalues"),
        (lambda block: block["covariance"]["data"][0].__setitem__(1, 0.0), "must be symmetric"),
        (lambda block: block["covariance"].update(data=(np.eye(7) * 1e-9).tolist()), "the std of alpha_u is"),
    ],
)
def test_a_covariance_that_was_edited_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    write_calibration(calibrated(TRUE["k1k2"]), tmp_path / "camera.json")
    tree = json.loads((tmp_path / "camera.json").read_text())
    change(tree["neurocal"])
    (tmp_path / "edited.json").write_text(json.dumps(tree))
    write_points(flat(), tmp_path / "points.csv")
    result = run("calibrate", tmp_path / "points.csv", "--type", 3, "--intrinsics", tmp_path / "edited.json")
    refused(result, message)


def test_what_is_taken_as_exact_is_said(tmp_path: Path) -> None:
    own, points = calibrated(TRUE["k1k2"]), seen(TRUE["k1k2"], poses(3, 5), 0.2, np.random.default_rng(2))
    write_calibration(own, tmp_path / "camera.yaml")
    write_points(points, tmp_path / "points.csv")
    run("convert", tmp_path / "camera.yaml", "--to", "ros", "-o", tmp_path / "ros.yaml")
    given = ("calibrate", tmp_path / "points.csv", "--type")
    known, unknown = (run(*given, 3, "--intrinsics", tmp_path / f"{name}.yaml") for name in ("camera", "ros"))
    write_calibration(calibrate(points, type=3, intrinsics=own), tmp_path / "poses.yaml")
    placed = run(*given, 4, "--extrinsics", tmp_path / "poses.yaml", "--distortion", "k1k2")
    assert ["taken as exact" in one.stderr for one in (known, unknown, placed)] == [False, True, True]


def test_the_std_of_predicted_pixels_includes_the_given_camera() -> None:
    own, points = calibrated(TRUE["k1k2"]), seen(TRUE["k1k2"], poses(3, 5), 0.2, np.random.default_rng(2))
    known, exact = (calibrate(points, type=3, intrinsics=one).verdict for one in (own, own.camera))
    assert known is not None
    assert exact is not None
    assert known.measures["projection_px"] > 3 * exact.measures["projection_px"]

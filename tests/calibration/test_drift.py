"""A drift of a camera is found, and none is seen where there is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run, succeed
from support.places import SAMPLES
from support.real_data import RealFiles
from support.sessions import SIZE, camera, session

from neurocal_cli import Calibration, Correspondences, calibrate, read_points
from neurocal_cli.calibration.drift import SHARE, drift_since, find_drift
from neurocal_cli.calibration.measurement import camera_and_covariance
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import DegenerateGeometryError, InputError


def calibrated(seed: int, views: int = 25, distortion: str = "k1k2", **changed: object) -> Calibration:
    points = session(camera(**changed), np.random.default_rng(seed), views, sigma=0.05)  # type: ignore[arg-type]
    return calibrate(points, distortion=distortion, skew="fixed", target="given")


@pytest.fixture(scope="module")
def old() -> Calibration:
    return calibrated(1)


@pytest.mark.parametrize("distortion", ["k1k2", "plumb_bob", "fisheye"])
def test_an_unchanged_camera_is_the_same_whatever_the_model(old: Calibration, distortion: str) -> None:
    found = find_drift(old, calibrated(2, distortion=distortion))
    assert not found.different
    assert found.rms_px < 3 * found.rms_std


@pytest.mark.parametrize("distortion", ["k1k2", "plumb_bob"])
def test_a_scale_that_drifted_by_three_thousandths_is_found_and_measured(
    old: Calibration, distortion: str
) -> None:
    found = find_drift(old, calibrated(3, distortion=distortion, scale=1.003))
    assert found.different
    assert abs(found.changes[0] - 0.003) < 3 * found.changes_std[0] < 0.002


def test_a_moved_centre_is_found_and_measured(old: Calibration) -> None:
    found = find_drift(old, calibrated(4, centre=(658.0, 471.0)))
    assert found.different
    assert (np.abs(found.changes - [0, 6, 0]) < 3.5 * found.changes_std).all()


def test_a_given_rotation_is_no_change(old: Calibration) -> None:
    """A camera that looks elsewhere has other poses, but projects as before."""
    itself = find_drift(old, old)
    assert itself.rms_px < 1e-9
    assert itself.share == 1.0
    assert itself.rotation == pytest.approx(np.eye(3), abs=1e-12)


def test_the_standard_deviations_are_those_of_drawn_cameras(old: Calibration) -> None:
    """Cameras drawn from the covariance of the old one differ from it as much as is said."""
    exact, covariance = camera_and_covariance(old)
    rng, own = np.random.default_rng(0), old.camera
    predicted = find_drift(old, own)  # against an exact camera: the old one's uncertainty alone
    drawn: list[Array] = []
    changes: list[Array] = []
    for step in rng.multivariate_normal(np.zeros(len(covariance)), covariance, size=60):
        A = exact.A.copy()
        A[[0, 0, 1, 0, 1], [0, 1, 1, 2, 2]] += step[:5]
        lens = Distortion(exact.distortion.model, exact.distortion.coefficients + step[5:])
        found = find_drift(old, replace(exact, intrinsics=Intrinsics.from_matrix(A), distortion=lens))
        drawn.append(found.difference)
        changes.append(found.changes)
    std = np.sqrt((np.stack(drawn) ** 2).sum(axis=2).mean(axis=0))
    assert np.median(std / predicted.std) == pytest.approx(1, abs=0.25)
    assert np.std(changes, axis=0) / predicted.changes_std == pytest.approx(1, abs=0.35)


def test_what_says_nothing_is_refused(old: Calibration) -> None:
    with pytest.raises(InputError, match="neither camera comes with the covariance"):
        find_drift(old.camera, old.camera)
    with pytest.raises(InputError, match="640 x 480 px and 1280 x 960 px"):
        find_drift(old, replace(old.camera, image_size=(640, 480)))
    unknown = replace(old, points=Correspondences.none(None, "mm"), views={})
    with pytest.raises(InputError, match="calibrate with --image-size"):
        find_drift(unknown, unknown)
    nothing_known = np.full_like(old.covariance, np.nan)
    with pytest.raises(InputError, match="standard deviations of a camera are unknown"):
        find_drift(replace(unknown, points=Correspondences.none(SIZE, "mm"), covariance=nothing_known), old)


def test_a_lean_file_or_another_program_s_file_will_do(old: Calibration) -> None:
    new = calibrated(3, scale=1.003)
    assert find_drift(old.lean, new.lean).different
    assert find_drift(old.camera, new).different
    assert not find_drift(old.lean, calibrated(2).camera).different


def test_new_points_tell_the_same_in_words(old: Calibration, tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    changed = drift_since(old, session(camera(1.01), rng, 20, sigma=0.05))
    same = drift_since(old, session(camera(), rng, 20, sigma=0.05))
    assert changed is not None
    assert changed.different
    assert same is not None
    assert not same.different
    few = session(camera(), rng, 1)
    assert drift_since(old, few) is None


def test_the_command_answers_by_its_exit_status(tmp_path: Path) -> None:
    names = ("flat", "stereo_left", "stereo_right")
    for name in names:
        succeed("-qq", "calibrate", SAMPLES / f"{name}.csv", "--target", "given", "--distortion", "none",
                "-o", tmp_path / f"{name}.yaml")  # fmt: skip
    flat, left, right = (tmp_path / f"{name}.yaml" for name in names)
    same = succeed("drift", flat, left, "--plot", tmp_path / "drift.png")
    assert "the same within chance" in same.stdout
    assert (tmp_path / "drift.png").stat().st_size > 10_000
    other = run("drift", flat, right)
    assert other.exit_code == 4
    assert "\ndifferent: " in other.stdout
    assert other.stderr == ""
    summary = json.loads(run("drift", flat, right, "--json").stdout)
    assert summary["different"]
    assert summary["changes"]["centre_v"]["value"] > 5 * summary["changes"]["centre_v"]["std"]
    assert run("drift", flat, tmp_path / "none.yaml").exit_code == 1
    told = run("evaluate", "camera", flat, SAMPLES / "stereo_right.csv")
    assert (
        "the calibration no longer holds: calibrated from these points, the camera differs by" in told.stdout
    )
    assert "the camera has changed since: its scale by" in told.stdout
    told = run("evaluate", "camera", flat, SAMPLES / "stereo_left.csv")
    assert "the calibration still holds: calibrated from these points, the camera differs by" in told.stdout
    lines = (SAMPLES / "stereo_left.csv").read_text().splitlines(keepends=True)
    (tmp_path / "few.csv").write_text(
        "".join(line for line in lines if line[:4] != "left" or line[:6] == "left01")
    )
    told = run("evaluate", "camera", flat, tmp_path / "few.csv")
    assert "these points alone do not determine the camera" in told.stdout


@pytest.mark.slow
@pytest.mark.parametrize("views", [8, 12, 25])
def test_pairs_of_an_unchanged_camera_differ_in_at_most_the_stated_share(views: int) -> None:
    shares = []
    for seed in range(200):
        rng = np.random.default_rng([views, seed])
        pair = [
            calibrate(session(camera(), rng, views), distortion="k1k2", skew="fixed", target="given")
            for _ in "ab"
        ]
        shares.append(find_drift(*pair).share)
    assert np.mean(np.array(shares) < 0.05) <= 0.05
    assert np.count_nonzero(np.array(shares) < SHARE) <= 1


@pytest.mark.slow
def test_halves_of_real_sets_are_the_same_camera(real_files: RealFiles, tmp_path: Path) -> None:
    sets = {path.stem: read_points([path]) for path in real_files("photographs/points_*.csv")}
    for side in ("left", "right"):
        points = tmp_path / f"{side}.csv"
        run("detect", *real_files(f"opencv_stereo/{side}*.jpg"), "--cols", 9, "--rows", 6, "--square", 25,
            "-o", points)  # fmt: skip
        sets[side] = read_points([points])
    compared = 0
    for name, points in sets.items():
        number = np.arange(points.n_views)
        for first in (number % 2 == 0, number < points.n_views // 2):
            try:
                halves = [calibrate(points.select(part[points.view_index])) for part in (first, ~first)]
            except (InputError, DegenerateGeometryError):
                continue
            assert not find_drift(*halves).different, name
            compared += 1
    assert compared >= 8

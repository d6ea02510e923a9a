"""Hardly more equations than unknowns: nothing is left out down to an exact fit, and nobody is misled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.real_data import RealFiles
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Camera, Correspondences, Intrinsics, Pose, calibrate, read_points
from neurocal_cli.errors import NeurocalError

CAMERA = Camera(Intrinsics(1400.0, 1400.0, 950.0, 545.0), image_size=(1920, 1080))


def seen(n: int, seed: int, sigma: float = 0.5) -> Correspondences:
    """Points in a room of 2 x 1 x 2 m, seen from 4 m."""
    rng = np.random.default_rng([n, seed])
    pose = Pose.from_euler(*rng.uniform(-0.3, 0.3, 3), np.array([0.0, 0.0, 4.0]))
    world = rng.uniform([-1, -0.5, -1], [1, 0.5, 1], (n, 3))
    pixels = CAMERA.project(world @ pose.R.T + pose.t)[0]
    return Correspondences(world, pixels + sigma * rng.normal(size=(n, 2)), image_size=CAMERA.image_size)


def calibrated(points: Correspondences) -> Calibration | None:
    try:
        return calibrate(points, skew=False, distortion="none")
    except NeurocalError:  # the points lie badly
        return None


@pytest.mark.parametrize("n", slow_but([6, 8], [6, 7, 8, 10]))
def test_noise_in_few_points_is_no_outlier(n: int) -> None:
    found = [camera for seed in range(20) if (camera := calibrated(seen(n, seed))) is not None]
    assert len(found) > 15
    assert [camera.n_rejected for camera in found] == [0] * len(found)


def test_a_wrong_point_of_few_is_left_out_alone() -> None:
    left_out = []
    for seed in range(10):
        points = seen(10, seed)
        pixels = points.pixels.copy()
        pixels[3] += [60, -40]
        found = calibrated(replace(points, pixels=pixels))
        if found is not None and found.rejected.points is not None:
            left_out.append(found.rejected.points.world.tolist() == points.world[[3]].tolist())
    assert len(left_out) > 5
    assert all(left_out)


@pytest.mark.parametrize(("n", "words"), [(6, {"poor"}), (8, {"usable", "poor"})])
def test_residuals_that_are_too_few_to_tell_the_noise_are_told(n: int, words: set[str]) -> None:
    for seed in range(5):
        found = calibrated(seen(n, seed))
        if found is not None and found.verdict is not None:
            assert found.verdict.word in words
            (reason,) = (r for r in found.verdict.reasons if "more than there are unknowns" in r)
            assert f"only {2 * n - 10} equations more" in reason
            assert f"give at least {9 - n} point" in " ".join(found.verdict.advice)


@pytest.mark.parametrize("n", [6, 7])
def test_few_spare_equations_name_no_other_lens(n: int) -> None:
    """Any coefficient explains the error then."""
    for seed in range(8):
        found = calibrated(seen(n, seed))
        if found is not None and found.verdict is not None:
            assert not any("distortion" in reason for reason in found.verdict.reasons)


@pytest.mark.parametrize(
    ("name", "n", "word"),
    [
        ("few_n6_0", 6, "poor"),
        ("few_m7_24", 7, "usable"),
        ("few_n6skew_1", 6, "poor"),
        ("few_t2n6_0", 6, "usable"),
    ],
)
def test_reported_sets_of_few_points(name: str, n: int, word: str, real_files: RealFiles) -> None:
    """Cameras of 1400 px and (950, 545); of some, one point or two were called outliers."""
    (path,) = real_files(f"field_reports/{name}.csv")
    given = {"type": 2, "image_center": (950.0, 545.0)} if "t2" in name else {}
    found = calibrate(read_points(path), skew="skew" in name, distortion="none", **given)
    assert len(found.points) == n
    assert found.verdict is not None
    assert found.verdict.word == word
    if "skew" not in name:  # a single equation is left there, and its residual is 0.0006 px by chance
        assert abs(found.intrinsics.alpha_u - 1400) < 3 * found.std["alpha_u"]


@pytest.mark.parametrize("name", ["pnp_small", "pnp1_11"])
def test_reported_small_targets_are_right(name: str, real_files: RealFiles) -> None:
    (path,) = real_files(f"field_reports/{name}.csv")
    camera = Camera(Intrinsics(1000.0, 1000.0, 960.0, 540.0), image_size=(1920, 1080))
    found = calibrate(read_points(path), type=3, intrinsics=camera)
    assert found.n_rejected == 0
    assert not found.rejected.views
    assert found.rmse_px < 0.4

"""Pixels to points on a plane, and lengths at a distance: their std holds for noise."""

from __future__ import annotations

import numpy as np
import pytest
from support.command_line import run, succeed
from support.made_calibration import made_calibration
from support.noisy_flat_set import NOISE, TRUE, pose, trial
from support.places import SAMPLES
from support.plain_projection import project

from neurocal_cli import calibrate, read_points
from neurocal_cli.errors import InputError

ON_BOARD = np.array([[105.0, 75.0, 0.0], [0.0, 150.0, 0.0], [260.0, -40.0, 0.0]])
PIXELS = project(TRUE.A, pose(3), ON_BOARD)[0]
TRIALS = [(16, 1.0, 3.4), pytest.param(300, 1.8, 2.2, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("trials", "low", "high"), TRIALS)
def test_points_on_a_board_scatter_as_the_calibration_s_share_says(
    trials: int, low: float, high: float
) -> None:
    misses = []
    for seed in range(trials):
        found = trial(seed).on_plane(PIXELS, "view3")
        assert found.by_calibration is not None
        off = (found.points - ON_BOARD)[:, :2]
        misses.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.by_calibration), off))
    mean = np.mean(misses, axis=0)
    assert (mean > low).all(), mean
    assert (mean < high).all(), mean


def test_the_pixels_share_is_that_of_their_noise() -> None:
    camera, rng = trial(0), np.random.default_rng(0)
    found = camera.on_plane(PIXELS, "view3", sigma=NOISE)
    noisy = [
        camera.on_plane(PIXELS + NOISE * rng.standard_normal(PIXELS.shape), "view3").points for _ in range(60)
    ]
    scatter = np.var(noisy, axis=0)[:, :2]
    ratio = scatter / np.diagonal(found.by_pixel, axis1=1, axis2=2)
    assert ratio.mean() == pytest.approx(1.0, abs=0.25)
    twice = camera.on_plane(PIXELS, "view3", sigma=2 * NOISE)
    np.testing.assert_allclose(twice.by_pixel, 4 * found.by_pixel)
    assert found.by_calibration is not None
    np.testing.assert_allclose(found.covariance, found.by_pixel + found.by_calibration)


def test_a_ray_that_misses_the_plane_has_no_point() -> None:
    camera = made_calibration(1)
    behind = camera.on_plane(np.array([[320.0, 240.0], [320.0, -1e6]]), "view00")
    assert behind.seen.tolist() == [True, False]
    assert np.isnan(behind.points[1]).all()
    assert np.isnan(behind.covariance[1]).all()
    with pytest.raises(InputError, match="no view 'nothing'"):
        camera.on_plane(PIXELS, "nothing")
    with pytest.raises(InputError, match=r"shape \(N, 2\)"):
        camera.on_plane(PIXELS[0], "view00")


def test_without_points_only_the_pixels_share_is_known() -> None:
    from dataclasses import replace

    camera = trial(0)
    lean = replace(camera.lean, views=camera.views)
    found = lean.on_plane(PIXELS, "view3")
    assert found.by_calibration is None
    np.testing.assert_array_equal(found.covariance, found.by_pixel)


@pytest.mark.parametrize(
    ("trials", "low", "high"), [(16, 0.5, 1.7), pytest.param(300, 0.9, 1.1, marks=pytest.mark.slow)]
)
def test_lengths_at_a_distance_scatter_as_their_share_of_the_calibration_says(
    trials: int, low: float, high: float
) -> None:
    distance, ends = 1000.0, np.array([[0.25 * 639, 239.5], [0.75 * 639, 239.5]])
    true = distance * 0.5 * 639 / TRUE.alpha_u
    lengths, stated = [], []
    for seed in range(trials):
        camera = trial(seed)
        rays = camera.camera.unproject(ends)
        a, b = distance * rays / rays[:, 2:]
        lengths.append(float(np.linalg.norm(a - b)))
        stated.append(camera.errors_at(distance).of_length.by_calibration)
    ratio = np.sqrt(np.mean((np.array(lengths) - true) ** 2) / np.mean(np.square(stated)))
    assert low < ratio < high


def test_errors_at_a_distance_are_those_of_a_simple_camera() -> None:
    camera = trial(1)
    errors = camera.errors_at(2000.0)
    assert errors.sigma == pytest.approx(NOISE, rel=0.1)
    assert errors.length == pytest.approx(2000.0 * 0.5 * 639 / camera.intrinsics.alpha_u)
    # Both ends have the noise of u.
    ends = errors.sigma * 2000.0 / camera.intrinsics.alpha_u * np.sqrt(2)
    assert errors.of_length.by_pixel == pytest.approx(ends, rel=1e-6)
    assert errors.of_length.by_calibration == pytest.approx(
        errors.length * camera.std["alpha_u"] / camera.intrinsics.alpha_u, rel=1e-6
    )
    assert errors.of_worst.std >= errors.of_middle.std
    nearer = camera.errors_at(1000.0)
    assert errors.of_worst.std == pytest.approx(2 * nearer.of_worst.std)
    assert nearer.of_length.std == pytest.approx(
        np.hypot(nearer.of_length.by_calibration, nearer.of_length.by_pixel)
    )
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="distance must be a positive number"):
            camera.errors_at(wrong)


def test_with_square_pixels_one_alpha_is_uncertain_for_both_axes() -> None:
    points = read_points(SAMPLES / "flat.csv")
    camera = calibrate(points, distortion="none", square_pixels=True, target="given")
    errors = camera.errors_at(1000.0)
    share = camera.std["alpha_u"] / camera.intrinsics.alpha_u
    assert errors.of_length.by_calibration == pytest.approx(errors.length * share, rel=0.05)


def test_the_commands_print_them(tmp_path) -> None:
    camera = tmp_path / "camera.yaml"
    words = ("--distortion", "none", "--no-skew", "--target", "given", "-o", camera)
    succeed("calibrate", SAMPLES / "flat.csv", *words)
    shown = [
        run("evaluate", "camera", camera, "--at", at).stdout for at in ("1000mm", "1m", "1000", "100 cm")
    ]
    assert "at 1000 mm " in shown[0]
    assert len(set(shown)) == 1
    for wrong in ("foo", "-3", "0mm", "1e999"):
        assert run("evaluate", "camera", camera, "--at", wrong).exit_code == 2
    assert run("evaluate", "camera", camera, "--at", "3 parsec").exit_code == 2
    result = succeed("triangulate", camera, "-", "--plane", "view01", stdin=b"point,u,v\nb,320,240\n")
    header, row = result.stdout.splitlines()[-2:]
    assert header == "point,X,Y,Z,sXX,sXY,sYY,flag"
    assert row.startswith("b,11")
    assert row.endswith(",ok")
    assert " by the calibration" in result.stderr
    json = run(
        "triangulate", camera, "-", "--plane", "view01", "--json", "-o", tmp_path / "x.csv", stdin=b"1,2\n"
    )
    assert '"n_points": 1' in json.stdout
    assert run("triangulate", camera, camera, "-", "--plane", "view01").exit_code == 2

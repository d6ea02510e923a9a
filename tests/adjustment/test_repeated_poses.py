"""Views that repeat a pose are found, and are one view to everything that counts views."""

from __future__ import annotations

import numpy as np
import pytest
from support.grouped_views import ALPHA, COLS, ROWS, frames, photographed, poses
from support.real_data import RealFiles
from support.scenes import random_flat_set
from support.slow_cases import slow_but

from neurocal_cli import Calibration, Correspondences, calibrate, read_points
from neurocal_cli.adjustment.cross_validation import FOLDS
from neurocal_cli.adjustment.problem import normalised
from neurocal_cli.adjustment.repeated_poses import RepeatedPoses, repeated_poses
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.camera.state import CameraState


def repeats(found: Calibration) -> RepeatedPoses:
    views = arrange(found.points)
    R, t = (np.stack(list(v.values())) for v in (found.rotations, found.translations))
    camera = found.camera
    state = CameraState(
        np.array([camera.entries]), R, t, camera.distortion.model, camera.distortion.coefficients
    )
    state = normalised(state, views)
    return repeated_poses(views, state, point_residuals(views, state))


@pytest.mark.parametrize("own", [0.01, 0.03, 0.1])
def test_frames_of_a_still_video_are_as_many_views_as_they_have_poses(own: float) -> None:
    found = repeats(calibrate(frames(6, 4, np.random.default_rng(1), own), distortion="k1k2p1p2"))
    assert (found.group == np.repeat(np.arange(6), 4)).all()
    # What a pose's frames share is 0.12 px of the noise.
    assert found.correlation == pytest.approx(0.12**2 / (0.12**2 + own**2), abs=0.08)
    assert (found.folds(FOLDS) == np.repeat([0, 1, 2, 3, 4, 0], 4)).all()


def test_photographs_from_a_tripod_average() -> None:
    rng = np.random.default_rng(2)
    still = [pose for pose in poses(6, rng) for _ in range(4)]
    found = repeats(calibrate(photographed(still, rng), distortion="k1k2p1p2"))
    assert found.n_poses == 6
    assert found.correlation < 0.05
    assert found.worth > 0.85


@pytest.mark.parametrize("f", slow_but((3000.0,), [700.0, 3000.0]))
def test_views_of_different_poses_are_never_the_same(f: float) -> None:
    scene = random_flat_set(np.random.default_rng(3), 1000, False, cols=6, rows=5, f=f, width=1280)
    points = scene.points(0.5, np.random.default_rng(4))
    views = arrange(points)
    state = scene.true_state(views)
    assert repeated_poses(views, state, point_residuals(views, state)).none


def test_a_slow_video_is_more_than_one_pose() -> None:
    still = photographed(poses(1, np.random.default_rng(5)), np.random.default_rng(6), noise=0.0)
    views = arrange(replace_pixels(still, 60, step=0.5))
    state = CameraState(np.array([[5.0, 0, 5.0, 0, 0]]), np.tile(np.eye(3), (60, 1, 1)), np.zeros((60, 3)))
    state.t[:, 2] = 3.0
    state.t[:, 0] = np.arange(60) * 0.5 / views.pixel_scale * 3.0 / 5.0
    found = repeated_poses(views, state, np.full((len(views.index), 2), 1e-9))
    assert 60 / 3 <= found.n_poses <= 60 / 2


def replace_pixels(still: Correspondences, n: int, step: float) -> Correspondences:
    world = np.tile(still.world, (n, 1))
    pixels = np.tile(still.pixels, (n, 1)) + step * np.repeat(np.arange(n), len(still))[:, None] * [1.0, 0.0]
    return Correspondences(world, pixels, np.repeat([f"f{k:02d}" for k in range(n)], COLS * ROWS))


@pytest.mark.parametrize("own", slow_but((0.02,), (0.02, 0.01, 0.1)))
def test_the_std_of_frames_is_that_of_their_poses(own: float) -> None:
    """Twelve frames of each pose, whose errors are nearly the same, know hardly more than one."""
    errors = []
    for seed in range(12):
        found = calibrate(frames(6, 8, np.random.default_rng([seed, 7]), own), distortion="k1k2p1p2")
        errors.append((found.intrinsics.alpha_u - ALPHA) / found.std["alpha_u"])
    # Twelve draws know a standard deviation to a fifth; those of 48 independent views would be 2.5 times too
    # small.
    assert np.sqrt(np.mean(np.square(errors))) < 1.6


def test_frames_do_not_ask_for_coefficients_that_their_poses_do_not() -> None:
    found = [calibrate(frames(5, 8, np.random.default_rng([seed, 8]), 0.02)) for seed in range(2)]
    # Of five poses, a fisheye's two coefficients predict as well as k1 and k2.
    assert all(c.distortion_model in ("k1k2", "k1k2p1p2", "plumb_bob", "fisheye") for c in found)
    assert all("40 views show only 5 different poses" in " ".join(c.verdict.reasons) for c in found)
    assert not any("poses" in " ".join(c.warnings) for c in found)  # the verdict says it


def test_sixty_frames_of_five_poses(real_files: RealFiles) -> None:
    found = calibrate(read_points(real_files("wrong_data/frames.csv")[0]))
    assert found.distortion_model in ("k1k2p1p2", "plumb_bob")
    assert abs(found.intrinsics.alpha_u - 1000) < 3 * found.std["alpha_u"]
    assert found.verdict.word == "usable"
    assert any(reason.startswith("60 views show only 5 different poses") for reason in found.verdict.reasons)

"""Few views, whose contradictions an estimated board takes in; and many views of few points each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.distorted import through
from support.scenes import random_flat_set
from support.targets import SIZE, offsets, views_of

from neurocal_cli import Correspondences, calibrate
from neurocal_cli.camera.geometry import Array, rotation_step

CENTRE = (np.array(SIZE) - 1) / 2
TRUE = np.array([1000.0, 1000.0, *CENTRE])
Change = Callable[[Correspondences, int], Correspondences]


def views(n: int, seed: int) -> Correspondences:
    """Views of a board whose points are off by 0.15 mm rms."""
    rng = np.random.default_rng([seed, n, 41])
    K = np.array([[1000.0, 0.0, CENTRE[0]], [0.0, 1000.0, CENTRE[1]], [0.0, 0.0, 1.0]])
    off = offsets("both", 0.15, rng)
    points, *_ = views_of(K, np.array([-0.2, 0.08]), "k1k2", lambda: off, n, 0.1, rng)
    return points


def moving(points: Correspondences, seed: int) -> Correspondences:
    """The camera moves by about a pixel while the rows of each half image are read."""
    by = np.random.default_rng([seed, 7]).standard_normal((points.n_views, 2))
    rows = points.pixels[:, 1:] / CENTRE[1] - 1
    return replace(points, pixels=points.pixels + by[points.view_index] * rows)


def stabilised(points: Correspondences, seed: int) -> Correspondences:
    """The centre of each view's own is off by about three pixels."""
    by = 3.0 * np.random.default_rng([seed, 6]).standard_normal((points.n_views, 2))
    return replace(points, pixels=points.pixels + by[points.view_index])


def over_std(points: Correspondences) -> Array:
    """Errors of alpha_u, alpha_v, u0 and v0 over their std, where the verdict is better than poor."""
    found = calibrate(points)
    assert found.target is not None
    A, std = found.intrinsics, found.std
    known = np.array([std["alpha_u"], std["alpha_v"], std["u0"], std["v0"]])
    good = found.verdict is not None and found.verdict.word != "poor"
    return np.array(good * (np.array([A.alpha_u, A.alpha_v, A.u0, A.v0]) - TRUE) / known)


def test_a_board_from_five_views_hides_no_motion_of_the_camera() -> None:
    """Without the jackknife over views, these errors are up to 15 standard deviations."""
    errors = [over_std(moving(views(5, seed), seed)) for seed in range(4)]
    assert np.abs(errors).max() < 4
    assert np.sqrt(np.mean(np.square(errors))) < 2


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 4, 5])
@pytest.mark.parametrize("change", [moving, stabilised])
def test_hardly_a_result_of_few_views_is_far_beyond_its_std(n: int, change: Change) -> None:
    """Without the jackknife over views, 9 of these 120 are beyond 5 std and the largest by 15."""
    errors = np.array([over_std(change(views(n, seed), seed)) for seed in range(20)])
    assert np.count_nonzero(np.abs(errors).max(axis=1) > 5) <= 1
    assert np.sqrt(np.mean(errors**2)) < 2


@pytest.mark.parametrize("kept", [(0, 8, 54, 62), (0, 8, 31, 54, 62)])
def test_views_of_few_points_show_the_lens_and_agree(kept: tuple[int, ...]) -> None:
    """As of a single marker. With a lens that distorts, a camera of its own fits five points exactly."""
    rng = np.random.default_rng([len(kept), 5])
    K = np.array([[1000.0, 0.0, CENTRE[0]], [0.0, 1000.0, CENTRE[1]], [0.0, 0.0, 1.0]])
    whole, *_ = views_of(K, np.array([-0.2, 0.08]), "k1k2", lambda: np.zeros((63, 3)), 30, 0.1, rng)
    found = calibrate(whole.select(np.isin(np.arange(len(whole)) % 63, kept)))
    std = np.array([found.std[name] for name in ("alpha_u", "alpha_v", "u0", "v0")])
    A = found.intrinsics
    assert found.distortion_model != "none"
    assert np.abs((np.array([A.alpha_u, A.alpha_v, A.u0, A.v0]) - TRUE) / std).max() < 4
    assert std.max() < 3
    assert not found.n_rejected  # points that weigh little have larger residuals than the others
    assert found.verdict is not None
    assert found.verdict.word == "good", found.verdict.reasons


def test_noise_of_few_views_of_nine_points_is_no_outlier() -> None:
    """What agrees best of so few points halves the error, or is less than half of them."""
    board = np.array([[x, y, 0.0] for y in (-60, 0, 60) for x in (-60, 0, 60)])
    for n, seed in ((5, 131), (8, 7)):
        rng, pixels = np.random.default_rng([seed, n]), []
        for _ in range(n):
            R, t = rotation_step(0.35 * rng.standard_normal(3)), rng.uniform([-100, -70, 350], [100, 70, 700])
            seen = board @ R.T + t
            pixels.append(800 * seen[:, :2] / seen[:, 2:] + [320, 240] + 0.1 * rng.standard_normal((9, 2)))
        view = np.repeat(np.arange(n), 9)
        points = Correspondences(np.tile(board, (n, 1)), np.concatenate(pixels), view, image_size=(640, 480))
        assert not calibrate(points).n_rejected


def test_an_outlier_that_hides_the_lens_is_found_among_few_points() -> None:
    rng = np.random.default_rng([28, 77])
    n = int(rng.integers(5, 16))
    scene = random_flat_set(rng, n, False, cols=3, rows=3, f=float(rng.uniform(700, 1600)), width=1280)
    points = through(scene, "k1k2", [-0.05, 0.01]).points(0.3, rng)
    rng.integers(1, 4)
    wrong = rng.choice(len(points), 1, replace=False)
    pixels = points.pixels.copy()
    pixels[wrong] += rng.normal(0, 15, (1, 2))
    found = calibrate(replace(points, pixels=pixels), skew=False)
    assert found.distortion_model == "k1"  # with the outlier, none
    assert set(wrong) <= set(found.rejected.rows.tolist())

"""Tsai's two stages: exact without noise, one view and several, flat and solid; biased with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.distorted import sees, through
from support.plain_projection import project
from support.scenes import TABLE_1_CAMERA, Scene, random_flat_set, random_solid, table_1

from neurocal_cli import Correspondences, Intrinsics, calibrate

SEED = st.integers(0, 10_000)
SQUARE = Intrinsics(556.0, 549.0, 172.0, 121.0)


def seen(scene: Scene, model: str = "none", k: tuple[float, ...] = ()) -> Correspondences:
    """The scene through a lens, with its true centre."""
    K = scene.intrinsics
    return replace(through(scene, model, list(k)).points(), image_center=(K.u0, K.v0))


def corner() -> Scene:
    """Table 1's scene with axes at right angles, as Tsai's method has them."""
    scene = table_1()
    pixels, _ = project(SQUARE.A, scene.poses["view"], scene.world)
    return replace(scene, intrinsics=SQUARE, pixels=pixels)


def check_exact(scene: Scene, points: Correspondences, k1: float, type: int = 1) -> None:
    options = {} if type == 1 else scene.given(type)
    found = calibrate(points, method="tsai", **options)
    assert found.rmse_px < 1e-7
    assert found.intrinsics.values() == pytest.approx(scene.intrinsics.values(), rel=1e-6)
    assert found.distortion == pytest.approx([k1], abs=1e-6)
    for name, view in found.views.items():
        assert np.abs(view.pose.R - scene.poses[name].R).max() < 1e-6


@pytest.mark.parametrize("k1", [0.0, -0.25, 0.1])
@pytest.mark.parametrize("type", [1, 2])
def test_a_solid_target_in_one_view_gives_the_exact_camera_and_k1(k1: float, type: int) -> None:
    check_exact(corner(), seen(corner(), "k1", (k1,)), k1, type)


@settings(max_examples=15, deadline=None)
@given(seed=SEED, k1=st.floats(-0.15, 0.15), n_views=st.integers(1, 6))
def test_flat_boards_give_the_exact_camera_and_k1(seed: int, k1: float, n_views: int) -> None:
    scene = random_flat_set(np.random.default_rng(seed), n_views, False)
    K, name = scene.intrinsics, "view0000"
    # A single board that is tilted about an image axis alone does not tell alpha_v / alpha_u.
    normal = scene.poses[name].R[:, 2]
    assume(n_views > 1 or min(abs(normal[:2])) > 0.15)
    assume(sees(scene, "k1", [k1]).all())
    assert abs(K.alpha_u / K.alpha_v - 1) < 0.05
    check_exact(scene, seen(scene, "k1", (k1,)), k1)


@settings(max_examples=15, deadline=None)
@given(seed=SEED)
def test_solid_targets_anywhere_give_the_exact_camera(seed: int) -> None:
    scene = random_solid(np.random.default_rng(seed), 2, False)
    assume(len(scene.world) >= 12)
    found = calibrate(scene.points(), method="tsai", distortion="none", **scene.given(2))
    assert found.intrinsics.values() == pytest.approx(scene.intrinsics.values(), rel=1e-5)


def test_flat_and_solid_views_together() -> None:
    one, flat = corner(), random_flat_set(np.random.default_rng(1), 2, False, f=556.0, width=352)
    flats = []
    for name, pose in flat.poses.items():
        world = flat.world[np.array(flat.view) == name]
        flats.append((world, project(SQUARE.A, pose, world)[0], [name] * len(world)))
    world, pixels, names = (
        sum((list(part[n]) for part in flats), list(first))
        for n, first in enumerate((one.world, one.pixels, one.view))
    )
    points = Correspondences(np.array(world), np.array(pixels), names, (352, 240), (172.0, 121.0))
    found = calibrate(points, method="tsai", distortion="none")
    assert found.intrinsics.values() == pytest.approx(SQUARE.values(), rel=1e-6)


@pytest.mark.parametrize("n_views", [1, 4])
def test_poses_of_a_given_camera_are_exact(n_views: int) -> None:
    scene = random_flat_set(np.random.default_rng(2), n_views, True)
    for one in (scene, table_1()):
        found = calibrate(one.points(), method="tsai", **one.given(3))
        assert found.rmse_px < 1e-7


def test_what_is_taken_for_given_has_no_std() -> None:
    found = calibrate(seen(corner()), method="tsai", distortion="k1")
    assert found.fixed == {"u0", "v0", "theta"}
    assert found.std["u0"] == found.std["theta"] == 0.0
    assert found.std["alpha_u"] > 0
    assert any("takes the image centre for known" in text for text in found.warnings)
    assert TABLE_1_CAMERA.theta != SQUARE.theta


def turns(method: str, trials: int, **options: object) -> np.ndarray:
    """Errors of R_x over trials with 2 px of noise, in standard deviations of least squares."""
    scene, rng = corner(), np.random.default_rng(3)
    true, found = scene.poses["view"].euler[0], []
    for _ in range(trials):
        points = replace(scene.points(2.0, rng), image_center=(172.0, 121.0))
        view = calibrate(points, method=method, distortion="none", **options).views["view"]  # type: ignore[arg-type]
        found.append((view.pose.euler[0] - true) / view.std["R_x"])
    return np.array(found)


@pytest.mark.slow
def test_with_noise_its_angles_are_biased_and_those_of_least_squares_are_not() -> None:
    """A mean of 80 errors has a standard deviation of a ninth of theirs."""
    given = {"type": 2, "image_center": (172.0, 121.0), "skew": False}
    least = turns("nonlinear", 80, **given)
    assert abs(least.mean()) < 3.5 * least.std() / np.sqrt(80)
    two_stages = turns("tsai", 80)
    assert abs(two_stages.mean()) > 4 * two_stages.std() / np.sqrt(80)
    assert np.sqrt((two_stages**2).mean()) > 1.3

"""Standard deviations of a camera whose distortion model was chosen carry what the choice leaves open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import trapezoid
from support.campaign import scene as campaign_scene
from support.distorted import bent_set, through
from support.scenes import random_flat_set

from neurocal_cli import calibrate
from neurocal_cli.adjustment.normal_equations import Arrowhead
from neurocal_cli.adjustment.open_choices import OpenPrior, spread_of_open
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.camera.geometry import Array


def gaussian(x: Array, sigma: float) -> Array:
    return np.asarray(np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma))


def test_what_was_left_out_makes_the_camera_less_certain_than_its_model_by_name() -> None:
    scene, _ = bent_set("k1k2", 5)
    points = scene.points(0.2, np.random.default_rng(0))
    chosen = calibrate(points, skew=False, target="given")
    named = calibrate(points, skew=False, target="given", distortion=chosen.distortion_model)
    assert chosen.distortion_model == "k1k2"
    assert chosen.intrinsics.alpha_u == pytest.approx(named.intrinsics.alpha_u, rel=1e-5)
    assert all(chosen.std[name] >= 0.999 * named.std[name] for name in chosen.std)
    assert chosen.std["k2"] > 1.2 * named.std["k2"]


def test_the_spread_is_the_mean_square_around_what_is_reported() -> None:
    """One coefficient, absent or of either size: by numerical integration over its density."""
    precision, size, odds, one = 40.0, 0.2, {3.0: 1.5, 0.3: 1.5}, np.array([True])
    for value, gradient in ((0.0, 5.0), (0.3, 0.0)):  # left out, and estimated
        left_out = one & (value == 0.0)
        prior = OpenPrior(one, left_out, np.array([value]), np.array([size]), (np.array([0]),), (odds,))
        x = np.linspace(-6.0, 6.0, 240_001)
        likelihood = np.exp(gradient * (x - value) - 0.5 * precision * (x - value) ** 2)
        absent = np.interp(0.0, x, likelihood)
        second, total = absent * value**2, absent
        for factor, its in odds.items():
            density = its * likelihood * gaussian(x, factor * size)
            second += trapezoid(density * (x - value) ** 2, x)
            total += trapezoid(density, x)
        arrow = Arrowhead.alone(np.array([[precision]]), np.array([gradient]), 0.0)
        spread = spread_of_open(arrow, 1.0, prior)
        assert spread is not None
        already = 0.0 if value == 0.0 else 1.0 / precision
        assert spread.E[0, 0] == pytest.approx(second / total - already, rel=1e-6)
        assert spread.probability == pytest.approx(1.0 - absent / total, rel=1e-6)


@pytest.mark.parametrize("seed", [950084, 950207])
def test_a_small_k3_does_not_tell_that_p1_and_p2_are_small(seed: int) -> None:
    points, truth = campaign_scene(seed)  # p2, or both, are 4.5 to 6 times the typical size
    found = calibrate(points)
    assert found.distortion_model == "k1"
    assert abs(found.intrinsics.u0 - truth.A[0, 2]) < 4 * found.std["u0"]  # 4.9 and 5.2 with one size for all
    assert abs(found.intrinsics.v0 - truth.A[1, 2]) < 4 * found.std["v0"]


@pytest.mark.slow
@pytest.mark.parametrize(("n_views", "sigma"), [(12, 0.3), (6, 0.3), (12, 0.1)])
def test_std_hold_where_small_coefficients_are_left_out(n_views: int, sigma: float) -> None:
    z: dict[str, list[float]] = {}
    for seed in range(200):
        rng = np.random.default_rng([seed, 19])
        scene = random_flat_set(rng, n_views, False, f=550.0, width=640, cols=9, rows=6)
        k = [
            rng.uniform(-0.2, -0.1),
            rng.uniform(0.02, 0.1),
            *rng.uniform(-1e-3, 1e-3, 2),
            rng.uniform(-0.03, 0.03),
        ]
        points = through(scene, "plumb_bob", k).points(sigma, rng)
        found = calibrate(points, skew=False, target="given")
        if found.distortion_model == "fisheye":
            continue
        K = scene.intrinsics
        truth = {"alpha_u": K.alpha_u, "alpha_v": K.alpha_v, "u0": K.u0, "v0": K.v0}
        truth |= dict(zip(("k1", "k2", "p1", "p2", "k3"), k, strict=True))
        names = coefficient_names(found.distortion_model)
        camera = vars(found.intrinsics) | dict(zip(names, found.distortion, strict=True))
        for name in truth.keys() & found.std.keys():
            z.setdefault(name, []).append((camera[name] - truth[name]) / found.std[name])
    rms = {name: np.sqrt(np.square(values).mean()) for name, values in z.items()}
    assert all(0.85 < rms[name] < 1.2 for name in ("alpha_u", "alpha_v", "u0", "v0", "k1", "k2")), rms
    # Taken in few sets, and rather where noise makes them large.
    assert all(rms[name] < 1.2 + 2 / np.sqrt(2 * len(z[name])) for name in ("p1", "p2", "k3") if name in z), (
        rms
    )

"""Standard deviations of a camera whose distortion model was chosen carry what the choice leaves open."""

from __future__ import annotations

import numpy as np
import pytest
from support.distorted import bent_set, through
from support.scenes import random_flat_set

from neurocal_cli import calibrate


def test_what_was_left_out_makes_the_camera_less_certain_than_its_model_by_name() -> None:
    scene, _ = bent_set("k1k2", 5)
    points = scene.points(0.2, np.random.default_rng(0))
    chosen = calibrate(points, skew=False, target="given")
    named = calibrate(points, skew=False, target="given", distortion=chosen.distortion_model)
    assert chosen.distortion_model == "k1k2"
    assert chosen.intrinsics.alpha_u == pytest.approx(named.intrinsics.alpha_u, rel=1e-5)
    assert all(chosen.std[name] >= 0.999 * named.std[name] for name in chosen.std)
    assert chosen.std["k2"] > 1.2 * named.std["k2"]


@pytest.mark.slow
def test_std_hold_where_small_coefficients_are_left_out() -> None:
    z = []
    for seed in range(200):
        rng = np.random.default_rng([seed, 19])
        scene = random_flat_set(rng, 12, False, f=550.0, width=640, cols=9, rows=6)
        k = [
            rng.uniform(-0.2, -0.1),
            rng.uniform(0.02, 0.1),
            *rng.uniform(-1e-3, 1e-3, 2),
            rng.uniform(-0.03, 0.03),
        ]
        points = through(scene, "plumb_bob", k).points(0.3, rng)
        found = calibrate(points, skew=False, target="given")
        K = scene.intrinsics
        errors = [
            found.intrinsics.alpha_u - K.alpha_u,
            found.intrinsics.u0 - K.u0,
            found.intrinsics.v0 - K.v0,
        ]
        z.append(np.array(errors) / [found.std[name] for name in ("alpha_u", "u0", "v0")])
    rms = np.sqrt((np.array(z) ** 2).mean(axis=0))
    assert ((rms > 0.8) & (rms < 1.2)).all()

"""Where distortion models are monotonic, and their inverse there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.distorted import LENSES

from neurocal_cli.camera.distortion import (
    Distortion,
    distort,
    distort_with_jacobian,
)
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import (
    is_monotonic,
    monotonic_radius,
    nearly_undistorted,
    undistort,
)

SPREAD = {
    "k1": [0.4],
    "k1k2": [0.4, 0.3],
    "plumb_bob": [0.4, 0.3, 0.003, 0.003, 0.2],
    "rational": [0.4, 0.3, 0.003, 0.003, 0.2, 0.5, 0.3, 0.1],
    "fisheye": [0.1, 0.1, 0.05, 0.02],
}


def without_tangential(model: str, k: Array) -> Array:
    """Near a fold, where hardly anything is left of the slope, tangential terms make one of their own."""
    return k * [1, 1, 0, 0, 1, 1, 1, 1][: len(k)] if model in ("plumb_bob", "rational") else k


@given(st.sampled_from(list(SPREAD)), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_whatever_a_lens_sees_comes_back(model: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    lens = Distortion(model, without_tangential(model, rng.normal(size=len(SPREAD[model])) * SPREAD[model]))
    r, angle = rng.uniform(0, min(0.95 * monotonic_radius(lens), 2.0), 100), rng.uniform(0, 2 * np.pi, 100)
    x, y = r * np.cos(angle), r * np.sin(angle)
    back = np.array(undistort(lens, *distort(model, lens.coefficients, x, y)))
    assert is_monotonic(lens, x, y).all()
    assert back == pytest.approx(np.array([x, y]), abs=1e-8)


@given(st.sampled_from(list(SPREAD)), st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_the_slope_is_positive_up_to_the_fold_and_not_beyond(model: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    k = without_tangential(model, rng.normal(size=len(SPREAD[model])) * SPREAD[model])
    fold = monotonic_radius(Distortion(model, k))
    r = np.linspace(0, min(fold, 50.0), 300)[1:-1]
    with np.errstate(all="ignore"):
        _, (slope, *_), _ = distort_with_jacobian(model, k, r, np.zeros_like(r))
        assert (slope > 0).all()
        if fold < 50:
            _, (beyond, *_), _ = distort_with_jacobian(model, k, np.array([fold * (1 + 1e-6)]), np.zeros(1))
            pole = not np.isfinite(beyond[0]) or beyond[0] > 1e3
            assert pole or beyond[0] < 1e-3


@pytest.mark.parametrize("model", LENSES)
def test_real_lenses_come_back(model: str) -> None:
    x, y = np.random.default_rng(1).uniform(-0.6, 0.6, (2, 50))
    lens = Distortion(model, LENSES[model])
    back = undistort(lens, *distort(model, lens.coefficients, x, y))
    assert np.array(back) == pytest.approx(np.array([x, y]), abs=1e-11)


def test_the_fold_of_a_barrel_lens() -> None:
    assert monotonic_radius(Distortion("k1", [-0.3])) == pytest.approx(1 / np.sqrt(0.9), rel=1e-12)
    assert monotonic_radius(Distortion("k1", [0.3])) == np.inf
    assert monotonic_radius(Distortion()) == np.inf


def test_a_pole_of_the_rational_lens_is_a_fold() -> None:
    assert monotonic_radius(Distortion("rational", [0.5, 0, 0, 0, 0, -0.25])) == pytest.approx(2.0)


def test_false_points_beyond_the_fold_are_not_found() -> None:
    """With k2 < 0 as well a pixel outside of everything is the image of a point on the other side."""
    x, _ = undistort(Distortion("k1k2", [-0.3, -0.1]), np.array([0.3, 4.0]), np.zeros(2))
    assert np.isfinite(x[0])
    assert np.isnan(x[1])


@pytest.mark.parametrize("model", LENSES)
def test_a_point_nearby_leads_to_the_same_point_and_never_to_a_false_one(model: str) -> None:
    x, y = np.random.default_rng(1).uniform(-0.6, 0.6, (2, 50))
    lens = Distortion(model, LENSES[model])
    distorted = distort(model, lens.coefficients, x, y)
    for off in (0.01, 5.0):
        back = undistort(lens, *distorted, near=(x + off, y - off))
        assert np.array(back) == pytest.approx(np.array([x, y]), abs=1e-11)
    assert np.array(nearly_undistorted(lens, *distorted)) == pytest.approx(np.array([x, y]), abs=2e-3)

"""The models of edges, vertices and maps, and their derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.maps import some_map
from support.slow_cases import slow_but

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import ProfileShape
from neurocal_cli.detection.fitting.edge_fit import EdgePixels, edge_model
from neurocal_cli.detection.fitting.edge_profile import (
    PIXEL,
    RESPONSE_TERMS,
    box_kurtosis,
    box_profile,
    erf_and_density,
    half_widths,
    profile,
    response,
    response_terms,
    tail_terms,
)
from neurocal_cli.detection.fitting.smooth_map import homography_start
from neurocal_cli.detection.fitting.vertex_fit import VertexPixels, vertex_model

STEP = 1e-5


def slope(function: Callable[[Array], Array], x: Array) -> Array:
    return (function(x + STEP) - function(x - STEP)) / (2 * STEP)


def test_error_function_is_exact_to_nine_digits() -> None:
    z = np.linspace(-12, 12, 40001)
    value, density = erf_and_density(z)
    exact = np.array([math.erf(x / math.sqrt(2)) for x in z])
    assert np.abs(value - exact).max() < 1e-9
    np.testing.assert_allclose(density, np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi), rtol=1e-12)
    single, _ = erf_and_density(z.astype(np.float32))
    assert single.dtype == np.float32
    assert np.abs(single - exact).max() < 5e-7


def test_profile_has_the_slope_it_says() -> None:
    z = np.linspace(-5, 5, 100)[None]  # not 0, where the error function's own error jumps
    tails = np.array([[0.03, -0.01]])
    value, steep, density = profile(z, tails)
    np.testing.assert_allclose(steep, slope(lambda x: profile(x, tails)[0], z), atol=2e-9)
    plain = profile(z, np.zeros((1, 2)))[0]
    terms = np.empty((1, 2, z.shape[1]))
    tail_terms(z, density, out=terms)
    np.testing.assert_allclose(value[0], plain[0] + tails[0] @ terms[0], atol=1e-14)


def test_response_keeps_the_levels_and_has_the_slope_it_says() -> None:
    nonlinearity = np.array([0.2, -0.1, 0.05, 0.02, -0.03, 0.01])
    assert len(nonlinearity) == RESPONSE_TERMS
    x = np.linspace(-1, 1, 51)
    value, steep = response(x, nonlinearity)
    assert value[0] == -1
    assert value[-1] == 1
    np.testing.assert_allclose(steep, slope(lambda t: response(t, nonlinearity)[0], x), atol=1e-8)
    terms = np.empty((1, len(nonlinearity), x.size))
    response_terms(x.reshape(1, -1), np.ones((1, x.size)), out=terms)
    np.testing.assert_allclose(value.reshape(-1), x.reshape(-1) + nonlinearity @ terms[0], atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4])
@pytest.mark.parametrize("psf", [0.5, 0.8])
def test_pixel_box_is_in_the_profile(angle: float, psf: float) -> None:
    normal = np.array([[np.cos(angle), np.sin(angle)]])
    sigma = np.sqrt(psf**2 + 1 / 12)
    d = np.linspace(-3, 3, 61)
    fine = (np.arange(200) + 0.5) / 200 - 0.5
    across = normal[0, 0] * fine[:, None] + normal[0, 1] * fine
    blurred = np.array([erf_and_density((x + across) / psf)[0].mean() for x in d])
    tails = np.array([[box_kurtosis(normal, np.array([sigma]))[0], 0.0]])
    with_box = np.abs(profile(d[None] / sigma, tails)[0][0] - blurred).max()
    without = np.abs(profile(d[None] / sigma, 0 * tails)[0][0] - blurred).max()
    assert with_box < 1e-3
    assert with_box < 0.3 * without


def some_edges() -> tuple[EdgePixels, Array, ProfileShape]:
    rng = np.random.default_rng(1)
    E, N = 3, 60
    s, d = rng.uniform(-15, 15, (E, N)), rng.uniform(-3, 3, (E, N))
    value, gain, Q, R = (
        rng.uniform(low, high, (E, N)) for low, high in ((20, 230), (0.9, 1.1), (0.5, 1), (-0.5, 0.5))
    )
    data = EdgePixels(value, gain, Q, np.ones((E, N)), s / 15, d, R)  # type: ignore[arg-type]
    values = np.column_stack(
        [
            rng.normal(0, 0.3, E),
            rng.normal(0, 0.2, E),
            np.full(E, 120.0),
            np.full(E, 90.0),
            rng.uniform(0.6, 1.2, E),
        ]
    )
    shape = ProfileShape(np.tile([0.02, -0.005], (E, 1)), np.array([0.1, -0.05, 0.02, 0.01]))
    return data, values, shape


@pytest.mark.parametrize("angle", slow_but((0.4,), [0.0, 0.01, 0.4, np.pi / 4]))
@pytest.mark.parametrize("psf", [0.05, 0.2, 0.34])
def test_box_profile_is_that_of_a_pixel(angle: float, psf: float) -> None:
    normal = np.array([[np.cos(angle), np.sin(angle)]])
    half, sigma = half_widths(normal), np.array([[math.sqrt(psf**2 + PIXEL)]])
    d = np.linspace(-2, 2, 81)[None]
    value, steep, widening = box_profile(d, sigma, half)
    inside = (np.arange(200) + 0.5) / 200 - 0.5
    places = (inside[:, None] * normal[0, 0] + inside * normal[0, 1]).ravel()
    exact = np.array([erf_and_density((x + places) / psf)[0].mean() for x in d[0]])
    np.testing.assert_allclose(value[0], exact, atol=2e-4)
    np.testing.assert_allclose(steep, slope(lambda x: box_profile(x, sigma, half)[0], d), atol=3e-5)
    np.testing.assert_allclose(widening, slope(lambda x: box_profile(d, x, half)[0], sigma), atol=1e-4)
    single = box_profile(d.astype(np.float32), sigma.astype(np.float32), half)
    assert single[0].dtype == np.float32
    np.testing.assert_allclose(single[0], value, atol=3e-5)


@pytest.mark.parametrize("sharp", [False, True])
def test_edge_model_has_the_derivatives_it_says(sharp: bool) -> None:
    data, values, shape = some_edges()
    if sharp:
        angle = np.arange(len(values)) * 0.3
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        shape, values[:, 4] = replace(shape, half=half_widths(normal)), 0.33
    linear = edge_model(data, values, shape)
    for k in range(5):
        h = np.zeros(5)
        h[k] = STEP
        ahead, behind = (edge_model(data, values + sign * h, shape).residual for sign in (1, -1))
        # The error function's own error is 1e-9, and differences of it over the box make more of that.
        atol = 2e-4 if sharp else 3e-6
        np.testing.assert_allclose(linear.rows[:, 1 + k], (behind - ahead) / (2 * STEP), atol=atol)


def some_vertices() -> tuple[VertexPixels, Array, ProfileShape]:
    rng = np.random.default_rng(2)
    V, N = 3, 80
    s1, d1, s2, d2 = rng.uniform(-3, 3, (4, V, N))
    value, gain, Q = rng.uniform(20, 230, (V, N)), rng.uniform(0.9, 1.1, (V, N)), rng.choice([-1, 1], (V, N))
    rho = np.array([[0.0], [0.3], [-0.9]])
    relative = np.array([[1.0, 1.0], [0.9, 1.1], [1.1, 0.9]])
    arrays = (value, gain, Q, np.ones((V, N)), s1 / 3, d1, s2 / 3, d2, rho, relative)
    data = VertexPixels(*arrays)  # type: ignore[arg-type]
    places = rng.normal(0, 0.2, (V, 4))
    values = np.column_stack([places, np.full(V, 120.0), np.full(V, 90.0), rng.uniform(0.6, 1.2, V)])
    shape = ProfileShape(np.tile([0.02, -0.005], (V, 1)), np.array([0.1, -0.05, 0.02, 0.01]))
    return data, values, shape


@pytest.mark.parametrize("sharp", [False, True])
def test_vertex_model_has_the_derivatives_it_says(sharp: bool) -> None:
    data, values, shape = some_vertices()
    if sharp:
        normal = np.array([[0.0, 1.0], [0.6, 0.8], [0.1, np.sqrt(0.99)]])
        half = half_widths(normal)
        shape, values[:, 6] = replace(shape, half=np.stack([half, half], axis=1)), 0.36
    linear = vertex_model(data, values, shape)
    for k in range(7):
        h = np.zeros(7)
        h[k] = STEP
        ahead, behind = (vertex_model(data, values + sign * h, shape).residual for sign in (1, -1))
        atol = 2e-4 if sharp else 3e-6
        np.testing.assert_allclose(linear.rows[:, 1 + k], (behind - ahead) / (2 * STEP), atol=atol)


@pytest.mark.parametrize("motion", slow_but((0.7,), [0.0, 0.7]))
@pytest.mark.parametrize("angle", slow_but((0.3, 1.0), [0.3, 0.6, 1.0]))
def test_blurred_oblique_cross_is_as_modelled(angle: float, motion: float) -> None:
    """sign(a . x) sign(b . x) blurred by a Gaussian, against a sum over many random points."""
    rng = np.random.default_rng(3)
    along = np.array([0.6, 0.8])
    cloud = rng.normal(size=(400_000, 2)) + motion * rng.normal(size=(400_000, 1)) * along
    a, b = np.array([0.0, 1.0]), np.array([np.cos(angle), np.sin(angle)])
    places = rng.uniform(-1.5, 1.5, (12, 2))
    exact = [(np.sign((cloud + p) @ a) * np.sign((cloud + p) @ b)).mean() for p in places]
    d1, d2 = (places @ a)[None], (places @ b)[None]
    one, zero = np.ones_like(d1), np.zeros_like(d1)
    S = np.eye(2) + motion**2 * np.outer(along, along)
    blur = np.sqrt([[a @ S @ a, b @ S @ b]])
    rho = np.array([[a @ S @ b]]) / blur.prod()
    relative = blur / blur.mean()
    data = VertexPixels(zero, one, one, one, zero, d1, zero, d2, rho, relative)  # type: ignore[arg-type]
    values = np.array([[0, 0, 0, 0, 0, 1, blur.mean()]])
    shape = ProfileShape(np.zeros((1, 2)), np.zeros(RESPONSE_TERMS))
    linear = vertex_model(data, values, shape)
    np.testing.assert_allclose(linear.x[0], exact, atol=0.006)


@pytest.mark.parametrize("radial", [3, 4, 5])
def test_map_has_the_derivatives_it_says(radial: int) -> None:
    now = some_map(radial=radial)
    grid = np.random.default_rng(5).uniform(0, 8, (20, 2))
    direction = np.random.default_rng(6).normal(size=(2, 20))
    direction /= np.hypot(*direction)
    value, jacobian = now.along(now.places(grid, direction))
    np.testing.assert_allclose(value, (now.at(grid).T * direction).sum(axis=0), atol=1e-10)
    for k in range(len(now.parameters)):
        h = np.zeros(len(now.parameters))
        h[k] = STEP
        ahead, behind = (replace(now, parameters=now.parameters + sign * h).at(grid).T for sign in (1, -1))
        expected = ((ahead - behind) * direction).sum(axis=0) / (2 * STEP)
        np.testing.assert_allclose(jacobian[k], expected, atol=1e-5)


def test_map_keeps_what_another_form_shares_with_it() -> None:
    now = some_map(4)
    grid = np.random.default_rng(6).uniform(0, 8, (20, 2))
    np.testing.assert_allclose(now.with_model(3, 6).at(grid), now.at(grid), atol=1e-10)
    np.testing.assert_array_equal(now.with_model(3, 6).with_model(3, 4).parameters, now.parameters)
    plain = now.with_model(0, 0)
    assert not plain.parameters[8:].any()


def test_homography_is_found_by_least_squares() -> None:
    now = some_map().with_model(0, 0)
    grid = np.random.default_rng(7).uniform(0, 8, (12, 2))
    again = homography_start(now.frame, grid, now.at(grid))
    np.testing.assert_allclose(again.parameters, now.parameters, atol=1e-10)

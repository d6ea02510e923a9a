"""Fitting maps, gathering pixels, levels: the parts that measuring is made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.maps import some_map

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.detection.fitting.batched_newton import (
    BLUR,
    BatchFit,
    FitPixels,
    LevelPrior,
    Linearised,
    ProfileShape,
    fit_batch,
    rows_for,
)
from neurocal_cli.detection.fitting.common_parameters import BoardBlur, with_shift
from neurocal_cli.detection.fitting.edge_profile import profile, response
from neurocal_cli.detection.fitting.map_fit import Observations, fit_map, select_map
from neurocal_cli.detection.fitting.shading import Levels, Nearby, fit_shading
from neurocal_cli.detection.fitting.smooth_map import Frame, SmoothMap, homography_start
from neurocal_cli.detection.fitting.strips import grid_lines, strip_pixels
from neurocal_cli.detection.medians import upper_median

GRID = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)


def test_map_is_fitted_through_outliers_with_a_true_covariance() -> None:
    true = some_map(0).with_model(2, 0)
    squares = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        pixels = true.at(GRID) + rng.normal(0, 0.01, GRID.shape)
        pixels[:4] += rng.normal(0, 5, (4, 2))
        start = homography_start(true.frame, GRID, true.at(GRID)).with_model(2, 0)
        fit = fit_map(start, Observations.of_points(GRID, pixels, 0.01), np.zeros(0))
        assert set(np.flatnonzero(fit.weight == 0)) <= {*range(4), *range(54, 58)}
        direction = np.tile([0.6, 0.8], (len(GRID), 1))
        error = ((fit.map.at(GRID) - true.at(GRID)) * direction).sum(axis=1)
        squares.append((error**2 / fit.map.variance(GRID, direction)).mean())
    assert np.mean(squares) == pytest.approx(1, abs=0.3)


def test_anchors_do_not_decide_what_is_an_outlier() -> None:
    """Edges of an uneven board far outside their own variances, and more anchors that are all in place."""
    true = some_map(0).with_model(0, 0)
    rng = np.random.default_rng(2)
    edges = Observations.of_points(GRID[:20], true.at(GRID[:20]) + rng.normal(0, 0.1, (20, 2)), 0.003)
    anchors = Observations.of_points(GRID, true.at(GRID), 2.0)
    assert edges.joined_with(anchors).informative.tolist() == [True] * 40 + [False] * 108
    fit = fit_map(true, edges.joined_with(anchors), np.zeros(0))
    assert (fit.weight[:40] > 0).all()


def test_form_does_not_follow_the_bumps_of_an_uneven_board() -> None:
    true = some_map(0).with_model(1, 0)
    for seed in range(5):
        pixels = true.at(GRID) + np.random.default_rng(seed).normal(0, 0.1, GRID.shape)
        start = homography_start(true.frame, GRID, pixels)
        chosen = select_map(start, Observations.of_points(GRID, pixels, 0.003), np.zeros(0))
        assert chosen.map.degree == 0
        assert chosen.map.radial <= 1


@pytest.mark.parametrize("sigma", [(0.9, 0.6), (0.6, 0.9), (0.8, 0.8)])
def test_blur_depends_on_the_direction_of_edges(sigma: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    angle = rng.normal(0, 0.1, 60) + np.repeat([0, np.pi / 2], 30)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    true = np.sqrt(normal**2 @ np.square(sigma))
    values = np.ones((60, 5))
    values[:, BLUR] = true * rng.normal(1, 0.01, 60)
    values[7, BLUR] = 3.0  # one is wrong
    information = np.tile(1e6 * np.eye(5), (60, 1, 1))
    prior = LevelPrior(np.ones((60, 3)), np.zeros((60, 3, 3)))
    nothing = np.zeros((60, 1), dtype=np.float32)
    linear = Linearised(rows_for(60, 5, 1, nothing.dtype), nothing, nothing)
    ones = np.ones(60)
    pixels = FitPixels(nothing, nothing, nothing, nothing)
    shape = ProfileShape(np.zeros((60, 2)), np.zeros(1))
    of_pixels = nothing, nothing, linear
    fit = BatchFit(values, information, prior, ones, lambda *_: linear, pixels, shape, ones, *of_pixels)
    blur = BoardBlur.of(fit, normal, ones.astype(bool))
    np.testing.assert_allclose(blur.along(normal), true, rtol=0.08)


def test_fits_settle_where_their_steps_are_too_long() -> None:
    """An arctangent's Gauss-Newton steps from beyond 1.4 lead farther and farther away."""

    def model(pixels: FitPixels, values: Array, shape: ProfileShape) -> Linearised:
        place = values[:, :1]
        rows = np.zeros((len(values), 5, 1), dtype=np.float32)
        rows[:, 0] = -100 * np.arctan(place)
        rows[:, 1] = 100 / (1 + place**2)
        return Linearised(rows, rows[:, 0], rows[:, 0])

    one = np.ones((20, 1), dtype=np.float32)
    pixels = FitPixels(one, one, one, one)
    shape = ProfileShape(np.zeros((20, 2)), np.zeros(1))
    start = np.array([[0.3, 0, 1, 5.0]] * 19 + [[4.0, 0, 1, 5.0]])
    prior = LevelPrior(start[:, 1:].copy(), np.tile(np.eye(3) * 1e3, (20, 1, 1)))
    fit = fit_batch(model, pixels, start, prior, shape, 6)
    np.testing.assert_allclose(fit.values[:, 0], 0, atol=0.01)
    assert fit.step.max() < 0.5


def test_shift_of_alternating_edges_is_told_from_the_map() -> None:
    true = some_map(0).with_model(0, 0)
    rng = np.random.default_rng(1)
    angle = rng.uniform(0, 2 * np.pi, 200)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    grid = rng.uniform(0, [8, 5], (200, 2))
    value = (true.at(grid) * direction).sum(axis=1) + 0.3 + rng.normal(0, 0.003, 200)
    rows = Observations(grid, direction, value, np.full(200, 0.003**2), np.ones((200, 1)))
    fit = fit_map(true, rows, np.zeros(1))
    assert fit.shift[0] == pytest.approx(0.3, abs=5 * np.sqrt(fit.shift_covariance[0, 0]))
    assert np.sqrt(fit.shift_covariance[0, 0]) < 0.0005


@pytest.mark.parametrize("shift", [-0.3, 0.1, 0.3])
def test_a_shift_of_edges_may_be_attributed_to_the_response(shift: float) -> None:
    shape = ProfileShape(np.array([[0.02, 0.0]]), np.array([0.1, -0.05, 0.0, 0.0, 0.0, 0.0]))
    d = np.linspace(-3, 3, 200)
    displaced = response(profile((d[None] - shift) / 0.8, shape.tails)[0], shape.nonlinearity)[0]
    same = response(profile(d[None] / 0.8, shape.tails)[0], with_shift(shape, 0.8, shift).nonlinearity)[0]
    np.testing.assert_allclose(same, displaced, atol=0.015)


@pytest.mark.parametrize(("radial", "degree"), [(0, 0), (1, 0), (3, 0), (3, 4)])
def test_simplest_form_that_follows_is_chosen(radial: int, degree: int) -> None:
    true = some_map(degree).with_model(radial, degree)
    rng = np.random.default_rng(radial + degree)
    pixels = true.at(GRID) + rng.normal(0, 0.003, GRID.shape)
    chosen = select_map(
        homography_start(true.frame, GRID, pixels), Observations.of_points(GRID, pixels, 0.003), np.zeros(0)
    )
    assert chosen.map.radial == radial
    assert degree <= chosen.map.degree <= degree + (degree > 0)
    assert np.abs(chosen.map.at(GRID) - true.at(GRID)).max() < 0.01
    assert chosen.excess == pytest.approx(1, abs=0.4)


def test_the_richest_lens_follows_all_coefficients_behind_pixels_that_are_not_square() -> None:
    camera = Camera(
        Intrinsics(505.0, 495.0, 331.0, 235.0),
        Distortion("plumb_bob", np.array([-0.2, 0.08, 0.012, -0.009, 0.02])),
        (640, 480),
    )
    pose = Pose.from_euler(0.4, -0.3, 0.2, np.array([-4.5, -2.0, 9.0]))
    pixels = camera.project(pose.to_camera(np.column_stack([GRID, np.zeros(len(GRID))])))[0]
    frame = Frame.of(GRID, (640, 480))
    lens = homography_start(frame, GRID, pixels).with_model(*SmoothMap.lens_models[-1])
    fit = fit_map(lens, Observations.of_points(GRID, pixels, 1e-4), np.zeros(0))
    assert np.abs(fit.map.at(GRID) - pixels).max() < 1e-3


def straight(angle: float, size: float = 20.0) -> SmoothMap:
    """A map without perspective, turned by an angle."""
    grid = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    turn = size * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return homography_start(Frame.of(grid, (100, 90)), grid, np.array([48.3, 41.8]) + grid @ turn)


@pytest.mark.parametrize("angle", [0.0, 0.2, 0.8, 1.5, 3.0])
def test_strips_hold_every_pixel_once(angle: float) -> None:
    image = np.arange(90 * 100, dtype=np.uint16).reshape(90, 100)
    lines = grid_lines(straight(angle), np.array([[0.5, 0.0]]), np.array([False]), np.ones(1))
    strips = strip_pixels(image, lines, np.array([4.0]), np.array([[1.5, 1.5]]))
    v, u = np.mgrid[0:90, 0:100]
    du, dv = u - lines.middle[0, 0], v - lines.middle[0, 1]
    s = du * lines.tangent[0, 0] + dv * lines.tangent[0, 1]
    d = du * lines.normal[0, 0] + dv * lines.normal[0, 1]
    expected = image[(np.abs(d) <= 4) & (np.abs(s) <= 10 - 1.5)]
    np.testing.assert_array_equal(np.sort(strips.value[strips.inside]), expected)


def test_strips_hold_no_pixels_outside_the_image() -> None:
    image = np.zeros((90, 100), dtype=np.uint8)
    lines = grid_lines(straight(0.0), np.array([[0.5, 2.3]]), np.array([False]), np.ones(1))
    strips = strip_pixels(image, lines, np.array([6.0]), np.zeros((1, 2)))
    seen = lines.middle[0] + np.stack([strips.u, strips.v], axis=-1)[strips.inside]
    assert len(seen) > 0
    assert (seen > -0.5).all()
    assert (seen < [99.5, 89.5]).all()
    # A part of the strip is beyond the image.
    assert lines.middle[0, 1] + 6 > 89.5 or lines.middle[0, 1] - 6 < -0.5


def test_lines_bend_as_the_map_does() -> None:
    bent = some_map(0)
    centre = np.array([[3.5, 2.0], [7.0, 4.5]])
    vertical = np.array([False, True])
    lines = grid_lines(bent, centre, vertical, np.array([1.0, -1.0]))
    for k in (0, 1):
        t = np.linspace(-0.5, 0.5, 11)[:, None]
        step = np.array([0.0, 1.0]) if vertical[k] else np.array([1.0, 0.0])
        offset = bent.at(centre[k] + t * step) - lines.middle[k]
        s, d = offset @ lines.tangent[k], offset @ lines.normal[k]
        assert np.abs(d - 0.5 * lines.curvature[k] * s**2).max() < 0.01
        assert np.abs(d).max() > 5 * np.abs(d - 0.5 * lines.curvature[k] * s**2).max()
        across = bent.at(centre[k] + 0.1 * step[::-1]) - lines.middle[k]
        assert np.sign(across @ lines.normal[k]) == [1, -1][k]
        assert (lines.crossing[k] @ lines.tangent[k] * [1, -1] > 0).all()


def test_levels_are_fitted_through_hidden_squares() -> None:
    rng = np.random.default_rng(8)
    frame = Frame(np.zeros(2), np.ones(2), np.array([320.0, 240.0]), 400.0)
    place = rng.uniform([100, 100], [540, 380], (40, 2))

    def level(p: Array) -> Array:
        return 200 + 0.1 * (p[:, 0] - 320) - 0.05 * (p[:, 1] - 240)

    values = level(place) + rng.normal(0, 0.2, 40)
    values[:8] = 90
    dark = Levels(place, 0.2 * level(place), np.full(40, 0.04))
    shading = fit_shading(frame, dark, Levels(place, values, np.full(40, 0.04)))
    mean, contrast = shading.at(place)
    assert np.abs(mean + contrast - level(place)).max() < 0.5
    slopes = shading.slopes(place)
    step = 1e-3
    ahead, behind = (shading.at(place + np.array([sign * step, 0])) for sign in (1, -1))
    for k in (0, 1):
        np.testing.assert_allclose(slopes[k][:, 0], (ahead[k] - behind[k]) / (2 * step), atol=1e-8)
    assert shading.spread_at(place).max() < 0.05


def test_levels_in_even_light_are_known_as_if_this_were_known() -> None:
    """Few levels do not tell six coefficients, and polynomials through their noise would move the edges."""
    rng = np.random.default_rng(9)
    frame = Frame(np.zeros(2), np.ones(2), np.array([320.0, 240.0]), 400.0)
    errors = []
    for _ in range(50):
        place, noise = rng.uniform([100, 100], [540, 380], (24, 2)), np.full(24, 0.25)
        dark, light = (Levels(place, level + rng.normal(0, 0.5, 24), noise) for level in (30.0, 220.0))
        errors.append(fit_shading(frame, dark, light).at(place)[0] - 125)
    # The mean of 24 levels has 0.07, and six coefficients 0.18.
    assert np.sqrt(np.square(errors).mean()) < 0.12


def test_levels_on_a_line_are_followed_along_it() -> None:
    """A board of two lines that is half covered may have such squares of one colour only."""
    frame = Frame(np.zeros(2), np.ones(2), np.array([320.0, 240.0]), 400.0)
    place = np.stack([np.linspace(100, 540, 6), np.full(6, 240.0)], axis=1)
    line = Nearby(frame, Levels(place, 50 + 0.1 * place[:, 0], np.ones(6)), 3)
    level, slopes, _ = line.at(place)
    np.testing.assert_allclose(level, line.levels.level, atol=0.1)
    np.testing.assert_allclose(slopes, np.tile([0.1, 0.0], (6, 1)), atol=1e-3)
    assert np.abs(line.off(line.levels)).max() < 0.1


def test_rows_may_be_put_together() -> None:
    rows = Observations.of_points(GRID, GRID, 1.0, 1)
    both = rows.joined_with(replace(rows, value=rows.value + 1))
    assert len(both.value) == 4 * len(GRID)


def test_median_of_an_even_number_is_the_upper_one() -> None:
    assert upper_median(np.array([4.0, 1.0, 3.0, 2.0])) == 3
    assert upper_median(np.array([3.0, 1.0, 2.0])) == 2

"""Measured mid-points and vertices are as good as physics allows, and know how good they are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from support.measured import errors, found, places, take
from support.picture_bound import edge_bound
from support.real_data import RealFiles
from support.slow_cases import slow_but

from neurocal_cli.detection import EDGE_H, EDGE_V, VERTEX, Grid
from neurocal_cli.detection.measuring import measure

# Conditions in which the bound is to be met within a fifth, and those where a factor of two is allowed:
# edges along the pixels, blur as wide as the squares, unknown responses, clipped light, hardly any pixels.
BEST = (
    "base",
    "noise 0.5",
    "noise 5",
    "noise 12",
    "psf 0.15",
    "psf 0.5",
    "poisson",
    "tilt 0",
    "tilt 50",
    "tilt 65",
    "k1 -0.3",
    "k1 -0.4 wide",
    "skew",
    "illumination",
    "vignetting",
    "clutter",
    "narrow margin",
    "two planes",
    "two planes distorted",
    "two planes across",
    "2 Mpx",
    "5 Mpx",
)
GOOD = (
    "straight, psf 0.15",
    "psf 2",
    "psf 3",
    "tilt 75",
    "16 bit",
    "gamma 2.2",
    "srgb",
    "saturated",
    "squares 16",
    "squares 10",
    "squares 6",
    "low contrast",
    "mix",
    "three planes",
    "three planes across",
    "stress 1",
    "stress 2",
)


@pytest.mark.parametrize("name", slow_but(("base",), ("base", "tilt 65", "k1 -0.3")))
def test_midpoints_reach_the_bound(name: str) -> None:
    found_errors = errors(name, range(1))
    assert found_errors.ratio < 1.2
    assert 0.7 < found_errors.normalised < 1.4  # one picture: wider than for eight
    assert found_errors.kept == 1
    assert found_errors.rms < 0.0036


@pytest.mark.parametrize("points", slow_but((), ("midpoints", "vertices")))
def test_edges_sharper_than_a_pixel_reach_the_bound(points: Literal["midpoints", "vertices"]) -> None:
    found_errors = errors("straight, psf 0.15", range(1), points)
    assert found_errors.ratio < 1.3  # five times as much if the pixel's box is taken for a Gaussian
    assert found_errors.kept == 1


def test_vertices_reach_the_bound() -> None:
    found_errors = errors("base", range(1), "vertices")
    assert found_errors.ratio < 1.2
    assert 0.7 < found_errors.normalised < 1.4
    assert found_errors.kept == 1


def test_gamma_is_found_from_the_edges_and_taken_off() -> None:
    found_errors = errors("gamma 2.2", range(1))
    assert found_errors.ratio < 1.5
    assert 0.25 < found_errors.polarity[0] < 0.4
    known = errors("gamma 2.2", range(1), gamma=2.2)
    assert known.ratio < 1.5
    assert abs(known.polarity[0]) < 0.02


@pytest.mark.parametrize("seed", slow_but((), range(2)))
def test_hidden_edges_are_left_out(seed: int) -> None:
    found_errors = errors("occluded", [seed], hidden=True)
    assert found_errors.kept >= 0.99
    assert found_errors.rms < 0.004
    assert found_errors.hidden_kept <= 3  # the occluder only just touches the strip around them


@pytest.mark.parametrize("light", [0.7, 0.5])
def test_a_board_half_in_a_shadow_is_measured_on_both_sides(light: float) -> None:
    _, seen = take("base", 1)
    (plane,) = seen.truth.planes
    border = np.median(plane.vertices[..., 0])
    across = np.tanh((np.arange(seen.image.shape[1]) - border) / 2)
    dimmed = seen.image * (0.5 * (1 + light) + 0.5 * (1 - light) * across)
    grid, mirrored = found(plane, 1)
    measured = measure(dimmed.round().astype(np.uint8), grid)
    row = places(measured, plane, mirrored)
    error = ((measured.pixels - plane.midpoints[row]) * plane.normals[row]).sum(axis=1)
    away = np.abs(plane.midpoints[row, 0] - border) > 20
    for side in (-1, 1):
        there = side * (plane.midpoints[:, 0] - border) > 20
        assert there[row].sum() > 0.95 * there.sum()
    assert np.abs(error[away]).max() < 0.1


def test_lines_drawn_over_the_board_cost_hardly_any_vertices() -> None:
    _, seen = take("base", 1)
    (plane,) = seen.truth.planes
    image = seen.image.copy()
    for u, v in np.rint(plane.vertices[1:5:3, 2:7:4].reshape(-1, 2)).astype(int):
        image[v + 7 : v + 9, u - 40 : u + 40] = image[v - 40 : v + 40, u + 7 : u + 9] = 140
    grid, mirrored = found(plane, 1)
    measured = measure(image, grid, "vertices")
    assert len(measured.pixels) >= 50  # 34 if these pixels are not left out
    error = measured.pixels - plane.vertices.reshape(-1, 2)[places(measured, plane, mirrored)]
    assert np.abs(error).max() < 0.02


def test_vertices_beside_the_image_border_are_measured() -> None:
    _, seen = take("base", 1)
    (plane,) = seen.truth.planes
    left = int(plane.vertices[..., 0].min()) - 2
    grid, _ = found(plane, 1)
    measured = measure(seen.image[:, left:], replace(grid, pixels=grid.pixels - [left, 0.0]), "vertices")
    assert len(measured.pixels) == 54


def test_result_is_complete_and_repeatable() -> None:
    _, picture = take("base", 0)
    plane = picture.truth.planes[0]
    grid, mirrored = found(plane, 5)
    first, again = (measure(picture.image, grid) for _ in range(2))
    np.testing.assert_array_equal(first.pixels, again.pixels)
    assert first.rejected == 0
    assert sorted(places(first, plane, mirrored)) == list(range(len(plane.midpoints)))
    assert set(first.kind) == {EDGE_H, EDGE_V}
    assert np.isfinite(first.vertices).all()
    assert np.abs(first.vertices - (plane.vertices[:, ::-1] if mirrored else plane.vertices)).max() < 0.02
    vertices = measure(picture.image, grid, "vertices")
    assert set(vertices.kind) == {VERTEX}
    np.testing.assert_array_equal(vertices.pixels, vertices.vertices[tuple(vertices.index[:, ::-1].T)])


def test_start_does_not_matter() -> None:
    _, picture = take("k1 -0.3", 6)
    plane = picture.truth.planes[0]
    bound = edge_bound(2.02, 196, np.sqrt(0.8**2 + 1 / 12), 36)
    results = []
    for start, blur in ((1, 0.0), (2, 0.5), (3, 0.5)):
        grid, _ = found(plane, start, blur)
        results.append(measure(picture.image, grid).pixels)
    assert np.abs(results[1] - results[0]).max() < 2 * bound
    assert np.sqrt(((results[2] - results[0]) ** 2).mean()) < 0.3 * bound


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_kinds_of_images_agree(dtype: type) -> None:
    _, picture = take("base", 1)
    grid, _ = found(picture.truth.planes[0], 7)
    factor = 257 if dtype is np.uint16 else 1
    image = (picture.image.astype(float) * factor).astype(dtype)
    expected = measure(picture.image, grid)
    got = measure(image, grid)
    assert np.abs(got.pixels - expected.pixels).max() < 5e-4
    np.testing.assert_allclose(got.covariance, expected.covariance, rtol=0.1, atol=1e-7)


def test_images_may_be_views_and_grids_may_be_small() -> None:
    _, picture = take("base", 0)
    plane = picture.truth.planes[0]
    grid, _ = found(plane, 8)
    wide = np.repeat(picture.image, 2, axis=1)[:, ::2]
    small = Grid(grid.pixels[1:4, 2:5], (grid.dark + 3) % 2)
    measured = measure(wide, small)
    assert len(measured.kind) == 12
    shifted = measured.index + np.array([2, 1])
    whole = measure(picture.image, grid)
    rows = [
        int(np.flatnonzero((whole.kind == k) & (whole.index == i).all(axis=1))[0])
        for k, i in zip(measured.kind, shifted, strict=True)
    ]
    assert np.abs(measured.pixels - whole.pixels[rows]).max() < 0.05


def test_parts_of_a_board_are_measured() -> None:
    _, picture = take("base", 1)
    plane = picture.truth.planes[0]
    grid, _ = found(plane, 9)
    pixels = grid.pixels.copy()
    pixels[0, :4] = np.nan
    pixels[3, 4] = np.nan
    measured = measure(picture.image, Grid(pixels, grid.dark))
    seen = np.isfinite(pixels[..., 0])
    assert len(measured.kind) == (seen[:, 1:] & seen[:, :-1]).sum() + (seen[1:] & seen[:-1]).sum()
    assert np.isnan(measured.vertices[~seen]).all()
    assert np.isfinite(measured.vertices[seen]).all()


def test_nothing_is_measured_where_there_is_nothing() -> None:
    rng = np.random.default_rng(0)
    c, r = np.meshgrid(np.arange(6.0), np.arange(5.0))
    grid = Grid(np.stack([40 + 30 * c, 40 + 30 * r], axis=-1), 0)
    for image in (
        rng.integers(0, 256, (240, 320)).astype(np.uint8),
        np.full((240, 320), 100, dtype=np.uint8),
    ):
        measured = measure(image, grid)
        assert measured.rejected >= 0.9 * (measured.rejected + len(measured.kind))
        assert np.isfinite(measured.pixels).all()


def test_no_edges_give_no_points() -> None:
    grid = Grid(np.full((1, 1, 2), 50.0), 0)
    measured = measure(np.zeros((100, 100), dtype=np.uint8), grid)
    assert len(measured.kind) == 0
    assert measured.rejected == 0


# One of the stress pictures has squares less than 4 px wide, whose edges cannot be told apart.
KEPT = {"stress 2": 0.94}


@pytest.mark.slow
@pytest.mark.parametrize("name", BEST + GOOD)
def test_midpoints_in_every_condition(name: str) -> None:
    # The map's few parameters correlate all errors of a picture: eight pictures, not fewer.
    found_errors = errors(name, range(8))
    assert found_errors.ratio < (1.2 if name in BEST else 2.0)
    assert 0.7 < found_errors.normalised < 1.4
    assert found_errors.kept >= KEPT.get(name, 0.99)


@pytest.mark.slow
@pytest.mark.parametrize("name", BEST + GOOD)
def test_vertices_in_every_condition(name: str) -> None:
    found_errors = errors(name, range(8), "vertices")
    assert found_errors.ratio < (1.2 if name in BEST else 2.0)
    assert 0.7 < found_errors.normalised < 1.4
    assert found_errors.kept >= KEPT.get(name, 0.99)


@pytest.mark.slow
def test_occluders_in_many_pictures() -> None:
    found_errors = errors("occluded", range(12), hidden=True)
    assert found_errors.kept >= 0.99
    assert found_errors.rms < 0.0035
    assert found_errors.hidden_kept <= 8


@pytest.mark.slow
def test_edges_of_a_sharp_photograph_settle(real_files: RealFiles) -> None:
    cv2 = pytest.importorskip("cv2")
    finding = pytest.importorskip("neurocal_cli.detection.finding.grids")
    image = cv2.imread(str(real_files("line_pattern/chessboard.jpg")[0]), 0)
    measured = measure(image, finding.find_grids(image)[0])
    assert len(measured.kind) + measured.rejected == 1739  # of 36 x 25 vertices
    assert measured.rejected < 0.06 * 1739


@cache
def largest_grid(path: Path) -> tuple[np.ndarray, Grid]:
    """A photograph and the largest grid in it."""
    cv2 = pytest.importorskip("cv2")
    finding = pytest.importorskip("neurocal_cli.detection.finding.grids")
    image = cv2.imread(str(path), 0)
    return image, finding.find_grids(image)[0]


@pytest.mark.parametrize("points", slow_but(("midpoints",), ("midpoints", "vertices")))
def test_photographs_calibrate_better_than_with_opencv_corners(real_files: RealFiles, points: str) -> None:
    cv2 = pytest.importorskip("cv2")
    places_3d, pixels = [], []
    for path in real_files("opencv_stereo/left0[1-6].jpg"):
        image, grid = largest_grid(path)
        measured = measure(image, grid, points)  # type: ignore[arg-type]
        half = np.array([[0.5, 0], [0, 0.5], [0, 0]])[measured.kind]
        place = np.column_stack([measured.index + half, np.zeros(len(measured.kind))])
        places_3d.append(place.astype(np.float32))
        pixels.append(measured.pixels.astype(np.float32))
    rms = cv2.calibrateCamera(places_3d, pixels, image.shape[::-1], None, None)[0]
    assert rms < 0.16  # 0.195 with cornerSubPix


def test_squares_of_four_pixels_beside_the_board_are_as_accurate_as_stated(real_files: RealFiles) -> None:
    cv2 = pytest.importorskip("cv2")
    finding = pytest.importorskip("neurocal_cli.detection.finding.grids")
    (path,) = real_files("opencv_stereo/right06.jpg")
    image = cv2.imread(str(path), 0)
    board, small = (measure(image, grid) for grid in finding.find_grids(image))
    assert len(board.kind) == 93
    assert len(small.kind) > 30
    half = np.array([[0.5, 0], [0, 0.5]])[small.kind]
    H = cv2.findHomography(small.index + half, small.pixels)[0]
    off = cv2.perspectiveTransform((small.index + half)[None], H)[0] - small.pixels
    a, b = small.across.T
    variance = (small.covariance * np.column_stack([a**2, 2 * a * b, b**2])).sum(axis=1)
    chi2 = (off * small.across).sum(axis=1) ** 2 / variance
    assert 0.5 < chi2.mean() < 1.5

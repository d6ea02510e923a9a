"""Sharpening by the camera is found from the edges, undone, and costs no accuracy."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.marked import errors_of as marked_errors
from support.marked import marked_scene, plane_of, taken
from support.measured import errors_of, take
from support.pictures import Rendered, Scene
from support.real_data import RealFiles
from support.slow_cases import slow_but

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.fitting.edge_profile import (
    EdgeProfile,
    Sharpening,
    erf_and_density,
    find_sharpening,
)
from neurocal_cli.detection.fitting.strips import GridImage
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.measuring import measure

KINDS = ((1.0, 1.0), (2.0, 1.0), (5.0, 0.5), (1.0, 2.0), (0.6, 3.0))  # amount, radius [px]


def sharpened(image: NDArray[np.generic], amount: float, radius: float) -> np.ndarray:
    light = image.astype(float)
    return np.asarray(light + amount * (light - cv2.GaussianBlur(light, (0, 0), radius, None, radius)))


def photographed(seed: int, amount: float, radius: float, name: str = "base") -> tuple[Scene, Rendered]:
    """A picture of half the contrast, so that no overshoot is clipped, sharpened and rounded to 8 bits."""
    scene, picture = take(name, seed)
    pale = 128 + 0.5 * (picture.image.astype(float) - 128)
    image = np.clip(np.rint(sharpened(pale, amount, radius)), 0, 255).astype(np.uint8)
    return scene, replace(picture, image=image)


@pytest.mark.parametrize(("amount", "radius"), slow_but((KINDS[1],), KINDS))
@pytest.mark.parametrize("count", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_sharpened_images_are_measured_to_the_bound(amount: float, radius: float, count: int) -> None:
    found = errors_of(lambda seed: photographed(seed, amount, radius), range(count))
    assert found.ratio < 1.2  # 1.4 to 3 if it is not undone
    assert 0.7 < found.normalised < 1.4
    assert found.kept == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tilt 65", "k1 -0.3", "illumination", "noise 12", "squares 16", "psf 0.5"])
def test_other_sharpened_images_are_measured_to_the_bound(name: str) -> None:
    found = errors_of(lambda seed: photographed(seed, 2.0, 1.0, name), range(3))
    assert found.ratio < 1.3
    assert 0.65 < found.normalised < 1.45
    assert found.kept == 1


@pytest.mark.slow
def test_vertices_of_sharpened_images_are_measured_to_the_bound() -> None:
    found = errors_of(lambda seed: photographed(seed, 2.0, 1.0), range(3), "vertices")
    assert found.ratio < 1.2
    assert found.kept == 1


def sharpened_target(form: str, square: float) -> tuple[Array, Array]:
    """Errors of a board of another kind, and their squares over the covariance."""
    scene = marked_scene(plane_of(form), 1, square=square)
    picture = taken(scene, 1, 4)
    pale = 128 + 0.5 * (picture.image.astype(float) - 128)
    image = np.clip(np.rint(sharpened(pale, 2.0, 1.0)), 0, 255).astype(np.uint8)
    return marked_errors(detect_points(image, scene.board, "vertices"), picture)


def test_other_boards_in_sharpened_images_are_measured_as_well() -> None:
    error, squared = sharpened_target("charuco:6x5:40:30:DICT_4X4_50", 40.0)
    assert len(error) == 20
    assert np.sqrt((error**2).mean()) < 0.0039  # 0.0045 if it is not undone
    assert 0.6 < squared.mean() < 1.6  # 0.50
    error, squared = sharpened_target("asymmetric_circles:4x7:20:16", 22.0)
    assert len(error) == 28
    assert np.sqrt((error**2).mean()) < 0.0043  # 0.0049
    assert 0.6 < squared.mean() < 1.6  # 0.33


def edge(sigma: float, amount: float, radius: float) -> EdgeProfile:
    d = np.arange(-8, 8.01, 0.25)
    fine, smooth = (erf_and_density(d / width)[0] for width in (sigma, np.hypot(sigma, radius)))
    return EdgeProfile(d, fine + amount * (fine - smooth), np.ones_like(d))


@pytest.mark.parametrize(("amount", "radius"), [(1.0, 1.0), (2.0, 1.5), (0.5, 3.0)])
def test_amount_and_radius_are_found_from_an_exact_profile(amount: float, radius: float) -> None:
    found = find_sharpening(edge(0.8, amount, radius))
    assert found is not None
    assert found.radius == pytest.approx(radius, rel=0.1)
    assert found.amount == pytest.approx(amount, rel=0.2)


@pytest.mark.parametrize("sigma", [0.4, 0.8, 2.0])
def test_an_edge_that_is_only_blurred_is_not_sharpened(sigma: float) -> None:
    assert find_sharpening(edge(sigma, 0.0, 1.0)) is None
    assert find_sharpening(edge(sigma, -0.4, 1.0)) is None
    assert find_sharpening(None) is None
    whole = edge(sigma, 2.0, 1.0)
    for half in (whole.d > 0, whole.d < 0, np.abs(whole.d) > 6, np.abs(whole.d) < 0.1):
        assert find_sharpening(EdgeProfile(whole.d[half], whole.light[half], whole.count[half])) is None


@pytest.mark.parametrize(("amount", "radius"), [kind for kind in KINDS if kind[1] >= 1])
def test_undoing_gives_back_the_image(amount: float, radius: float) -> None:
    image = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(120, 150)), (0, 0), 0.7)
    grid = Grid(np.array([[[50.0, 50.0], [100.0, 70.0]]]), 0)
    undone = Sharpening(amount, radius).undone(GridImage(sharpened(image, amount, radius), grid, 1.0), 20.0)
    middle = np.s_[45:75, 45:105]
    assert np.abs(undone.image - image)[middle].max() < 0.02 * np.abs(image).max()
    assert undone.floor < 1  # sharpening has made the noise larger


def test_sharpened_photographs_are_measured(real_files: RealFiles) -> None:
    for path in real_files("photographs/sharpened*"):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        measured = measure(image, find_grids(image)[0])
        assert measured.rejected <= 2
        assert len(measured.kind) >= 70

"""Boards with markers before wide lenses: the image is mapped to a plane, and all vertices are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.marked import errors_of, plane_of, taken
from support.pictures import Scene, Target
from support.wide_boards import WideRecipe, wide_scene

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.wide_lens import Flattening, WideLens

GROUND = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1).reshape(-1, 2)


def bent(lens: WideLens) -> Array:
    """A board beside the axis of a lens."""
    c, s = np.cos(0.5), np.sin(0.5)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return lens.pixels(np.column_stack([GROUND - [3.5, 2.5], np.full(len(GROUND), 4.0)]) @ turn.T)


def test_a_wide_lens_is_flattened() -> None:
    lens = WideLens(300.0, np.array([480.0, 360.0]))
    pixels = bent(lens)
    flattening = Flattening.of(GROUND, pixels, 5.0, (960, 720))
    flat = flattening.flat(pixels)
    np.testing.assert_allclose(flattening.pixels(flat), pixels, atol=1e-6)
    rows = flat.reshape(6, 8, 2)
    along, chord = rows[:, 3] - rows[:, 0], rows[:, -1] - rows[:, 0]
    bend = (along[:, 0] * chord[:, 1] - along[:, 1] * chord[:, 0]) / np.hypot(*chord.T)
    assert np.abs(bend).max() < 0.1  # px; 23 in the image
    assert np.isnan(flattening.flat(np.array([[5000.0, 360.0]]))).all()


def test_other_images_stay_as_they_are() -> None:
    assert Flattening.of(GROUND, 40 * GROUND, 0.3, (640, 480)).lens is None
    crooked = 40 * GROUND + np.random.default_rng(0).normal(0, 3, GROUND.shape)
    assert Flattening.of(GROUND, crooked, 4.0, (640, 480)).lens is None


def fisheye(form: str, seed: int, square: float) -> Scene:
    plane = plane_of(form)
    recipe = WideRecipe(
        size=(480, 360), cols=plane.cols, rows=plane.rows, square=square, tilt=30.0, aside=0.4
    )
    scene = wide_scene(recipe, seed)
    scaled = replace(plane, square=30.0, markers=replace(plane.markers, side=22.5))  # type: ignore[type-var]
    return replace(scene, targets=(Target(scaled),))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_all_vertices_of_a_board_before_a_fisheye_are_measured(seed: int) -> None:
    scene = fisheye("charuco:6x5:40:30:DICT_4X4_50", seed, 42.0)
    picture = taken(scene, seed, 4)
    error, squared = errors_of(detect_points(picture.image, scene.board, "vertices"), picture)
    assert len(error) == 20
    assert np.sqrt((error**2).mean()) < 0.006
    assert 0.4 < squared.mean() < 2

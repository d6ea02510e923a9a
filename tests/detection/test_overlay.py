"""Pictures of detections: drawn where the points are, whatever the image."""

from __future__ import annotations

import numpy as np
import pytest
from support.rendered import condition, picture

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection import EDGE_H, EDGE_V, VERTEX, Measured
from neurocal_cli.detection.detect import Detection, detect_points
from neurocal_cli.detection.overlay import draw_detection, draw_failure, plane_residuals


@pytest.fixture(scope="module")
def detection() -> Detection:
    return detect_points(picture("base", 0).image, condition("base", 0).board)


def test_crosses_are_where_the_points_are(detection: Detection) -> None:
    image = picture("base", 0).image
    drawn = draw_detection(image, detection).astype(int)
    height, width = drawn.shape[:2]
    assert width == 1280
    top = height - 960
    shades = drawn[top:].max(axis=2) - drawn[top:].min(axis=2)
    places = np.rint((detection.pixels + 0.5) * 2 - 0.5).astype(int)
    assert (shades[places[:, 1], places[:, 0]] > 60).mean() > 0.98
    assert (shades > 60).mean() < 0.1
    assert drawn[:top].max() == 255  # the title


@pytest.mark.parametrize("shape", [(8, 8), (3, 900), (2100, 1700)])
def test_any_image_can_be_drawn_with_a_reason(shape: tuple[int, int]) -> None:
    image = np.zeros(shape, dtype=np.uint16)
    drawn = draw_failure(image, [], "no board found; a very long reason " * 5)
    assert drawn.dtype == np.uint8
    assert drawn.shape[2] == 3
    assert drawn.shape[1] <= 1700


def test_a_failure_shows_the_grids_that_were_found(detection: Detection) -> None:
    image = picture("base", 0).image
    plain = draw_failure(image, [], "why")
    drawn = draw_failure(image, [detection.located[0].grid], "why")
    assert (drawn != plain).any(axis=2).sum() > 54 * 5


def measured_on_a_bent_plane(noise: float) -> tuple[Measured, Array]:
    rng = np.random.default_rng(0)
    kind = np.tile([EDGE_H, EDGE_V, VERTEX], 40)
    index = rng.integers(0, 9, (120, 2))
    grid = index + 0.5 * np.stack([kind == EDGE_H, kind == EDGE_V], axis=-1)
    x, y = (grid.T - 4) / 9
    pixels = 300 + 250 * np.stack([x + 0.1 * y, y], axis=-1) / (1 + 0.2 * x)[:, None]
    pixels += 5 * np.stack([x**3 + x * y**2, y * x**2], axis=-1)
    error = noise * rng.normal(size=pixels.shape)
    empty = np.zeros((9, 9, 2))
    return Measured(kind, index, pixels + error, np.ones((120, 3)), None, empty, 0, 0.0), error


def test_residuals_are_the_noise_and_not_the_lens() -> None:
    measured, _ = measured_on_a_bent_plane(0.0)
    assert np.abs(plane_residuals(measured)).max() < 0.1
    measured, error = measured_on_a_bent_plane(0.5)
    left = plane_residuals(measured)
    assert np.corrcoef(left.ravel(), error.ravel())[0, 1] > 0.9


def test_few_points_have_no_residuals() -> None:
    measured, _ = measured_on_a_bent_plane(0.5)
    few = Measured(
        measured.kind[:3],
        measured.index[:3],
        measured.pixels[:3],
        np.ones((3, 3)),
        None,
        measured.vertices,
        0,
        0.0,
    )
    assert not plane_residuals(few).any()

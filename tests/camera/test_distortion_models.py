"""Distortion models: derivatives, inverse, agreement with OpenCV."""

import numpy as np
import pytest
from support.distorted import LENSES

from neurocal_cli.camera.distortion import (
    MODELS,
    Distortion,
    coefficient_names,
    distort,
    distort_with_jacobian,
)
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.errors import InputError

STEP = 1e-6


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.uniform(-0.6, 0.6, 50), rng.uniform(-0.6, 0.6, 50)


@pytest.mark.parametrize("model", list(MODELS))
def test_derivatives_by_the_point_are_those_of_differences(
    model: str, points: tuple[np.ndarray, ...]
) -> None:
    x, y = points
    k = LENSES[model]
    _, (xx, xy, yx, yy), _ = distort_with_jacobian(model, k, x, y)
    by_x = [
        (a - b) / (2 * STEP)
        for a, b in zip(distort(model, k, x + STEP, y), distort(model, k, x - STEP, y), strict=True)
    ]
    by_y = [
        (a - b) / (2 * STEP)
        for a, b in zip(distort(model, k, x, y + STEP), distort(model, k, x, y - STEP), strict=True)
    ]
    assert np.array([xx, yx]) == pytest.approx(np.array(by_x), abs=1e-8)
    assert np.array([xy, yy]) == pytest.approx(np.array(by_y), abs=1e-8)


@pytest.mark.parametrize("model", [name for name in MODELS if name != "none"])
def test_derivatives_by_the_coefficients_are_those_of_differences(
    model: str, points: tuple[np.ndarray, ...]
) -> None:
    x, y = points
    k = np.array(LENSES[model])
    _, _, by = distort_with_jacobian(model, k, x, y)
    assert len(by) == len(k) == len(coefficient_names(model))
    for n, pair in enumerate(by):
        step = np.zeros(len(k))
        step[n] = STEP
        plus, minus = distort(model, k + step, x, y), distort(model, k - step, x, y)
        difference = (np.array(plus) - np.array(minus)) / (2 * STEP)
        assert np.array(pair) == pytest.approx(difference, abs=1e-8)


@pytest.mark.parametrize("model", list(MODELS))
def test_undistort_inverts_distort(model: str, points: tuple[np.ndarray, ...]) -> None:
    x, y = points
    back = undistort(Distortion(model, LENSES[model]), *distort(model, LENSES[model], x, y))
    assert np.array(back) == pytest.approx(np.array([x, y]), abs=1e-11)


@pytest.mark.parametrize(
    "model", [name for name in MODELS if name not in ("none", "omnidir", "double_sphere", "eucm", "rich")]
)
def test_opencv_bends_the_same_way(model: str, points: tuple[np.ndarray, ...]) -> None:
    cv2 = pytest.importorskip("cv2")
    x, y = points
    world = np.column_stack([x, y, np.ones_like(x)])
    zero, k = np.zeros(3), np.array(LENSES[model])
    if model == "fisheye":
        bent, _ = cv2.fisheye.projectPoints(world[:, None], zero, zero, np.eye(3), k)
    else:
        padded = np.zeros(14)
        padded[: len(k)] = k
        bent, _ = cv2.projectPoints(world, zero, zero, np.eye(3), padded)
    assert np.column_stack(distort(model, k, x, y)) == pytest.approx(bent.reshape(-1, 2), abs=1e-9)


def test_what_no_point_bends_to_is_nan() -> None:
    # With k1 = -1 the image never gets beyond 2 / (3 sqrt 3) = 0.385.
    x, _ = undistort(Distortion("k1", [-1.0]), np.array([0.3, 0.5]), np.zeros(2))
    assert np.isfinite(x[0])
    assert np.isnan(x[1])


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(InputError, match="unknown; use one of"):
        coefficient_names("brown")

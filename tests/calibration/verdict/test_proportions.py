"""A flat board whose axes have different units is named as such, and no other board is."""

from __future__ import annotations

import numpy as np
import pytest
from support.distorted import SIGMA, bent_set, through
from support.real_data import RealFiles
from support.scenes import random_flat_set
from support.slow_cases import slow_but
from support.wrong_inputs import (
    CAMERA,
    FLAT,
    Input,
    bent_board,
    board,
    flat,
    folded,
    moved,
    of_cameras,
    poses,
    scaled,
    seen,
    turned_poses,
)

from neurocal_cli import Correspondences, Pose, calibrate, read_points
from neurocal_cli.calibration.verdict.proportions import proportions
from neurocal_cli.camera.distortion import distort
from neurocal_cli.errors import DegenerateGeometryError

ALL = range(10)


def turned(seed: int, most: float = np.pi) -> Correspondences:
    return seen(board(), turned_poses(10, seed, most), CAMERA.A, seed)


def first_reason(points: Correspondences, distortion: str = "auto") -> str:
    """What a poor calibration or a refusal says first."""
    try:
        verdict = calibrate(points, distortion=distortion).verdict
    except DegenerateGeometryError as error:
        return str(error)
    assert verdict is not None
    assert verdict.word == "poor"
    return verdict.reasons[0]


@pytest.mark.parametrize("seed", slow_but({0}, range(3)))
@pytest.mark.parametrize(
    ("by", "axis", "factor"),
    [
        ([1 / 25.4, 1, 1], "X", 25.4),
        ([1, 0.001, 1], "Y", 1000.0),
        ([2, 1, 1], "Y", 2.0),
        ([1, 1.1, 1], "X", 1.1),
    ],
)
def test_axes_of_different_units_are_measured(by: list[float], axis: str, factor: float, seed: int) -> None:
    found = proportions(scaled(turned(seed), by, ALL))
    assert found is not None
    assert found.axis == axis
    assert found.factor == pytest.approx(factor, rel=0.005)
    assert found.rmse_px < 0.3 < found.given_px


@pytest.mark.parametrize("most", slow_but((0.5,), (0.5, np.pi)))
def test_x_in_inches_is_not_refused_as_parallel(most: float) -> None:
    points = scaled(turned(1, most), [1 / 25.4, 1, 1], ALL)
    with pytest.raises(
        DegenerateGeometryError, match=r"X is 25\.4 times .* inches and millimetres mixed"
    ) as e:
        calibrate(points, distortion="none")
    assert "parallel" not in str(e.value)


@pytest.mark.parametrize("most", slow_but((0.5,), (0.5, np.pi)))
def test_x_of_half_the_length_is_named(most: float) -> None:
    reason = first_reason(scaled(turned(1, most), [0.5, 1, 1], ALL), "none")
    assert reason.startswith("the points fit a board whose X is 2 times as long as given")


def test_the_axes_of_the_board_may_be_any_two() -> None:
    points = scaled(turned(2), [0.1, 1, 1], ALL)
    found = proportions(moved(points, points.world[:, [2, 0, 1]]))
    assert found is not None
    assert (found.axis, found.other) == ("Y", "Z")


def test_the_third_axis_may_be_rounded() -> None:
    points = scaled(turned(1), [1 / 25.4, 1, 1], ALL)
    rounded = moved(points, world=points.world + [0, 0, 1e-9] * np.sin(points.world[:, :1]))
    assert "X is 25.4 times as long as given" in first_reason(rounded)


def test_a_lens_does_not_hide_it() -> None:
    points = scaled(turned(3), [0.1, 1, 1], ALL)
    x = (points.pixels - CAMERA.A[:2, 2]) / 600.0
    bent = np.column_stack(distort("k1", [-0.25], x[:, 0], x[:, 1])) * 600.0 + CAMERA.A[:2, 2]
    found = proportions(moved(points, pixels=bent))
    assert found is not None
    assert found.factor == pytest.approx(10, rel=0.01)


def test_a_lens_that_folds_the_image_is_not_taken_for_it() -> None:
    """Some points are seen beyond the radius at which the distortion turns back."""
    scene = random_flat_set(np.random.default_rng(28), 13, False, cols=9, rows=6)
    folded_back = through(scene, "plumb_bob", [-0.28, 0.12, 1e-3, -8e-4, -0.02])
    assert proportions(folded_back.points(0.3, np.random.default_rng(1))) is None


@pytest.mark.parametrize(
    "points",
    [
        flat(),
        turned(1),
        seen(board(), [Pose(np.eye(3), q.t) for q in poses(10, 1)], CAMERA.A, 5),
        bent_board(flat(), 4.0),
        of_cameras([600.0, 800.0]),
        folded(),
        turned(1).select(slice(0, 279)),
        scaled(turned(1), [1.01, 1, 1], ALL),
        scaled(turned(1), [0.5, 1, 1], range(5)),
        moved(flat(), pixels=0 * flat().pixels + 100.0),
        moved(flat(), world=flat().world * [1, 0, 0]),
    ],
    ids=[
        "as given",
        "turned",
        "parallel",
        "bent",
        "two cameras",
        "folded",
        "three views",
        "a print",
        "half of the views",
        "one pixel",
        "a line",
    ],
)
def test_other_boards_have_no_other_proportions(points: Correspondences) -> None:
    assert proportions(points) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", FLAT)
def test_no_other_wrong_input_is_taken_for_it(name: str) -> None:
    spoilt = FLAT[name](flat(), np.random.default_rng(7))
    found = proportions(spoilt.points if isinstance(spoilt, Input) else spoilt)
    assert found is None or "board turned" in name or name == "X in mm, Y in cm"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(50))
def test_clean_boards_are_never_taken_for_it(seed: int) -> None:
    assert proportions(turned(seed)) is None
    assert proportions(flat(seed)) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(24))
def test_boards_that_fit_no_camera_end_in_a_message(seed: int) -> None:
    """Their target is estimated from a camera that fits nothing; some ended in an error of arithmetic."""
    points = scaled(turned(seed, (0.5, 1.0, np.pi)[seed % 3]), [(0.5, 1 / 25.4)[seed % 2], 1, 1], ALL)
    assert first_reason(points).startswith("the points fit a board")


def test_a_lens_far_from_k1k2_leaves_no_negative_proportions() -> None:
    scene, _ = bent_set("fisheye", 35)
    points = scene.points(SIGMA, np.random.default_rng([35, 1]))
    assert proportions(points) is None


def test_boards_that_hardly_differ_in_tilt_have_no_other_proportions(real_files: RealFiles) -> None:
    """The points as given fit a camera without skew just as well."""
    points = read_points(real_files("field_reports/smallrig2000_r.csv")[0])
    assert proportions(points) is None
    with pytest.raises(DegenerateGeometryError, match="parallel within the noise"):
        calibrate(points)

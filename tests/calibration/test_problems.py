"""The four problem types: what each needs, what it leaves free, and what it gives back unchanged."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from support.scenes import pinhole, table_1
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, Intrinsics, Pose, calibrate
from neurocal_cli.adjustment.problem import problem_for
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.errors import InputError, NeurocalError, UsageError

SCENE = table_1()
CAMERA = Intrinsics(555.123456789, 549.1, 171.7, 121.3, 1.5)
NOTHING: dict[str, Any] = {"image_center": None, "intrinsics": None, "extrinsics": None, "skew": True}


def known(type: Any, points: Correspondences | None = None, **given: Any) -> Any:
    return problem_for(points or SCENE.points(), type, **(NOTHING | given))


@pytest.mark.parametrize(
    ("type", "given", "free", "fixed"),
    [
        (1, {}, [1, 1, 1, 1, 1], set()),
        (1, {"skew": False}, [1, 0, 1, 1, 1], {"theta"}),
        (2, {"image_center": (170.0, 120.0)}, [1, 1, 1, 0, 0], {"u0", "v0"}),
        (2, {"image_center": (170.0, 120.0), "skew": False}, [1, 0, 1, 0, 0], {"u0", "v0", "theta"}),
        (3, {"intrinsics": CAMERA}, [0] * 5, {"alpha_u", "alpha_v", "u0", "v0", "theta"}),
        (3, {"intrinsics": CAMERA, "skew": False}, [0] * 5, {"alpha_u", "alpha_v", "u0", "v0", "theta"}),
        (4, {"extrinsics": SCENE.poses}, [1, 1, 1, 1, 1], set()),
        (4, {"extrinsics": SCENE.poses, "skew": False}, [1, 0, 1, 1, 1], {"theta"}),
    ],
)
def test_what_each_type_leaves_free(
    type: int, given: dict[str, Any], free: list[int], fixed: set[str]
) -> None:
    found = known(type, **given)
    assert found.free.tolist() == [bool(f) for f in free]
    assert found.fixed == fixed
    assert found.free_poses == (type != 4)


@pytest.mark.parametrize(
    ("type", "given", "words"),
    [
        (0, {}, "type must be 1, 2, 3 or 4, not 0"),
        (5, {}, "not 5"),
        ("1", {}, "not '1'"),
        (1, {"image_center": (1.0, 2.0)}, "image_center needs type 2.*give type=2"),
        (1, {"intrinsics": CAMERA}, "intrinsics needs type 3"),
        (2, {"extrinsics": {}}, "extrinsics needs type 4"),
        (3, {}, "type 3 needs the intrinsics"),
        (4, {}, "type 4 needs the extrinsics"),
    ],
)
def test_what_does_not_go_with_a_type_is_wrong_usage(type: Any, given: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words) as error:
        known(type, **given)
    assert "\n" not in str(error.value)


def test_no_points_are_refused() -> None:
    with pytest.raises(InputError, match="there are no points to calibrate from"):
        calibrate(Correspondences.none())


def test_type_2_without_a_centre_says_where_to_put_it() -> None:
    points = Correspondences(SCENE.world, SCENE.pixels)
    with pytest.raises(UsageError, match="type 2 needs the image centre; give it, or put image_center"):
        known(2, points)


def test_the_centre_is_the_option_else_the_points_else_the_middle_of_the_image() -> None:
    both = Correspondences(SCENE.world, SCENE.pixels, image_size=(640, 480), image_center=(300.0, 200.0))
    assert known(2, both, image_center=(1.0, 2.0)).entries[3:].tolist() == [1.0, 2.0]
    assert known(2, both).entries[3:].tolist() == [300.0, 200.0]
    # The first pixel's centre is 0.
    size = Correspondences(SCENE.world, SCENE.pixels, image_size=(640, 480))
    assert known(2, size).entries[3:].tolist() == [319.5, 239.5]


@pytest.mark.parametrize("centre", [(np.nan, 1.0), (1.0, np.inf), (1.0, 2.0, 3.0)])
def test_a_centre_that_is_not_two_numbers_is_refused(centre: Any) -> None:
    with pytest.raises(InputError, match="two finite numbers"):
        known(2, image_center=centre)


def test_poses_must_be_there_for_every_view() -> None:
    labels = np.repeat(["a", "b", "c"], [200, 200, 40])
    points = Correspondences(SCENE.world, SCENE.pixels, labels)
    with pytest.raises(InputError, match="no view named 'b' and 1 more; they have 'a', 'x'"):
        known(4, points, extrinsics={"a": SCENE.poses["view"], "x": SCENE.poses["view"]})


@pytest.mark.parametrize(
    ("type", "skew"),
    slow_but({(2, True), (3, True), (4, False)}, itertools.product((2, 3, 4), (True, False))),
)
def test_given_parameters_come_back_to_the_last_bit(type: int, skew: bool) -> None:
    centre = (0.1 + 0.2, 1 / 3 * 361)
    pose = Pose.from_euler(0.1 / 3, 0.8, -0.03, np.array([-27.0, -28.0, 701.0]) / 3 * 3.0000001)
    given = {2: {"image_center": centre}, 3: {"intrinsics": CAMERA}, 4: {"extrinsics": {"view": pose}}}[type]
    cal = pinhole(SCENE.points(0.1, np.random.default_rng(0)), type=type, skew=skew, **given)
    if type == 2:
        assert (cal.intrinsics.u0, cal.intrinsics.v0) == centre
        assert cal.K[:2, 2].tolist() == list(centre)
    if type == 3:
        assert cal.intrinsics.values().tobytes() == CAMERA.values().tobytes()
    if type == 4:
        view = cal.views["view"]
        assert view.pose.R.tobytes() == pose.R.tobytes()
        assert view.pose.t.tobytes() == pose.t.tobytes()
        assert view.fixed
        assert set(view.std.values()) == {0.0}
    if not skew and type != 3:
        assert cal.intrinsics.theta == np.pi / 2
        assert cal.K[0, 1] == 0
    for name in cal.fixed:
        assert cal.std[name] == 0
    for name in cal.covariance_names:
        assert cal.std[name] > 0


def test_given_entries_are_normalised_as_the_pixels_are() -> None:
    found = known(3, intrinsics=CAMERA)
    views, entries = found.views, found.normalised_entries
    A = np.eye(3)
    A[ENTRIES] = entries
    np.testing.assert_allclose(views.S1 @ A, CAMERA.A, rtol=1e-14, atol=1e-12)
    np.testing.assert_array_equal(found.matrix(entries), CAMERA.A)


def test_a_matrix_will_do_for_intrinsics() -> None:
    points = SCENE.points()
    one, two = (pinhole(points, type=3, intrinsics=K) for K in (CAMERA, CAMERA.A))
    assert two.intrinsics.values() == pytest.approx(one.intrinsics.values(), rel=1e-14)


@pytest.mark.parametrize("matrix", [np.eye(4), np.ones((3, 3)), np.full((3, 3), np.nan)])
def test_a_matrix_that_is_no_camera_is_refused(matrix: Any) -> None:
    with pytest.raises(NeurocalError, match="camera matrix must be"):
        calibrate(SCENE.points(), type=3, intrinsics=matrix)

"""Correspondences: what is taken, in which order views come, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences

N = 6
WORLD = np.arange(3.0 * N).reshape(N, 3)
PIXELS = np.arange(2.0 * N).reshape(N, 2)


def with_value(array: Array, value: float) -> Array:
    changed = array.copy()
    changed[3, 1] = value
    return changed


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from(["b", "a", "c", "left 10", "left 9"]), min_size=1, max_size=20))
def test_views_come_in_order_of_first_appearance(labels: list[str]) -> None:
    n = len(labels)
    points = Correspondences(np.zeros((n, 3)), np.zeros((n, 2)), labels)
    assert list(points.view_names) == list(dict.fromkeys(labels))
    assert [points.view_names[k] for k in points.view_index] == labels
    assert points.n_views == len(set(labels))


def test_without_labels_there_is_one_view_and_numbers_are_labels_too() -> None:
    assert Correspondences(WORLD, PIXELS).view_names == ("view",)
    assert Correspondences(WORLD, PIXELS, [7, 7, 3, 3, 3, 7]).view_names == ("7", "3")


def test_lists_are_taken_and_arrays_are_copied_and_read_only() -> None:
    world = WORLD.copy()
    points = Correspondences(world, PIXELS.tolist())
    world[0, 0] = 99.0
    assert points.world[0, 0] == 0
    for array in (points.world, points.pixels, points.view_index):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"world": WORLD[:, :2]}, r"world must have the shape \(N, 3\), found \(6, 2\)"),
        ({"pixels": PIXELS.T}, r"pixels must have the shape \(N, 2\)"),
        ({"pixels": PIXELS[:, None]}, r"found \(6, 1, 2\); numpy.reshape\(pixels, \(-1, 2\)\) makes them"),
        ({"world": WORLD[0]}, "shape"),
        ({"world": [["a", "b", "c"]]}, "array of real numbers"),
        ({"world": [[1, 2, 3], [4, 5]]}, "array of real numbers"),
        ({"pixels": PIXELS + 1j}, "pixels must be an array of real numbers"),
        ({"pixels": np.ma.masked_equal(PIXELS, PIXELS[2, 1])}, "pixels has masked entries; leave these"),
        ({"pixels": PIXELS[:4]}, "6 world points but 4 pixels"),
        ({"world": np.zeros((0, 3)), "pixels": np.zeros((0, 2))}, "no points"),
        ({"view": ["a"] * 5}, "view needs one entry for each of the 6 points"),
        ({"point": ["a"] * 7}, "point needs one entry"),
        ({"point": list("abcdbe")}, "row 5: the point 'b' is already in row 2; remove one of the rows, or"),
        (
            {"view": [1, 1, 2, 2, 1, 2], "point": [1, 2, 1, 2, 3, 2]},
            "row 6: the point '2' is already in row 4 in the view '2'",
        ),
        ({"world": with_value(WORLD, np.nan)}, "row 4: X,Y,Z must be finite numbers .* nan"),
        ({"world": with_value(WORLD, -np.inf)}, "row 4: X,Y,Z"),
        ({"world": 1e-300 * WORLD}, "X,Y,Z are too small"),
        ({"pixels": with_value(PIXELS, 1e308)}, "row 4: u,v must be .* of a sensible size"),
        ({"pixels": with_value(PIXELS, np.nan)}, "row 4: u,v"),
        ({"image_size": (0, 480)}, "positive whole"),
        ({"image_size": (640, -1)}, "positive whole"),
        ({"image_size": (640.5, 480)}, "positive whole"),
        ({"image_size": (1e20, 480)}, "up to 1000000 px"),
        ({"image_size": (10**400, 480)}, "real numbers"),
        ({"image_size": "640x480"}, "real numbers"),
        ({"image_size": (640, 480, 3)}, "positive whole"),
        ({"image_center": (10**400, 1.0)}, "real numbers"),
        ({"image_center": (np.nan, 1.0)}, "finite"),
        ({"covariance": np.ones((N, 2))}, r"shape \(N, 3\)"),
        ({"covariance": np.tile([1.0, 0.0, 1.0], (N - 1, 1))}, "covariance needs one row for each"),
        ({"covariance": np.tile([1.0, 1.0, 1.0], (N, 1))}, "row 1: .* positive definite"),
        (
            {"covariance": with_value(np.tile([1.0, 0.0, 1.0], (N, 1)), 2.0)},
            "row 4: .* positive definite",
        ),
        ({"covariance": np.tile([np.nan, 0.0, 1.0], (N, 1))}, "positive definite"),
        ({"covariance": np.tile([1e-200, 0.0, 1e-200], (N, 1))}, "positive definite"),
        ({"covariance": np.tile([1e200, 0.0, 1e200], (N, 1))}, "positive definite"),
    ],
)
def test_what_cannot_be_points_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        Correspondences(**({"world": WORLD, "pixels": PIXELS} | given))
    assert "\n" not in str(error.value)


def test_the_centre_that_is_assumed_is_the_given_one_or_the_middle_of_the_image() -> None:
    assert Correspondences(WORLD, PIXELS).assumed_centre is None
    assert Correspondences(WORLD, PIXELS, image_size=(640, 481)).assumed_centre == (319.5, 240.0)
    given = Correspondences(WORLD, PIXELS, image_size=(640, 481), image_center=(300.0, 0.0))
    assert given.assumed_centre == (300.0, 0.0)


def test_a_message_names_the_file_and_line() -> None:
    lines = np.arange(10, 10 + N)
    with pytest.raises(InputError, match=r"board\.csv:13: u,v"):
        Correspondences(WORLD, with_value(PIXELS, np.nan), source="board.csv", lines=lines)
    with pytest.raises(InputError, match=r"two\.csv:13: u,v"):
        Correspondences(
            WORLD,
            with_value(PIXELS, np.nan),
            view=["a"] * 3 + ["b"] * 3,
            lines=lines,
            sources={"a": "one.csv", "b": "two.csv"},
        )


def test_selecting_rows_keeps_everything_that_belongs_to_them() -> None:
    points = Correspondences(
        WORLD,
        PIXELS,
        view=["b", "a", "b", "a", "c", "c"],
        image_size=(640, 480),
        point=list("uvwxyz"),
        covariance=np.tile([2.0, 0.5, 1.0], (N, 1)) * np.arange(1, N + 1)[:, None],
        across=np.arange(2.0 * N).reshape(N, 2),
        unit="m",
        lines=np.arange(N),
    )
    rows = points.select(np.array([4, 1, 3]))
    assert rows.view_names == ("c", "a")
    assert rows.world.tolist() == WORLD[[4, 1, 3]].tolist()
    assert rows.point is not None
    assert list(rows.point) == ["y", "v", "x"]
    assert rows.covariance is not None
    assert rows.covariance[:, 0].tolist() == [10.0, 4.0, 8.0]
    assert rows.across is not None
    assert rows.across.tolist() == [[8, 9], [2, 3], [6, 7]]
    assert (rows.image_size, rows.unit, len(rows)) == ((640, 480), "m", 3)
    assert points.select(slice(None)).view_names == points.view_names


def test_covariances_as_matrices() -> None:
    points = Correspondences(WORLD, PIXELS, covariance=np.tile([4.0, 1.0, 2.0], (N, 1)))
    found = points.pixel_covariance
    assert found is not None
    assert found.shape == (N, 2, 2)
    assert found[5].tolist() == [[4.0, 1.0], [1.0, 2.0]]
    assert Correspondences(WORLD, PIXELS).pixel_covariance is None
    assert repr(points) == (
        "Correspondences(6 points in 1 views, image size unknown, unit 'mm', with covariance)"
    )

"""Boards: where their points lie, what they are called, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurocal_cli.errors import InputError
from neurocal_cli.observations.board import Board, Plane

WALL = Plane("wall", 8, 6, 28.0, (28, 0, 28), (1, 0, 0), (0, 0, 1))


def test_vertex_c_r_is_origin_plus_c_squares_along_x_and_r_along_y() -> None:
    vertices = WALL.vertices()
    assert vertices.shape == (6, 8, 3)
    for c, r in ((0, 0), (7, 0), (0, 5), (3, 2)):
        np.testing.assert_array_equal(vertices[r, c], [28 + 28 * c, 0, 28 + 28 * r])


def test_ids_name_the_plane_only_when_it_has_a_name() -> None:
    bare = Plane("", 3, 2, 10.0)
    assert bare.vertex_ids() == ("0:0", "1:0", "2:0", "0:1", "1:1", "2:1")
    assert bare.midpoint_ids() == ("h:0:0", "h:1:0", "h:0:1", "h:1:1", "v:0:0", "v:1:0", "v:2:0")
    assert WALL.vertex_ids()[1] == "wall/1:0"
    assert WALL.midpoint_ids()[-1] == "wall/v:7:4"


@given(st.integers(2, 9), st.integers(2, 9))
def test_every_id_names_the_place_halfway_between_its_vertices(cols: int, rows: int) -> None:
    plane = Plane("", cols, rows, 3.0, (1, 2, 3), (0.6, 0.8, 0), (0, 0, -1))
    ids, points = plane.midpoints()
    vertices = plane.vertices()
    assert len(ids) == len(points) == (cols - 1) * rows + cols * (rows - 1) == len(set(ids))
    for name, point in zip(ids, points, strict=True):
        kind, c, r = name[0], *map(int, name.split(":")[1:])
        other = vertices[r, c + 1] if kind == "h" else vertices[r + 1, c]
        np.testing.assert_allclose(point, 0.5 * (vertices[r, c] + other), atol=1e-12)


def test_vertex_ids_go_with_the_vertices_row_by_row() -> None:
    flat = WALL.vertices().reshape(-1, 3)
    for name, point in zip(WALL.vertex_ids(), flat, strict=True):
        c, r = map(int, name.removeprefix("wall/").split(":"))
        np.testing.assert_array_equal(point, WALL.at([c, r]))


def test_the_normal_is_x_axis_cross_y_axis() -> None:
    np.testing.assert_array_equal(WALL.normal, [0, -1, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cols": 1}, "cols counts inner vertices"),
        ({"rows": 2.5}, "rows counts inner vertices"),
        ({"rows": True}, "rows counts inner vertices"),
        ({"cols": 10**9}, "cols counts inner vertices"),
        ({"square": 0}, "square must be a positive length"),
        ({"square": float("nan")}, "square must be a finite number"),
        ({"square": "wide"}, "square must be a finite number"),
        ({"origin": (0, 0)}, "origin must be 3 finite numbers"),
        ({"x_axis": (1, 1, 0)}, r"x_axis must have the length 1, found 1\.41421356"),
        ({"y_axis": (0, 0, 0)}, "y_axis must have the length 1"),
        ({"y_axis": (1e-5, 1, 0)}, "must be perpendicular"),
        ({"name": "a/b"}, "name must be printable"),
        ({"name": " a"}, "name must be printable"),
        ({"name": "a\nb"}, "name must be printable"),
        ({"name": 3}, "name must be text"),
    ],
)
def test_a_plane_that_cannot_be_is_refused_by_the_name_of_its_fault(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Plane(**{"name": "p", "cols": 4, "rows": 3, "square": 5.0, **change})


def test_axes_a_millionth_off_are_accepted() -> None:
    assert Plane("", 3, 3, 1.0, y_axis=(5e-7, 1, 0)).y_axis == (5e-7, 1, 0)


def test_several_planes_need_different_names() -> None:
    plane, other = Plane("a", 3, 3, 1.0), Plane("b", 3, 3, 1.0)
    assert Board((plane, other)).plane("b") is other
    with pytest.raises(InputError, match="two planes have the name 'a'"):
        Board((plane, plane))
    with pytest.raises(InputError, match="needs a name for each"):
        Board((plane, Plane("", 3, 3, 1.0)))
    with pytest.raises(InputError, match="at least one plane"):
        Board(())
    with pytest.raises(InputError, match=r"no plane 'c'; it has \['a', 'b'\]"):
        Board((plane, other)).plane("c")


def test_a_board_of_one_plane_takes_three_numbers() -> None:
    board = Board.single(9, 6, 25.0)
    assert board.unit == "mm"
    assert board.planes == (Plane("", 9, 6, 25.0),)

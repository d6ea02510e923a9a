"""The estimated shape of boards of all kinds, as boards."""

from __future__ import annotations

import numpy as np
import pytest

from neurocal_cli.errors import InputError
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.files.board_yaml import format_board, parse_board
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.estimated_board import with_found_points
from neurocal_cli.observations.target import Target, board_of


def bent(board: Board) -> Target:
    """What is found of a board whose points are off their plane, vertices and mid-points."""
    (plane,) = board.planes
    middles, places = plane.midpoints()
    every = np.concatenate([plane.vertices().reshape(-1, 3), places])
    ids, first = np.unique([*plane.vertex_ids(), *middles], return_index=True)
    world = every[first]
    found = world + np.column_stack([0 * world[:, :2], 1e-3 * world[:, 0] * world[:, 1]])
    plane_of = np.zeros(len(ids), dtype=np.intp)
    return Target(world, found, np.ones_like(world), plane_of, {}, False, 9.0, ids)


@pytest.mark.parametrize(
    "form",
    [
        "chessboard:5x4:20",
        "charuco:5x6:20:15",
        "aprilgrid:3x2:40:0.3",
        "arucogrid:3x2:40:0.3:DICT_4X4_50",
        "circles:4x3:20",
        "asymmetric_circles:3x5:20",
    ],
)
def test_a_board_of_any_kind_keeps_its_kind_and_gets_its_shape(form: str) -> None:
    board = short_board(form)
    assert board is not None
    target = bent(board)
    assert target.point is not None
    shaped = parse_board(format_board(with_found_points(board, target, "mm")))
    (plane,) = shaped.planes
    assert type(plane) is type(board.planes[0])
    known = {name: np.array(row) for name, row in zip(target.point.tolist(), target.found, strict=True)}
    c, r = np.meshgrid(np.arange(plane.cols), np.arange(plane.rows))
    vertices = plane.truly_at(np.column_stack([c.ravel(), r.ravel()]).astype(float))
    for name, place in zip(plane.vertex_ids(), vertices, strict=True):
        np.testing.assert_allclose(place, known[name], atol=1e-9)


@pytest.mark.parametrize("form", ["aprilgrid:3x2:40:0.3", "asymmetric_circles:3x5:20"])
def test_points_of_another_kind_are_not_written_as_a_chessboard(form: str) -> None:
    board = short_board(form)
    assert board is not None
    with pytest.raises(InputError, match="--board"):
        board_of(bent(board), "mm")


def test_the_board_of_other_points_is_refused() -> None:
    board, other = short_board("circles:4x3:20"), short_board("circles:3x3:20")
    assert board is not None
    assert other is not None
    with pytest.raises(InputError, match="the point '3:0' is not on the board"):
        with_found_points(other, bent(board), "mm")
    with pytest.raises(InputError, match="the target is in cm and the board in mm"):
        with_found_points(board, bent(board), "cm")

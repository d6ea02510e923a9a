"""Board files: they give back every number, and what is wrong is named by file and key."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurocal_cli.errors import FormatError
from neurocal_cli.files.board_yaml import format_board, parse_board, read_board, write_board
from neurocal_cli.observations.board import Board, Plane

TWO = """unit: mm
planes:
  - {name: floor, cols: 7, rows: 6, square: 28.0, origin: [28, 28, 0], x_axis: [1, 0, 0], y_axis: [0, 1, 0]}
  - {name: wall,  cols: 8, rows: 6, square: 28.0, origin: [28, 0, 28], x_axis: [1, 0, 0], y_axis: [0, 0, 1]}
"""
ONE = "planes:\n  - {cols: 9, rows: 6, square: 25}\n"


def test_two_planes_are_read(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(TWO, "utf-8")
    floor = Plane("floor", 7, 6, 28.0, (28, 28, 0))
    wall = Plane("wall", 8, 6, 28.0, (28, 0, 28), y_axis=(0, 0, 1))
    assert read_board(path) == Board((floor, wall), "mm")


def test_one_plane_alone_may_leave_out_name_origin_axes_and_unit() -> None:
    assert parse_board(ONE) == Board.single(9, 6, 25.0)


COORDINATES = st.floats(-1e9, 1e9)
NAMES = st.text(st.characters(codec="utf-8"), min_size=1, max_size=8).filter(
    lambda name: name == name.strip() and name.isprintable() and "/" not in name
) | st.sampled_from(["1e5", "null", "true", "~", "012", "- x", "a: b", "#"])


@given(
    st.lists(
        st.tuples(NAMES, st.tuples(*[COORDINATES] * 3)), min_size=1, max_size=3, unique_by=lambda p: p[0]
    ),
    st.floats(1e-9, 1e9),
    st.floats(-3, 3),
    NAMES,
)
def test_a_board_reads_back_to_the_last_bit(
    planes: list[tuple[str, tuple[float, float, float]]], square: float, angle: float, unit: str
) -> None:
    x_axis = (float(np.cos(angle)), float(np.sin(angle)), 0.0)
    board = Board(tuple(Plane(name, 5, 4, square, at, x_axis, (0, 0, 1)) for name, at in planes), unit)
    assert parse_board(format_board(board)) == board


def test_a_board_is_written_and_read(tmp_path: Path) -> None:
    board = Board.single(5, 4, 0.1, "m")
    write_board(board, tmp_path / "b.yaml")
    assert read_board(tmp_path / "b.yaml") == board


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (TWO, "", "the file must be a mapping"),
        (TWO, "unit: mm\n", "the key planes is missing"),
        (TWO, "planes: []\n", "planes must be a list of at least one plane"),
        (TWO, "planes: {cols: 3}\n", "planes must be a list"),
        ("name: wall, ", "", r"the key planes\[1\]\.name is missing"),
        ("origin: [28, 0, 28], ", "", r"the key planes\[1\]\.origin is missing"),
        (", y_axis: [0, 0, 1]", "", r"the key planes\[1\]\.y_axis is missing"),
        ("cols: 8", "cols: 8.5", r"planes\[1\]\.cols must be a whole number, 2 or more, found 8\.5"),
        ("cols: 8", "cols: 1", r"planes\[1\]\.cols must be a whole number, 2 or more, found 1"),
        ("cols: 8", "cols: 2000", r"planes\[1\]\.cols counts inner vertices .* found 2000"),
        ("cols: 8, ", "", r"the key planes\[1\]\.cols is missing"),
        (
            "square: 28.0, origin: [28, 0",
            "square: -1, origin: [28, 0",
            r"planes\[1\]\.square must be a posit",
        ),
        ("[28, 0, 28]", "[28, 0]", r"planes\[1\]\.origin must be 3 finite numbers"),
        ("y_axis: [0, 0, 1]", "y_axis: [0, 0, 2]", r"planes\[1\]\.y_axis must have the length 1"),
        ("y_axis: [0, 0, 1]", "y_axis: [1, 0, 0]", r"planes\[1\]\.x_axis and y_axis must be perpendicular"),
        ("name: wall", "name: floor", "planes: two planes have the name 'floor'"),
        ("name: wall", "name: a/b", r"planes\[1\]\.name must be printable"),
        ("name: wall", "name: [a]", r"planes\[1\]\.name must be text"),
        ("y_axis: [0, 0, 1]", "y_axes: [0, 0, 1]", r"planes\[1\]: the key 'y_axes' is not known; use one of"),
        ("unit: mm", "units: mm", "the key 'units' is not known; use one of unit, planes"),
        ("unit: mm", "unit: [mm]", "unit must be text"),
        ("unit: mm", "unit: mm\nunit: cm", "the key 'unit' appears twice"),
    ],
)
def test_what_is_wrong_with_a_board_is_named_by_file_and_key(old: str, new: str, message: str) -> None:
    assert old in TWO
    with pytest.raises(FormatError, match=f"^bad.yaml(:[0-9]+)?: .*{message}"):
        parse_board(TWO.replace(old, new), "bad.yaml")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"none\.yaml: there is no such file"):
        read_board(tmp_path / "none.yaml")

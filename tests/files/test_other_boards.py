"""Board files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from neurocal_cli.errors import FormatError
from neurocal_cli.files.board_yaml import board_line, format_board, parse_board, read_board
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane
from neurocal_cli.observations.markers import Markers


def charuco(
    cols: int, rows: int, square: float, marker: float, name: str = "", legacy: bool | None = None
) -> Plane:
    """A ChArUco board by its squares."""
    return Plane("", cols - 1, rows - 1, square, markers=Markers(marker, name, legacy))


OPENCV = """<?xml version="1.0"?>
<opencv_storage>
<Settings>
  <BoardSize_Width>{cols}</BoardSize_Width>
  <BoardSize_Height>6</BoardSize_Height>
  <Square_Size>50</Square_Size>
  <Marker_Size>25</Marker_Size>
  <Calibrate_Pattern>"{kind}"</Calibrate_Pattern>
  <ArUco_Dict_Name>DICT_4X4_50</ArUco_Dict_Name>
</Settings>
</opencv_storage>
"""
CALISCOPE = """[charuco]
columns = 4
rows = 5
board_height = 11.0
board_width = 8.5
dictionary = "DICT_4X4_50"
units = "inch"
aruco_scale = 0.75
square_size_overide_cm = 5.4
inverted = true
legacy_pattern = false
"""
PHOTON = {
    "squareSizeIn": 1.0,
    "markerSizeIn": 0.75,
    "patternWidth": 8,
    "patternHeight": 6,
    "boardType": "CHARUCOBOARD",
    "useOldPattern": True,
    "tagFamily": "Dict_4X4_1000",
}


@pytest.mark.parametrize(
    ("kind", "cols", "plane"),
    [
        ("CHESSBOARD", 9, Plane("", 9, 6, 50.0)),
        ("CHARUCOBOARD", 9, charuco(10, 7, 50.0, 25.0, "DICT_4X4_50")),
        ("CIRCLES_GRID", 7, CirclePlane("", 7, 6, 50.0)),
        ("ASYMMETRIC_CIRCLES_GRID", 4, CirclePlane("", 4, 6, 50.0, asymmetric=True)),
    ],
)
def test_settings_of_opencv_count_inner_vertices(tmp_path: Path, kind: str, cols: int, plane: Plane) -> None:
    path = tmp_path / "default.xml"
    path.write_text(OPENCV.format(kind=kind, cols=cols))
    assert read_board(path) == Board((plane,))


def test_caliscope_measures_the_square_in_cm(tmp_path: Path) -> None:
    path = tmp_path / "charuco.toml"
    path.write_text(CALISCOPE)
    (plane,) = read_board(path).planes
    markers = Markers(0.75 * 5.4, "DICT_4X4_50", False, 0, True)
    assert read_board(path) == Board((Plane("", 3, 4, 5.4, markers=markers),), "cm")
    path.write_text(CALISCOPE.replace("square_size_overide_cm = 5.4\n", "").replace("[charuco]\n", ""))
    board = read_board(path)
    assert board.unit == "inch"
    assert board.planes[0].square == pytest.approx(8.5 / 4)
    assert plane.markers is not None


def test_photonvision_counts_squares_in_inches(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"startCalibration": PHOTON}))
    assert read_board(path) == Board((charuco(8, 6, 1.0, 0.75, "DICT_4X4_1000", True),), "inch")
    path.write_text(json.dumps(PHOTON | {"boardType": 0}))
    assert read_board(path) == Board((Plane("", 7, 5, 1.0),), "inch")


def test_the_calibration_of_photonvision_counts_inner_vertices_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "photon_calibration_1280x720.json"
    size = {"width": 7.0, "height": 5.0}
    path.write_text(json.dumps({"observations": [], "calobjectSize": size, "calobjectSpacing": 0.0254}))
    assert read_board(path) == Board((Plane("", 7, 5, 0.0254),), "m")


@pytest.mark.parametrize(
    "text",
    [
        "%YAML:1.0\n---\nsquares_x: 8\nsquares_y: 6\nsquare_length: 0.03\nmarker_length: 0.02\n"
        "dictionary: 10\nunit: m\n",
        '{"type": "charuco", "columns": 8, "rows": 6, "checkerWidth": 0.03, "markerSize": 0.02, '
        '"dictionary": "6x6_250", "unit": "m"}',
        "board:\n  squaresX: 8\n  squaresY: 6\n  squareLength: 0.03\n  markerLength: 0.02\n"
        "  aruco_dict: DICT_6X6_250\n  unit: m\n",
    ],
)
def test_the_arguments_of_opencv_describe_a_board(tmp_path: Path, text: str) -> None:
    path = tmp_path / "board.txt"
    path.write_text(text)
    assert read_board(path) == Board((charuco(8, 6, 0.03, 0.02, "DICT_6X6_250"),), "m")


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    path.write_text("squares_x: 8\nsquares_y: 6\nmarker_length: 0.02\n")
    with pytest.raises(FormatError, match="without square_length; describe the board"):
        read_board(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            OPENCV.format(kind="SPHERES", cols=9),
            "Calibrate_Pattern must be chessboard, charucoboard, circlesgrid",
        ),
        (
            OPENCV.replace("Calibrate_Pattern", "Pattern").format(kind="CHESSBOARD", cols=9),
            "without Calibrate_P",
        ),
        (
            "tagCols: 6\ntagRows: 6\ntagSize: 0.08\ntagSpacing: 0.3\n",
            "Kalibr is the nearest .* has target_type",
        ),
        ("kind: charuco\nsquares: [8, 6]\nsquare: 30\nmarker: 20\nlegacy: 1\n", "legacy must be auto, true"),
    ],
)
def test_a_file_that_is_nearly_a_board_is_told_what_it_lacks(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "board.txt"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        read_board(path)


def test_inverted_boards_are_written_and_read() -> None:
    plane = Plane("", 5, 4, 30.0, markers=Markers(20.0, "DICT_4X4_50", False, 3, True))
    tags = TagPlane("", 6, 4, 30.0, markers=Markers(30.0, "tag36h11", None, 0, True))
    for one in (plane, tags):
        board = Board((one,))
        assert "inverted: true" in format_board(board)
        assert parse_board(format_board(board)) == board
        assert parse_board(board_line(board)) == board
    assert board_line(Board.single(9, 6, 25.0)) == ""

"""Kinds of boards in files, on the command line, and in Kalibr's target files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neurocal_cli.errors import FormatError, InputError, UsageError
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.files.board_yaml import format_board, parse_board
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import CirclePlane, TagPlane
from neurocal_cli.observations.marked_cells import printed_rectangles
from neurocal_cli.observations.markers import Markers, code, dictionary_name

CHARUCO = """kind: charuco
squares: [8, 6]
square: 25.4
marker: 19.05
dictionary: DICT_4X4_1000
legacy: auto
first_id: 4
"""
ARUCOGRID = (
    "kind: arucogrid\nmarkers: [5, 7]\nmarker: 40\nspacing: 0.25\ndictionary: DICT_6X6_250\nborder: 2\n"
)
APRILGRID = "kind: aprilgrid\nunit: m\ntags: [6, 5]\ntag: 0.088\nspacing: 0.3\nfamily: tag36h11\n"


def test_a_charuco_board_is_a_chessboard_with_markers() -> None:
    plane = Plane("", 7, 5, 25.4, markers=Markers(19.05, "DICT_4X4_1000", None, 4))
    assert parse_board(CHARUCO) == Board((plane,))
    assert plane.vertex_ids()[:2] == ("0:0", "1:0")


def test_a_board_without_a_kind_is_a_chessboard() -> None:
    text = "unit: cm\ncols: 8\nrows: 5\nsquare: 3\n"
    assert (
        parse_board(text) == parse_board(f"kind: chessboard\n{text}") == Board((Plane("", 8, 5, 3.0),), "cm")
    )
    with pytest.raises(FormatError, match="the key 'size' is not known"):
        parse_board(text + "size: 2\n")


def test_a_grid_of_tags_counts_from_the_lower_left_as_kalibr_does() -> None:
    board = parse_board(APRILGRID)
    (plane,) = board.planes
    assert board.unit == "m"
    assert plane == TagPlane.of((6, 5), 0.088, 0.3)
    places = dict(zip(plane.vertex_ids(), plane.vertices().reshape(-1, 3), strict=True))
    pitch = 0.088 * 1.3
    np.testing.assert_allclose(places["0:0"], [0, 0, 0])
    np.testing.assert_allclose(places["0:2"], [0.088, 0.088, 0])
    np.testing.assert_allclose(places["7:1"], [pitch + 0.088, pitch, 0])
    middles = dict(zip(*plane.midpoints(), strict=True))
    assert len(middles) == 4 * 30
    np.testing.assert_allclose(middles["7:e0"], [pitch + 0.044, pitch, 0])
    np.testing.assert_allclose(middles["7:e3"], [pitch, pitch + 0.044, 0])


@pytest.mark.skipif(not hasattr(cv2, "aruco"), reason="this OpenCV has no markers")
def test_a_grid_of_aruco_markers_is_opencv_s() -> None:
    (plane,) = parse_board(ARUCOGRID.replace("border: 2\n", "")).planes
    assert isinstance(plane, TagPlane)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    opencv = cv2.aruco.GridBoard((5, 7), 40.0, 10.0, family)
    places = dict(zip(plane.vertex_ids(), plane.vertices().reshape(-1, 3), strict=True))
    for number, corners in zip(opencv.getIds().ravel().tolist(), opencv.getObjPoints(), strict=True):
        np.testing.assert_allclose([places[f"{number}:{k}"] for k in range(4)], corners, atol=1e-5)
    middles = dict(zip(*plane.midpoints(), strict=True))
    for k in range(4):
        expected = (places[f"6:{k}"] + places[f"6:{(k + 1) % 4}"]) / 2
        np.testing.assert_allclose(middles[f"6:e{k}"], expected)
    x, y, dark = printed_rectangles(plane)
    picture = opencv.generateImage((5 * 40 + 4 * 10, 7 * 40 + 6 * 10), None, 0, 1)
    v, u = np.indices(picture.shape) + 0.5
    mine = dark[np.searchsorted(y, v / 40.0), np.searchsorted(x, u / 40.0)]
    assert (mine == (picture < 128)).mean() > 0.999


@pytest.mark.skipif(not hasattr(cv2, "aruco"), reason="this OpenCV has no markers")
@pytest.mark.parametrize("rows", [6, 5])
def test_the_legacy_pattern_is_opencv_s(rows: int) -> None:
    text = CHARUCO.replace("auto", "true").replace("[8, 6]", f"[8, {rows}]").replace("id: 4", "id: 0")
    (plane,) = parse_board(text).planes
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    opencv = cv2.aruco.CharucoBoard((8, rows), 40.0, 30.0, family)
    opencv.setLegacyPattern(True)
    picture = opencv.generateImage((8 * 80, rows * 80), None, 0, 1)
    x, y, dark = printed_rectangles(plane)
    v, u = np.indices(picture.shape) + 0.5
    mine = dark[np.searchsorted(y, v / 80.0 - 1), np.searchsorted(x, u / 80.0 - 1)]
    assert (mine == (picture < 128)).mean() > 0.99


def test_asymmetric_circles_lie_as_opencv_says() -> None:
    (plane,) = parse_board("kind: asymmetric_circles\ncircles: [4, 11]\ndistance: 20\n").planes
    assert isinstance(plane, CirclePlane)
    ids, world = plane.midpoints()
    assert ids[:5] == ("0:0", "1:0", "2:0", "3:0", "0:1")
    np.testing.assert_allclose(world[[0, 1, 4, 8]], [[0, 0, 0], [40, 0, 0], [20, 20, 0], [0, 40, 0]])


@pytest.mark.parametrize(
    "text",
    [
        CHARUCO,
        ARUCOGRID,
        CHARUCO.replace("auto", "true").replace("dictionary: DICT_4X4_1000\n", ""),
        APRILGRID + "first_id: 30\nborder: 1\n",
        "kind: circles\ncircles: [7, 6]\ndistance: 30\ndiameter: 18.5\n",
        "kind: chessboard\nsquares: [10, 7]\nsquare: 25\n",
        "planes:\n"
        "  - {name: left, kind: charuco, squares: [5, 7], square: 30, marker: 22, origin: [0, 0, 0], "
        "x_axis: [1, 0, 0], y_axis: [0, 1, 0]}\n"
        "  - {name: right, kind: charuco, squares: [5, 7], square: 30, marker: 22, first_id: 17, "
        "origin: [0, 0, 9], x_axis: [1, 0, 0], y_axis: [0, 0, 1]}\n",
    ],
)
def test_a_board_reads_back(text: str) -> None:
    board = parse_board(text)
    assert parse_board(format_board(board)) == board


@pytest.mark.parametrize(
    ("form", "plane"),
    [
        ("chessboard:9x6:25", Plane("", 9, 6, 25.0)),
        ("charuco:8x8:25.4:19.05", Plane("", 7, 7, 25.4, markers=Markers(19.05))),
        ("charuco:8x6:30:22:5x5_100", Plane("", 7, 5, 30.0, markers=Markers(22.0, "DICT_5X5_100"))),
        ("aprilgrid:6x6:0.088:0.3", TagPlane.of((6, 6), 0.088, 0.3)),
        ("aprilgrid:3x2:40:0.2:t25h9", TagPlane.of((3, 2), 40.0, 0.2, "tag25h9")),
        (
            "arucogrid:5x7:40:0.25:6x6_250",
            TagPlane.of((5, 7), 40.0, 0.25, "DICT_6X6_250", border=1, downwards=True),
        ),
        ("circles:7x6:20", CirclePlane("", 7, 6, 20.0)),
        ("asymmetric_circles:4x11:20:15", CirclePlane("", 4, 11, 20.0, diameter=15.0, asymmetric=True)),
    ],
)
def test_short_forms(form: str, plane: Plane) -> None:
    assert short_board(form, "cm") == Board((plane,), "cm")


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("checker_200x150_8x11_15.pdf", "chessboard:10x7:15"),
        ("checker_A4_8x11_20.pdf", "chessboard:10x7:20"),
        ("charuco_200x150_8x11_15_11_DICT_4X4.pdf", "charuco:11x8:15:11:DICT_4X4_1000"),
        ("CHARUCO_300x220_5x7_40_31_DICT_ARUCO_ORIGINAL.svg", "charuco:7x5:40:31:DICT_ARUCO_ORIGINAL"),
        ("circles_200x150_8x10_18_8.33.pdf", "circles:10x8:18:8.33"),
        ("circles_200x150_8x11_12_5_01.bmp", "circles:11x8:12:5"),
    ],
)
def test_the_names_of_calib_ios_files_tell_rows_columns_and_mm(name: str, form: str) -> None:
    assert short_board(f"downloads/calib.io_{name}", "cm") == short_board(form, "mm")


@pytest.mark.parametrize("form", ["board.yaml", "charuco", "C:/boards/charuco.yaml"])
def test_other_texts_are_no_short_forms(form: str) -> None:
    assert short_board(form) is None


@pytest.mark.parametrize(
    ("form", "match"),
    [
        ("charuco:8x8:25.4", "give charuco:COLSxROWS:SQUARE:MARKER"),
        ("charuco:8x8:25.4:30", "marker must be at most the square's side 25.4"),
        ("charuco:8x8:30:20:DICT_9X9", "the dictionary 'DICT_9X9' is not known"),
        ("aprilgrid:6:40:0.3", "give aprilgrid:"),
        ("arucogrid:5x7:40:0.25", "give arucogrid:COLSxROWS:MARKER:SPACING:DICTIONARY"),
        ("circles:7x6:twenty", "give circles:"),
        ("circles:7x6:20:30", "diameter must be below the distance"),
        ("aprilgrid:6x6:40:-1", "spacing must be a positive ratio"),
        ("calib.io_charuco_215.9x279.4_7x5_35_DICT_4X4.pdf", "5x7:35:4X4_1000: give charuco:COLSxROWS"),
    ],
)
def test_wrong_short_forms_say_what_is_right(form: str, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        short_board(form)


def test_kalibr_targets_are_read() -> None:
    tags = parse_board(
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\ncodeOffset: 10\n"
    )
    assert tags == Board((TagPlane.of((6, 5), 0.088, 0.3, first_id=10),), "m")
    chess = parse_board(
        "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\n"
        "colSpacingMeters: 0.06\n"
    )
    assert chess == Board((Plane("", 6, 7, 0.06),), "m")
    circles = parse_board(
        "target_type: circlegrid\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: True\n"
    )
    assert circles == Board((CirclePlane("", 4, 11, 0.02, asymmetric=True),), "m")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("kind: squircles\n", "kind must be one of chessboard, charuco"),
        (CHARUCO + "tag: 3\n", "the key 'tag' is not known"),
        (CHARUCO.replace("[8, 6]", "[8]"), "squares must be two whole numbers"),
        (CHARUCO.replace("auto", "perhaps"), "legacy must be auto, true or false"),
        ("target_type: spheres\ntargetCols: 4\ntargetRows: 4\n", "target_type must be aprilgrid"),
        (
            "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\n"
            "colSpacingMeters: 0.07\n",
            "the squares are 0.07 x 0.06 m",
        ),
    ],
)
def test_wrong_files_are_named(text: str, match: str) -> None:
    with pytest.raises(FormatError, match=match):
        parse_board(text)


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("4x4_50", "DICT_4X4_50"),
        ("DICT_APRILTAG_36h11", "DICT_APRILTAG_36h11"),
        ("t36h11", "DICT_APRILTAG_36h11"),
        ("tag25h9", "DICT_APRILTAG_25h9"),
        ("ARUCO_ORIGINAL", "DICT_ARUCO_ORIGINAL"),
        ("aruco_mip_36h12", "DICT_ARUCO_MIP_36h12"),
    ],
)
def test_dictionaries_have_their_usual_names(name: str, known: str) -> None:
    assert dictionary_name(name) == known


def test_a_marker_has_a_dark_border_and_its_code() -> None:
    dark = code("DICT_4X4_50", 0, 2)
    assert dark.shape == (8, 8)
    assert dark[:2].all()
    assert dark[:, -2:].all()
    assert not dark.all()
    with pytest.raises(InputError, match="no marker 50; its last one is 49"):
        code("DICT_4X4_50", 50)


def test_a_scaled_board_scales_its_markers_and_circles() -> None:
    plane = CirclePlane("", 4, 3, 10.0, diameter=6.0).rescaled(2.0)
    assert plane.diameter == 12.0
    assert plane.square == 20.0
    marked = Plane("", 4, 3, 10.0, markers=Markers(8.0)).rescaled(0.5)
    assert marked.markers == Markers(4.0)

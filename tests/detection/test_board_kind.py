"""The kind and the size of a board are found without being told, and never another one."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support import no_boards
from support.marked import errors_of, marked_scene, plane_of, taken
from support.places import SAMPLES
from support.real_data import RealFiles

from neurocal_cli.detection.appearance import departure_from_circles
from neurocal_cli.detection.board_kind import FoundBoard, find_board, found_board
from neurocal_cli.detection.circles.pattern import SeenCircles, agreed_circles, seen_circles
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.finding.grids import find_grids
from neurocal_cli.detection.markers.numbering import joined, layouts, lie_of, numbered
from neurocal_cli.detection.markers.reading import Marks
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.files.board_kinds import kind_of
from neurocal_cli.files.images import read_image
from neurocal_cli.observations.board import Plane
from neurocal_cli.observations.board_kinds import TagPlane, found_words
from neurocal_cli.observations.marked_cells import Print, marked_cells


def board_in(form: str, *, legacy: bool = False, square: float = 32.0, first_id: int = 0) -> FoundBoard:
    """The board that is found in one picture of a board in short."""
    plane = plane_of(form, legacy)
    if first_id:
        assert plane.markers is not None
        plane = replace(plane, markers=replace(plane.markers, first_id=first_id))
    return found_board([taken(marked_scene(plane, 1, square=square), 1, 4).image])


def marks_of(plane: Plane, numbers: list[int], *, legacy: bool = False) -> Marks:
    """Markers of a plane seen in perspective."""
    H = np.array([[40.0, 6, 300], [-5, 35, 400], [1e-2, 2e-2, 1]])
    cells = marked_cells(plane, Print(legacy=legacy))
    at = cells.of(np.array(numbers))
    seen = np.concatenate([plane.spread(cells.corners[at]), np.ones((len(at), 4, 1))], axis=2) @ H.T
    return Marks(cells.number[at], seen[..., :2] / seen[..., 2:], "DICT_4X4_1000")


@pytest.mark.parametrize(
    ("form", "legacy", "first_id"),
    [
        ("charuco:6x5:40:30:DICT_4X4_50", False, 0),
        ("charuco:7x6:40:28:DICT_5X5_50", True, 7),
        ("aprilgrid:4x3:40:0.25:tag36h11", False, 0),
    ],
)
def test_boards_with_markers_are_found(form: str, legacy: bool, first_id: int) -> None:
    found = board_in(form, legacy=legacy, first_id=first_id, square=28.0)
    plane, true = found.plane, plane_of(form)
    assert found.sure
    assert (kind_of(plane), plane.cols, plane.rows) == (kind_of(true), true.cols, true.rows)
    assert plane.markers is not None
    assert true.markers is not None
    assert (plane.markers.dictionary, plane.markers.first_id) == (true.markers.dictionary, first_id)
    assert bool(plane.markers.legacy) == legacy
    if isinstance(plane, TagPlane):
        assert plane.spacing == 0.25
        assert plane.border == 2
    else:
        assert plane.markers.side == pytest.approx(true.markers.side / true.square, abs=1e-6)


@pytest.mark.parametrize(
    ("form", "square"), [("charuco:6x5:40:30:DICT_6X6_50", 32), ("aprilgrid:4x3:40:0.25:tag36h11", 34)]
)
def test_codes_are_read_though_a_blur_mixes_their_cells(form: str, square: float) -> None:
    true = plane_of(form)
    found = found_board([taken(marked_scene(true, 1, square=square, psf=1.6, noise=4.0), 1, 4).image]).plane
    assert (kind_of(found), found.cols, found.rows) == (kind_of(true), true.cols, true.rows)


def test_the_side_of_the_markers_is_told_by_one_between_four_vertices() -> None:
    found = board_in("charuco:3x5:30:22:DICT_6X6_250", square=40.0)
    assert found.plane.markers is not None
    assert found.plane.markers.side == pytest.approx(22 / 30, abs=0.004)  # 0.7


@pytest.mark.parametrize("form", ["charuco:6x5:1:0.7:DICT_5X5_50", "circles:6x5:1:0.6"])
def test_a_floor_of_squares_does_not_hide_a_board(form: str) -> None:
    picture = taken(marked_scene(plane_of(form), 3, square=28.0), 3, 2)
    vertices = picture.truth.planes[0].vertices.reshape(-1, 2)
    outline = cv2.convexHull(vertices.astype(np.float32)).reshape(-1, 2)
    paper = np.zeros(picture.image.shape, dtype=np.uint8)
    cv2.fillConvexPoly(
        paper, np.rint(outline.mean(axis=0) + 1.7 * (outline - outline.mean(axis=0))).astype(int), 1
    )
    v, u = np.indices(paper.shape)
    floor = np.where((u // 18 + v // 18) % 2 == 0, 50.0, 190.0)
    image = np.where(paper > 0, picture.image, cv2.GaussianBlur(floor, (0, 0), 0.8)).round().astype(np.uint8)
    assert found_words(found_board([image]).plane) == found_words(plane_of(form))


@pytest.mark.parametrize("gamma", [0.6, 2.2])
def test_light_that_spreads_does_not_change_the_side_of_the_markers(gamma: float) -> None:
    """It moves both edges of the gap beside a marker, by a hundredth of a square here."""
    image = taken(
        marked_scene(plane_of("charuco:6x5:40:28:DICT_5X5_50"), 3, square=44.0, psf=1.4), 3, 4
    ).image
    found = found_board([np.rint(255 * (image / 255) ** (1 / gamma)).astype(np.uint8)])
    assert found.plane.markers is not None
    assert found.plane.markers.side == 0.7


@pytest.mark.parametrize("form", ["asymmetric_circles:4x7:20:16", "circles:7x6:20:12"])
def test_grids_of_circles_are_found(form: str) -> None:
    found = board_in(form, square=18.0 if "asym" in form else 26.0)
    true = plane_of(form)
    assert found.sure
    assert (kind_of(found.plane), found.plane.cols, found.plane.rows) == (kind_of(true), true.cols, true.rows)


@pytest.mark.parametrize(
    ("form", "seed", "psf"),
    # Of the second, the square around each marker looks like a marker, too.
    [("charuco:6x5:40:30:DICT_4X4_50", 2, 0.8), ("charuco:6x5:40:32:DICT_6X6_250", 1, 1.2)],
)
def test_light_and_dark_may_be_exchanged(form: str, seed: int, psf: float) -> None:
    plane = plane_of(form)
    assert plane.markers is not None
    plane = replace(plane, markers=replace(plane.markers, inverted=True))
    scene = marked_scene(plane, seed, square=30.0, psf=psf)
    picture = taken(scene, seed, 4)
    found = found_board([picture.image]).plane
    assert found.markers is not None
    assert (found.markers.inverted, found.cols, found.rows) == (True, 5, 4)
    error, _ = errors_of(detect_points(picture.image, scene.board, "vertices"), picture)
    assert len(error) == 20
    assert np.abs(error).max() < 0.03


@pytest.mark.parametrize(
    ("first", "second", "kind", "told"),
    [
        (
            ("circles:6x5:20:12", 26),
            ("circles:5x4:20:12", 22),
            "circles",
            "1 image also shows a grid of 5 x 4 circles",
        ),
        (
            ("charuco:6x5:40:30:DICT_4X4_50", 32),
            ("aprilgrid:4x3:40:0.25", 40),
            "charuco",
            r"1 image also shows markers \d to \d+ of DICT_APRILTAG_36h11",
        ),
        (
            ("chessboard:7x5:25", 32),
            ("chessboard:9x6:25", 16),
            "chessboard",
            "1 image also shows a chessboard of 9 x 6",
        ),
    ],
)
def test_another_board_in_view_is_told(
    first: tuple[str, float], second: tuple[str, float], kind: str, told: str
) -> None:
    images = [
        taken(marked_scene(plane_of(form), 1, square=square, tilt=20.0), 1, 3).image
        for form, square in (first, second)
    ]
    found, alone = found_board([np.hstack(images)]), found_board(images[:1])
    assert kind_of(found.plane) == kind
    assert (found.plane, alone.doubts) == (alone.plane, ())
    (doubt,) = found.doubts
    assert re.match(rf"{told}.*, which is not the board that is taken; describe it by --board", doubt)


def test_the_unit_and_the_side_are_the_callers() -> None:
    image = taken(marked_scene(plane_of("charuco:6x5:40:30:DICT_4X4_50"), 1, square=32.0), 1, 4).image
    board = find_board([image], 25.0, "mm")
    (plane,) = board.planes
    assert (plane.square, board.unit) == (25.0, "mm")
    assert plane.markers is not None
    assert plane.markers.side == 18.75


def test_parts_of_a_board_tell_it_together() -> None:
    plane = plane_of("charuco:8x8:40:30:DICT_4X4_50")
    halves = [[0, 1, 4, 5, 8, 9, 12, 13, 16, 17], [14, 15, 17, 18, 19, 22, 23, 26, 27, 30, 31]]
    lies = [lie for half in halves if (lie := lie_of(marks_of(plane, half))) is not None]
    numbering = numbered(lies)
    assert numbering is not None
    assert numbering.cols == 8
    first, *_ = layouts(False, 8, joined(numbering.parts), (0, 0), begins=True)
    assert (first.rows, first.first_id, first.legacy) == (8, 0, False)


def test_markers_of_one_row_do_not_tell_the_board() -> None:
    lie = lie_of(marks_of(plane_of("charuco:8x8:40:30:DICT_4X4_50"), [0, 1, 2, 3]))
    assert lie is not None
    assert numbered([lie]) is None


def test_rows_that_no_image_shows_are_told_by_the_first_number() -> None:
    plane = plane_of("charuco:7x6:40:30:DICT_4X4_50")
    lie = lie_of(marks_of(plane, list(range(7, 20))))
    assert lie is not None
    numbering = numbered([lie])
    assert numbering is not None
    unsure = layouts(False, 7, joined(numbering.parts), (0, 0), begins=False)
    assert (unsure[0].first_id, unsure[0].rows) == (0, 6)
    assert len(unsure) > 1
    (sure,) = layouts(False, 7, joined(numbering.parts), (0, 0), begins=True)
    assert (sure.first_id, sure.rows) == (7, 4)


def test_markers_of_other_images_continue_a_board_whose_end_is_not_seen() -> None:
    for form, cols, seen, last, rows in (
        ("aprilgrid:6x6:40:0.25", 6, range(18), 35, 6),
        ("charuco:7x6:40:30:DICT_4X4_50", 7, range(12), 20, 6),
        ("charuco:8x7:40:30:DICT_4X4_50", 8, range(12), 27, 7),
    ):
        lie = lie_of(marks_of(plane_of(form), list(seen)))
        assert lie is not None
        numbering = numbered([lie])
        assert numbering is not None
        parts = joined(numbering.parts)
        assert layouts(lie.tags, cols, parts, (0, 0), True, last)[0].rows == rows
        assert layouts(lie.tags, cols, parts, (0, 0), True)[0].rows < rows


def test_markers_that_stand_alone_are_named() -> None:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    image = cv2.aruco.GridBoard((6, 4), 30.0, 8.0, family).generateImage((1000, 696), None, 60)
    with pytest.raises(NoBoardError, match=r"6 x 4 markers that stand alone.*arucogrid:6x4:.*about 0\.2[78]"):
        found_board([image])


def test_grids_of_circles_that_differ_are_refused() -> None:
    one, other = SeenCircles(7, 6, False, whole=True), SeenCircles(4, 11, True, whole=True)
    plane, sure = agreed_circles([one, one, one, replace(other, whole=False)])
    assert (plane.cols, plane.rows, plane.asymmetric, sure) == (7, 6, False, True)
    with pytest.raises(NoBoardError, match="different grids, 7 x 6 circles and 4 x 11 asymmetric circles"):
        agreed_circles([one, other])
    with pytest.raises(NoBoardError, match="only parts of a grid of circles"):
        agreed_circles([replace(one, whole=False, full=True)])
    plane, sure = agreed_circles([replace(one, whole=False, full=True)] * 2)
    assert (plane.cols, plane.rows, sure) == (7, 6, False)


@pytest.mark.parametrize(("pattern", "legacy"), [("new", False), ("legacy", True)])
def test_photographs_of_a_charuco_board_tell_it(real_files: RealFiles, pattern: str, legacy: bool) -> None:
    paths = real_files(f"charuco_lifecam/{pattern}*.jpg")[::3]
    plane = found_board(np.asarray(cv2.imread(str(path), 0)) for path in paths).plane
    markers = plane.markers
    assert markers is not None
    assert (plane.cols, plane.rows, markers.dictionary) == (7, 7, "DICT_4X4_50")
    assert (markers.legacy, markers.first_id) == (legacy, 0)
    assert markers.side == 0.75


def test_photographs_of_circles_tell_their_pattern(real_files: RealFiles) -> None:
    for path in real_files("photographs/circles*.jpg"):
        plane = found_board([np.asarray(cv2.imread(str(path), 0))]).plane
        assert (kind_of(plane), plane.cols, plane.rows) == ("asymmetric_circles", 7, 10)


@pytest.mark.parametrize("side", [9, 20])
def test_squares_in_a_grid_are_no_circles(side: int) -> None:
    image = np.full((300, 400), 20, np.uint8)
    for row in range(8):
        for column in range(10):
            left, top = 45 + 32 * column, 25 + 32 * row
            cv2.rectangle(image, (left, top), (left + side, top + side), (230,), -1)
    for blur in (1.0, 1.5):
        assert seen_circles(cv2.GaussianBlur(image, (0, 0), blur)) is None


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("dice", 20),
        ("lamps", 3),
        ("lamps", 229),
        ("bottles", 4),
        ("pieces", 33),
        ("pieces", 205),
        ("polygons", 13),
        ("targets", 142),
        ("targets", 176),
        ("discs", 145),
    ],
)
def test_things_in_rows_are_no_circles(kind: str, seed: int) -> None:
    assert seen_circles(no_boards.picture(kind, seed)) is None


def test_things_in_shifted_rows_are_no_chessboard() -> None:
    assert find_grids(no_boards.picture("windows", 186)) == []


@pytest.mark.parametrize("gaps", [(0, 0), (6, 6), (6, 0), (6, 10), (6, 12), (-4, 4)])
def test_squares_whose_gaps_differ_along_the_axes_are_no_chessboard(gaps: tuple[int, int]) -> None:
    image = np.full((1040, 1280), 220, np.uint8)
    for row in range(6):
        for column in range(row % 2, 8, 2):
            left, top = 100 + 120 * column, 100 + 120 * row
            cv2.rectangle(image, (left, top), (left + 119 - gaps[0], top + 119 - gaps[1]), (30,), -1)
    seen = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    found = find_grids(cv2.GaussianBlur(seen, (0, 0), 1.0))
    assert [sorted(grid.shape) for grid in found] == ([[5, 7]] if gaps[0] == gaps[1] else [])


@pytest.mark.parametrize("radius", [0, 6])
def test_squares_of_a_chessboard_have_sharp_corners(radius: int) -> None:
    image = np.full((960, 1280), 220, np.uint8)
    for row in range(6):
        for column in range(row % 2, 8, 2):
            left, top = 100 + 120 * column, 100 + 120 * row
            cv2.rectangle(image, (left, top), (left + 119, top + 119), (30,), -1)
            if radius:
                corner = np.hypot(*np.maximum(np.abs(np.indices((120, 120)) - 59.5) - (60 - 4 * radius), 0))
                image[top : top + 120, left : left + 120][corner > 4 * radius] = 220
    seen = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    found = find_grids(cv2.GaussianBlur(seen, (0, 0), 1.0))
    assert [sorted(grid.shape) for grid in found] == ([] if radius else [[5, 7]])


def test_circles_may_be_labelled_and_sharpened() -> None:
    image = np.full((960, 1280), 190, np.uint8)
    for row in range(6):
        for column in range(6):
            cv2.circle(image, (290 + 110 * column, 190 + 110 * row), 38, (30,), -1, cv2.LINE_AA)
    for label, (row, column) in enumerate([(1, 1), (1, 4), (3, 4), (4, 1)], 1):
        at = (242 + 110 * column, 161 + 110 * row)
        cv2.putText(image, str(label), at, cv2.FONT_HERSHEY_SIMPLEX, 1.0, (30,), 2, cv2.LINE_AA)
    seen = cv2.resize(cv2.GaussianBlur(image, (0, 0), 1.0), None, fx=0.5, fy=0.5)
    assert seen_circles(seen) is not None
    sharpened = cv2.addWeighted(seen, 2.0, cv2.GaussianBlur(seen, (0, 0), 1.0), -1.0, 0.0)
    assert seen_circles(sharpened) is not None


@pytest.mark.parametrize(
    ("corners", "radius", "blur"), [(0, 40, 1.7), (6, 40, 1.7), (0, 18, 1.4), (5, 18, 1.8), (6, 18, 1.4)]
)
def test_blurred_nuts_are_no_circles(corners: int, radius: int, blur: float) -> None:
    image = np.full((960, 1280), 60, np.uint8)
    angle = 2 * np.pi * np.arange(corners or 360) / (corners or 360)
    shape = np.array([290, 270]) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for row in range(4):
        for column in range(6):
            places = np.rint(8 * (shape + 140 * np.array([column, row]))).astype(np.int32)
            cv2.fillPoly(image, [places], (170,), cv2.LINE_AA, 3)
    seen = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    assert (seen_circles(cv2.GaussianBlur(seen, (0, 0), blur)) is None) == bool(corners)


@pytest.mark.parametrize("gap", [0, 4])
def test_dice_that_nearly_touch_are_no_circles(gap: int) -> None:
    image = np.full((960, 1280), 210, np.uint8)
    for row in range(8):
        for column in range(12):
            cv2.circle(image, (150 + 80 * column, 150 + 80 * row), 20, (40,), -1, cv2.LINE_AA)
    for end in range(190, 1110, 160):
        image[110:750, end : end + gap] = 140
    for end in range(190, 750, 160):
        image[end : end + gap, 110:1070] = 140
    seen = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    assert (seen_circles(cv2.GaussianBlur(seen, (0, 0), 1.2)) is None) == bool(gap)


@pytest.mark.parametrize("blur", [1.0, 1.4])
def test_what_hexagons_depart_by_is_known(blur: float) -> None:
    """It is known from circles, and so whether the image can tell both apart."""
    row, column = (x.ravel() for x in np.indices((6, 7)))
    places = np.stack([column, row], axis=-1).astype(float)
    centre = np.array([36.0, 24.0]) - 0.375 + 30.0 * places
    v, u = np.indices((800, 1000))
    du, dv = (u - 144 + 60) % 120 - 60, (v - 96 + 60) % 120 - 60
    turned = (np.arctan2(dv, du) + 0.1) % (np.pi / 3) - np.pi / 6
    found = []
    for reach in (18 * np.cos(np.pi / 6) / np.cos(turned), 16.4):  # of a hexagon, and of a circle of its area
        image = np.where(np.hypot(du, dv) < reach, 50, 200).astype(np.float32)
        light = cv2.resize(
            cv2.GaussianBlur(image, (0, 0), 4 * blur), (250, 200), interpolation=cv2.INTER_AREA
        )
        area = np.full(len(places), np.pi * 4.1**2)
        found.append(departure_from_circles(light, places, centre, area, described=False))
    (hexagons, _), (circles, expected) = found
    assert circles < 5
    assert 0.4 < expected / hexagons < 4
    assert 5 * circles < expected


def test_circles_that_are_not_clear_need_a_second_image() -> None:
    large = np.full((1280, 1680), 200, np.uint8)
    for row in range(6):
        for column in range(7):
            # The distances along both axes differ by a twentieth, so these are no circles on a board.
            cv2.circle(large, (180 + 208 * column, 150 + 198 * row), 56, (50,), -1, cv2.LINE_AA)
    image = cv2.GaussianBlur(cv2.resize(large, (420, 320), interpolation=cv2.INTER_AREA), (0, 0), 1.2)
    seen = seen_circles(image)
    assert seen is not None
    assert (seen.full, seen.whole) == (True, False)
    with pytest.raises(NoBoardError, match="unclear circles, such as 7 x 6 circles"):
        found_board([image])
    plane = found_board([image, image[::-1]]).plane
    assert (plane.cols, plane.rows) == (7, 6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", no_boards.KINDS)
def test_no_board_is_found_where_there_is_none(kind: str) -> None:
    for seed in range(142, 214):
        with pytest.raises(NoBoardError):
            found_board([no_boards.picture(kind, seed)])


@pytest.mark.slow
@pytest.mark.parametrize("kind", no_boards.KINDS)
def test_hardly_any_things_in_rows_are_a_board(kind: str) -> None:
    """Full stops in rows and dice without gaps are circles on blank paper."""
    found = 0
    for seed in range(214, 286):
        try:
            found += bool(found_board([no_boards.picture(kind, seed)]))
        except NoBoardError:
            continue
    assert found <= {"letters": 2, "dice": 1, "tables": 1}.get(kind, 0)


@pytest.mark.parametrize(
    ("form", "square"), [("charuco:6x5:40:30:DICT_4X4_50", 24.0), ("circles:7x6:20:12", 13.0)]
)
def test_small_boards_in_large_images_are_found(form: str, square: float) -> None:
    image = np.full((1500, 2400), 200, np.uint8)
    image[700:940, 1300:1620] = taken(marked_scene(plane_of(form), 1, square=square), 1, 4).image
    found, true = found_board([image]).plane, plane_of(form)
    assert (kind_of(found), found.cols, found.rows) == (kind_of(true), true.cols, true.rows)


def test_squares_among_others_are_no_board() -> None:
    rng = np.random.default_rng(3)
    cells = (rng.random((24, 24)) < 0.5).astype(np.uint8)
    cells[9:13, 9:14] = np.indices((4, 5)).sum(axis=0) % 2
    image = cv2.resize(
        255 * np.pad(cells, 3, constant_values=1), None, fx=9, fy=9, interpolation=cv2.INTER_NEAREST
    )
    with pytest.raises(NoBoardError):
        found_board([cv2.GaussianBlur(image, (0, 0), 0.8)])


def test_tags_without_squares_at_their_corners_are_named() -> None:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((300, 380), 235, np.uint8)
    for k in range(12):
        left, top = 20 + 88 * (k % 4), 20 + 88 * (2 - k // 4)
        image[top : top + 70, left : left + 70] = cv2.aruco.generateImageMarker(family, k, 70)
    with pytest.raises(NoBoardError, match="4x3 tags without dark squares at their corners"):
        found_board([cv2.GaussianBlur(image, (0, 0), 0.8)])


def test_a_blurred_chessboard_is_not_told_to_have_markers() -> None:
    image = np.array(read_image(SAMPLES / "board02.png").grey)
    with pytest.raises(
        NoBoardError, match=r"are blurred, unevenly lit or have patterns in them.*sharper images"
    ):
        found_board([cv2.GaussianBlur(image, (0, 0), 7.0)])

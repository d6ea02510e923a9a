"""Boards with markers: read, placed and measured; markers do not disturb the edges."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from support.marked import errors_of, marked_scene, plane_of, taken, truth_of
from support.picture_bound import scene_bound
from support.pictures import Illumination, Rendered, Scene, digitised, ground_truth, image_light
from support.real_data import RealFiles
from support.slow_cases import slow_but
from support.uneven_light import half_in_shadow

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.homographies import homographies, homography_at
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.detection.detect import detect_points
from neurocal_cli.detection.finding.saddles import grey_levels
from neurocal_cli.detection.fitting.batched_newton import BLUR
from neurocal_cli.detection.fitting.strips import GridImage
from neurocal_cli.detection.grid import Grid
from neurocal_cli.detection.markers.ink import Ink, _Blurred
from neurocal_cli.detection.markers.ink_fit import fit_with_ink
from neurocal_cli.detection.markers.lattice import (
    agreement,
    find_vertices,
    leave_out_strays,
    place,
    tell_a_plane,
)
from neurocal_cli.detection.markers.locate import locate
from neurocal_cli.detection.markers.reading import (
    Marks,
    candidates,
    looks_at,
    markers_in,
    numbers_in,
    read_codes,
)
from neurocal_cli.detection.medians import upper_median
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.detection.wide_lens import Flattening, WideLens
from neurocal_cli.errors import InputError
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.observations.board_kinds import TagPlane
from neurocal_cli.observations.marked_cells import Print, marked_cells, printed_rectangles
from neurocal_cli.observations.measured_directions import variance_across

CHARUCO = "charuco:6x5:40:30:DICT_4X4_50"
APRIL = "aprilgrid:3x3:40:0.3"


def untold(plane: Plane) -> Board:
    """A board whose dictionary and pattern are not said."""
    assert plane.markers is not None
    return Board((replace(plane, markers=replace(plane.markers, dictionary="", legacy=None)),))


def vertex_bound(scene: Scene) -> float:
    """Rms bound of the vertices, from the squares alone."""
    target = scene.targets[0]
    plain = replace(scene, targets=(replace(target, plane=replace(target.plane, markers=None)),))
    bound = scene_bound(plain)[0].vertex
    return float(np.sqrt((bound**2).mean()))


def test_charuco_vertices_are_measured_to_the_bound_of_plain_squares() -> None:
    scene = marked_scene(plane_of(CHARUCO), 1)
    picture = taken(scene, 1)
    found = detect_points(picture.image, untold(scene.targets[0].plane), "vertices")
    error, squared = errors_of(found, picture)
    assert len(error) == 20
    assert np.sqrt((error**2).mean()) < 1.35 * vertex_bound(scene)
    assert 0.5 < squared.mean() < 1.6
    assert found.notes == ("the markers are of DICT_4X4_50",)


@pytest.mark.parametrize(("seed", "shift"), [(702, (-87.9, 149.4)), (703, (-217.7, 128.5))])
def test_a_small_part_of_a_board_through_a_lens_is_measured_to_the_bound(
    seed: int, shift: tuple[float, float]
) -> None:
    plane = plane_of("charuco:8x8:25.4:19.05:DICT_4X4_50")
    scene = marked_scene(plane, seed, square=74.0, tilt=35.0, noise=3.0, psf=0.9, k1=-0.1, shift=shift)
    picture = taken(scene, 1, 8)
    error, squared = errors_of(detect_points(picture.image, scene.board, "vertices"), picture)
    assert 8 <= len(error) <= 16
    assert np.sqrt((error**2).mean()) < 0.007
    assert squared.mean() < 1.6


@pytest.mark.parametrize(("seed", "shift"), [(5026, (-189.02, 189.83)), (8049, (133.25, 122.02))])
def test_eight_vertices_through_a_lens_are_measured_to_the_bound(
    seed: int, shift: tuple[float, float]
) -> None:
    """Their edges alone determine no lens; in the second, noise has a saddle point beside a vertex."""
    plane = plane_of("charuco:8x8:25.4:19.05:DICT_4X4_50")
    scene = marked_scene(plane, seed, square=70.0, tilt=40.0, noise=3.0, psf=0.9, k1=-0.1, shift=shift)
    picture = taken(scene, seed, 4)
    found = detect_points(picture.image, scene.board, "vertices")
    error, squared = errors_of(found, picture)
    assert len(error) == 8
    assert np.sqrt((error**2).mean()) < 0.006
    assert np.sqrt(found.covariance[:, [0, 2]].max()) < 0.008
    assert squared.mean() < 1.6


def fifth_of_a_board(seed: int) -> Scene:
    """A view of 7 to 13 of 49 vertices through a lens."""
    rng = np.random.default_rng([seed, 20])
    plane = plane_of("charuco:8x8:40:30:DICT_4X4_50")
    while True:
        shift = float(rng.uniform(-250, 250)), float(rng.uniform(-250, 250))
        drawn = int(rng.integers(1 << 30))
        scene = marked_scene(plane, drawn, 70.0, tilt=40.0, psf=0.9, noise=3.0, k1=-0.1, shift=shift)
        if 7 <= ground_truth(scene, 1.0).planes[0].vertices_visible.sum() <= 13:
            return scene


@pytest.mark.slow
@pytest.mark.parametrize("points", ["vertices", "midpoints"])
def test_a_fifth_of_a_board_is_not_displaced_towards_the_middle_of_the_image(
    points: Literal["vertices", "midpoints"],
) -> None:
    """The lens of a view bends all its lines, and an error of it displaces all points alike."""
    over_std = []
    for seed in range(200):
        scene = fifth_of_a_board(seed)
        picture = taken(scene, seed, 4)
        try:
            found = detect_points(picture.image, scene.board, points)
        except NoBoardError:
            continue
        true = np.array([truth_of(picture)[0][name] for name in found.ids])
        weight = np.linalg.inv(found.covariance[:, [[0, 1], [1, 2]]])
        if found.across is not None:  # along the edges, mid-points lie where the map says
            variance = variance_across(found.covariance, found.across)
            weight = found.across[:, :, None] * found.across[:, None] / variance[:, None, None]
        outwards = (weight @ (true - [159.5, 119.5])[:, :, None])[:, :, 0]
        error = (outwards * (found.pixels - true)).sum()
        over_std.append(error / np.sqrt((outwards * (true - [159.5, 119.5])).sum()))
    assert len(over_std) > 180
    assert np.mean(np.square(over_std)) < 1.3  # 1.0 +- 0.1 by chance; 1.5 by the edges between vertices alone


def test_blurred_markers_near_the_edges_do_not_move_them() -> None:
    scene = marked_scene(plane_of(CHARUCO), 2, psf=1.6)
    picture = taken(scene, 2, 4)
    found = detect_points(picture.image, scene.board, "midpoints")
    error, squared = errors_of(found, picture)
    assert len(error) == 31
    assert np.sqrt((error**2).mean()) < 0.02  # as if of the plain board: 0.009
    assert 0.4 < squared.mean() < 2


def test_ink_that_is_blurred_into_the_edges_does_not_shift_them() -> None:
    """Codes of 5 x 5 bits, 1.5 sigma from the edges."""
    scene = marked_scene(plane_of("charuco:8x6:28:21:DICT_5X5_100"), 811, square=36.0, psf=2.0)
    picture = taken(scene, 811, 4)
    error, squared = errors_of(detect_points(picture.image, scene.board, "vertices"), picture)
    assert len(error) == 35
    assert np.sqrt((error**2).mean()) < 0.009
    assert squared.mean() < 1.3


def test_codes_that_are_blurred_into_the_edges_leave_the_blur_and_the_noise_of_a_pixel() -> None:
    scene = marked_scene(plane_of("charuco:10x8:28:21:DICT_5X5_100"), 2, 14.0, (240, 180))
    image = taken(scene, 2).image
    (located,) = locate(scene.board, image).located
    assert located.ink is not None
    fitted = fit_with_ink(GridImage(image, located.grid, 1 / 12), located.ink)
    assert upper_median(fitted.fit.values[:, BLUR]) == pytest.approx(scene.sigma_t, rel=0.03)
    assert fitted.noise.edge == pytest.approx(scene.sensor.read_noise**2 + 1 / 12, rel=0.3)


@pytest.mark.parametrize("along", [(1, 0), (0, 1), (1, 1), (-1, 2)])
@pytest.mark.parametrize("first", [0, 2, 4])
def test_vertices_on_a_line_and_one_beside_it_do_not_tell_how_a_board_lies(
    along: tuple[int, int], first: int
) -> None:
    """A diagonal and one vertex gave a singular map, and an internal error."""
    line = np.arange(4.0)[:, None] * along
    beside = np.array([[2.0, 5.0], [5.0, 2.0]])
    assert not tell_a_plane(line)
    assert not tell_a_plane(np.insert(line, first, beside[0], axis=0))
    assert tell_a_plane(np.insert(line, [first, first], beside, axis=0))


def test_a_grid_without_a_whole_cell_shows_no_codes() -> None:
    pixels = np.full((2, 3, 2), np.nan)
    pixels[0] = [[10.0, 10.0], [20.0, 10.0], [30.0, 10.0]]
    cell, lines = np.zeros((1, 2), dtype=np.int64), np.linspace(0, 1, 5)
    which, _, agree = agreement(Grid(pixels, 0), cell, lines, np.ones((1, 4, 4)), np.zeros((40, 40)))
    assert len(which) == len(agree) == 0


def test_the_legacy_pattern_is_told_from_the_image() -> None:
    scene = marked_scene(plane_of("charuco:5x6:40:30:DICT_5X5_100", legacy=True), 3)
    picture = taken(scene, 3, 4)
    found = detect_points(picture.image, untold(scene.targets[0].plane), "vertices")
    assert len(errors_of(found, picture)[0]) == 20
    assert found.notes == (
        "the markers are of DICT_5X5_50; the board has the legacy pattern, whose first square is light",
    )
    assert np.abs(errors_of(found, picture)[0]).max() < 0.05


def test_a_corner_of_the_board_is_enough() -> None:
    scene = marked_scene(plane_of("charuco:8x8:40:30:DICT_4X4_50"), 4, square=60, shift=(150.0, 90.0))
    picture = taken(scene, 4, 4)
    (plane,) = picture.truth.planes
    found = detect_points(picture.image, scene.board, "vertices")
    error, _ = errors_of(found, picture)
    assert 8 <= plane.vertices_visible.sum() <= 16
    assert len(error) >= 0.65 * plane.vertices_visible.sum()  # those at the image border are too near to it
    assert np.abs(error).max() < 0.05
    # Two markers.
    found = detect_points(np.ascontiguousarray(picture.image[:200, :260]), scene.board, "vertices")
    error, _ = errors_of(found, picture)
    assert len(error) == 6
    assert np.abs(error).max() < 0.05
    with pytest.raises(NoBoardError, match="of 5 points of the board can be measured"):
        detect_points(np.ascontiguousarray(picture.image[:200, :240]), scene.board, "vertices")


@pytest.mark.parametrize(
    ("form", "count"), [("charuco:3x4:40:30:DICT_4X4_50", (7, 6)), ("charuco:3x3:40:30:DICT_4X4_50", (4, 4))]
)
def test_all_points_of_a_small_board_are_enough(form: str, count: tuple[int, int]) -> None:
    picture = taken(marked_scene(plane_of(form), 2, square=50.0, tilt=20.0), 2, 4)
    for points, n in zip(("midpoints", "vertices"), count, strict=True):
        error, _ = errors_of(detect_points(picture.image, Board((plane_of(form),)), points), picture)
        assert len(error) == n
        assert np.abs(error).max() < 0.03


def test_another_dictionary_is_named() -> None:
    scene = marked_scene(plane_of(CHARUCO), 1)
    wrong = Board((plane_of("charuco:6x5:40:30:DICT_6X6_250"),))
    with pytest.raises(NoBoardError, match=r"markers of DICT_4X4_1000 instead of DICT_6X6_250"):
        detect_points(taken(scene, 1).image, wrong)


@pytest.mark.parametrize(
    ("form", "wrong", "place"),
    [
        (CHARUCO, "charuco:7x5:40:30:DICT_4X4_50", {}),
        # Half of the markers in view agree with a row less wide.
        (
            "charuco:8x4:40:28:DICT_5X5_50",
            "charuco:7x4:40:28:DICT_5X5_50",
            {"square": 52.0, "shift": (60.0, 40.0)},
        ),
    ],
)
def test_markers_that_contradict_the_columns_are_refused(
    form: str, wrong: str, place: dict[str, object]
) -> None:
    image = taken(marked_scene(plane_of(form), 1, **place), 1, 4).image  # type: ignore[arg-type]
    with pytest.raises(NoBoardError, match="as if it had another number of columns"):
        detect_points(image, Board((plane_of(wrong),)))


def test_vertices_of_a_steep_board_are_found_though_a_wide_window_reaches_its_ink() -> None:
    scene = marked_scene(plane_of("charuco:10x7:28:21:DICT_5X5_100"), 9804, 36.0, (640, 480), tilt=60.0)
    found = detect_points(taken(scene, 9804, 2).image, scene.board, "vertices")
    assert len(found.ids) >= 52  # 49 of 54


def test_edges_under_a_cover_without_any_contrast_are_left_out() -> None:
    scene = marked_scene(plane_of("charuco:8x6:28:21:DICT_4X4_250"), 3, 36.0, (400, 300))
    image = taken(scene, 3, 3).image.copy()
    image[149:205, 172:194], image[74:130, 185:207] = 90, 125  # no noise either, as where a face is covered
    found = detect_points(image, scene.board, "vertices")  # a warning of NumPy is an error here
    assert 25 <= len(found.ids) < 35


def test_tags_that_are_seen_with_the_square_at_a_corner_are_where_the_board_has_them() -> None:
    scene = marked_scene(plane_of("aprilgrid:4x3:40:0.2:tag16h5"), 0, tilt=60.0, psf=1.5)
    picture = taken(scene, 0, 3)
    error, _ = errors_of(detect_points(picture.image, scene.board, "vertices"), picture)
    assert len(error) >= 44
    assert np.abs(error).max() < 0.3  # the blur joins the edges on both sides of a gap


@pytest.mark.parametrize("turns", range(4))
def test_codes_too_small_to_be_read_singly_tell_the_place_of_all(turns: int) -> None:
    scene = marked_scene(
        plane_of("charuco:10x8:28:21:DICT_5X5_100", legacy=turns % 2 == 1), 2, 14.0, (240, 180)
    )
    picture = taken(scene, 2)
    image = np.ascontiguousarray(np.rot90(picture.image, turns))
    found = detect_points(image, scene.board, "vertices")
    places, _ = truth_of(picture)
    u, v = np.array([places[name] for name in found.ids]).T
    height, width = picture.image.shape
    true = ((u, v), (v, width - 1 - u), (width - 1 - u, height - 1 - v), (height - 1 - v, u))[turns]
    assert len(found.ids) >= 60
    assert np.abs(found.pixels - np.stack(true, axis=1)).max() < 0.04


@pytest.mark.parametrize("form", ["charuco:9x7:28:21:DICT_5X5_100", "charuco:11x7:28:21:DICT_5X5_100"])
def test_a_board_of_other_columns_is_refused_although_two_markers_agree(form: str) -> None:
    scene = marked_scene(plane_of("charuco:10x7:28:21:DICT_5X5_100"), 2, 14.0, (240, 180))
    with pytest.raises(NoBoardError, match="as if it had another number of columns"):
        detect_points(taken(scene, 2).image, Board((plane_of(form),)))


@pytest.mark.parametrize(
    ("form", "reason"),
    [
        ("arucogrid:4x3:30:0.25:DICT_6X6_50", "as if it had another number of columns"),
        ("arucogrid:6x3:30:0.25:DICT_6X6_50", "as if it had another number of columns"),
        ("arucogrid:5x3:30:0.4:DICT_6X6_50", "gap between two markers is about 0.2.*correct its spacing"),
        ("arucogrid:5x3:30:0.3:DICT_6X6_50", "two markers is about 0.2[56] of.*correct its spacing"),
    ],
)
def test_markers_that_stand_alone_otherwise_than_described_are_refused(form: str, reason: str) -> None:
    scene = marked_scene(plane_of("arucogrid:5x3:30:0.25:DICT_6X6_50"), 2, 40.0)
    with pytest.raises(NoBoardError, match=reason):
        detect_points(taken(scene, 2, 3).image, Board((plane_of(form),)))


def test_a_board_with_no_whole_marker_shows_no_code() -> None:
    grid = Grid(np.full((3, 3, 2), np.nan), 0)
    codes, lines = np.ones((1, 4, 4)), np.linspace(0.2, 0.8, 5)
    which, _, agree = agreement(
        grid, np.zeros((1, 2), dtype=np.int64), lines, codes, np.zeros((9, 9), np.float32)
    )
    assert len(which) == len(agree) == 0


def test_too_many_markers_for_a_dictionary_are_refused() -> None:
    board = Board((plane_of("charuco:12x10:40:30:DICT_4X4_50"),))
    with pytest.raises(InputError, match="markers up to 59, and DICT_4X4_50 up to 49"):
        detect_points(np.zeros((100, 100), np.uint8), board)


def test_the_few_edges_of_a_small_part_are_not_uneven_by_chance() -> None:
    """Their chi2 is beyond three standard deviations in one part of a hundred, by its skew distribution."""
    scene = marked_scene(
        plane_of("charuco:8x8:25.4:19.05:DICT_4X4_50"), 29059, 70.0, (320, 240), 40.0, 0.9, 3.0, -0.1,
        shift=(97.1, -113.6),
    )  # fmt: skip
    found = detect_points(taken(scene, 29059, 4).image, scene.board, "vertices")
    assert len(found.ids) == 12
    assert np.sqrt(found.covariance[:, [0, 2]]).mean() < 0.0045  # 0.006


def test_no_markers_are_no_board() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300)).astype(np.uint8)
    with pytest.raises(NoBoardError, match="no two markers"):
        detect_points(noise, Board((plane_of(CHARUCO),)))


@pytest.mark.parametrize(("points", "most"), [("vertices", 0.0045), ("midpoints", 0.01)])
def test_tags_are_measured_at_their_corners_and_edges(points: str, most: float) -> None:
    scene = marked_scene(plane_of(APRIL), 5, square=45)
    picture = taken(scene, 5, 4)
    found = detect_points(picture.image, scene.board, points)  # type: ignore[arg-type]
    error, squared = errors_of(found, picture)
    assert len(error) == 36 == len(set(found.ids))
    assert np.sqrt((error**2).mean()) < most
    assert 0.4 < squared.mean() < 2
    assert {name.split(":")[0] for name in found.ids} == {str(k) for k in range(9)}


def test_tags_half_in_a_soft_shadow_are_measured_where_the_light_does_not_change() -> None:
    """Polynomials through a shadow have slopes beside its border; there, the light of edges bends."""
    every = []
    for seed in (0, 1):
        scene = marked_scene(plane_of("aprilgrid:4x3:40:0.3"), seed, 44.0)
        truth = ground_truth(scene)
        shadow = half_in_shadow(0.4, 8.0)
        light = shadow(image_light(scene, 4), truth.planes[0].vertices, np.random.default_rng(seed))
        image = digitised(scene.sensor, light, np.random.default_rng([seed, 45]))
        found = detect_points(image, scene.board, "vertices")
        every.append(errors_of(found, Rendered(image, truth)))
    error, squared = (np.concatenate(part) for part in zip(*every, strict=True))
    assert np.sqrt((error**2).mean()) < 0.0115
    assert squared.mean() < 1.25


def test_a_marker_that_was_read_wrongly_is_left_out() -> None:
    plane = plane_of(CHARUCO)
    cells = marked_cells(plane, Print())
    H = np.array([[40.0, 6, 30], [-5, 35, 60], [1e-2, 2e-2, 1]])
    mapped = cells.corners @ H[:, :2].T + H[:, 2]
    corners = mapped[..., :2] / mapped[..., 2:]
    number = cells.number.copy()
    number[[3, 4]] = number[[4, 3]]
    placed = place(plane, Marks(number, corners, "DICT_4X4_50"))
    assert placed is not None
    assert set(placed.marks.number) == set(cells.number) - {3, 4}
    assert place(plane, Marks(number[:1], corners[:1], "DICT_4X4_50")) is None


def test_vertices_are_found_some_pixels_from_where_the_markers_say() -> None:
    """Markers of large images are read at a smaller scale."""
    plane = plane_of("charuco:4x3:40:30:DICT_4X4_50")
    picture = taken(marked_scene(plane, 3, square=60.0, tilt=0), 1, 3)
    (truth,) = picture.truth.planes
    cells = marked_cells(plane, Print())
    vertices = np.argwhere(np.isfinite(truth.vertices[..., 0]))[:, ::-1].astype(float)
    H = homographies(vertices[None], truth.vertices.reshape(1, -1, 2))
    corners = homography_at(H, cells.corners.reshape(1, -1, 2)).reshape(-1, 4, 2)
    placed = place(plane, Marks(cells.number, corners + np.array([4.0, -3.5]), "DICT_4X4_50"))
    assert placed is not None
    found = find_vertices(plane, placed, grey_levels(picture.image))
    assert found is not None
    assert np.abs(found[0].pixels - truth.vertices).max() < 0.3


def test_the_outline_inside_a_blurred_border_is_not_that_of_the_marker() -> None:
    scene = marked_scene(plane_of("arucogrid:3x2:40:0.25:DICT_4X4_50"), 6, square=56.0, psf=1.6)
    picture = taken(scene, 6)
    places, _ = truth_of(picture)
    every = candidates(next(looks_at(picture.image)))
    marks = markers_in(picture.image, every, "DICT_4X4_50", 1, 0, 6)
    assert sorted(marks.number) == list(range(6))
    for number, corners in zip(marks.number, marks.corners, strict=True):
        true = np.array([places[f"{number}:{k}"] for k in range(4)])
        assert np.linalg.norm(corners[:, None] - true, axis=2).min(axis=0).max() < 2.5


def test_small_markers_are_read_within_their_true_sides() -> None:
    """Cells of 3.5 px are blurred by half of one, so that outlines are 1.7 px too small."""
    read = []
    for seed in range(3):
        scene = marked_scene(
            plane_of("charuco:6x4:40:32:DICT_4X4_50"), seed, square=26.0, tilt=20.0, psf=1.76
        )
        codes = {
            (marks.dictionary, border): marks for marks, border in read_codes(taken(scene, seed).image)[0]
        }
        read += codes["DICT_4X4_1000", 1].number.tolist()
    assert max(read) < 12
    assert len(read) >= 27  # 20 of 36 within the outlines


def test_all_clear_codes_of_a_dictionary_are_read() -> None:
    """Also cells of one colour among others of it."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    corners = np.array([[[9.5, 9.5], [69.5, 9.5], [69.5, 69.5], [9.5, 69.5]]])
    for number in range(1000):
        code = cv2.aruco.generateImageMarker(family, number, 60)
        clear = cv2.copyMakeBorder(code, 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=255)
        assert numbers_in(clear, corners, "DICT_4X4_1000", 1).tolist() == [number]


def test_no_quadrangles_have_no_numbers() -> None:
    """A picture may have no whole tag."""
    light = np.zeros((40, 40), dtype=np.float32)
    assert len(numbers_in(light, np.zeros((0, 4, 2)), "DICT_APRILTAG_36h11", 2)) == 0


def test_markers_that_fit_both_patterns_tell_nothing() -> None:
    plane = plane_of("charuco:7x6:40:28:DICT_5X5_100")
    cells = marked_cells(plane, Print(legacy=True))
    # Without those at the ends of the rows, the board of today's pattern is the same one square aside.
    inner = (cells.cell[:, 0] > 0) & (cells.cell[:, 0] < 4)
    H = np.array([[40.0, 6, 30], [-5, 35, 60], [1e-2, 2e-2, 1]])
    mapped = cells.corners @ H[:, :2].T + H[:, 2]
    corners = mapped[..., :2] / mapped[..., 2:]
    part = place(plane, Marks(cells.number[inner], corners[inner], "DICT_5X5_100"))
    whole = place(plane, Marks(cells.number, corners, "DICT_5X5_100"))
    assert part is not None
    assert part.unsure
    assert whole is not None
    assert whole.how.legacy
    assert not whole.unsure


def test_the_light_of_a_pattern_is_that_of_the_blurred_pattern() -> None:
    rng = np.random.default_rng(0)
    n, fine, sigma = 4, 25, 1.3
    lines = np.linspace(0.1, 0.9, n + 1)
    cells = rng.choice([0.0, -2.0], (n, n))
    inverse = np.linalg.inv(np.array([[20.0, 6.0], [-5.0, 12.0]]))

    def sampled(a: Array, b: Array) -> Array:
        column, row = (np.floor((x - 0.1) / 0.8 * n).astype(int) for x in (a, b))
        inside = (column >= 0) & (column < n) & (row >= 0) & (row < n)
        return np.where(inside, cells[row.clip(0, n - 1), column.clip(0, n - 1)], 0.0)

    def places(u: Array, v: Array) -> tuple[Array, Array]:
        return inverse[0, 0] * u + inverse[0, 1] * v, inverse[1, 0] * u + inverse[1, 1] * v

    ticks = (np.arange(-20 * fine, 40 * fine) + 0.5) / fine - 0.5
    blurred = gaussian_filter(sampled(*places(*np.meshgrid(ticks, ticks))), sigma * fine)
    pixel = np.arange(-6, 26)
    at = np.rint((pixel + 20.5) * fine - 0.5).astype(int)
    a, b = places(*(x.ravel().astype(float) for x in np.meshgrid(pixel, pixel)))
    slopes = [np.full((1, len(a)), x) for x in inverse.ravel()]
    rho = inverse[0] @ inverse[1] / (np.linalg.norm(inverse[0]) * np.linalg.norm(inverse[1]))
    blur = _Blurred.of(tuple(slopes), np.array([[sigma, sigma, rho]]), 0.0, np.zeros(2))  # type: ignore[arg-type]
    light = blur.pattern(a[None], b[None], lines, cells[None])
    np.testing.assert_allclose(light[0], blurred[np.ix_(at, at)].ravel(), atol=0.01)


@pytest.mark.parametrize(("row", "width"), [(3, 55), (3, 45), (2, 55)])
def test_a_line_of_vertices_is_refused(row: int, width: int) -> None:
    scene = marked_scene(plane_of("charuco:6x5:40:30:DICT_4X4_50"), 3, square=32.0, tilt=0.0)
    picture = taken(scene, 3, 4)
    first, last = picture.truth.planes[0].vertices[row, [0, -1]]
    ends = [
        (end + beyond).astype(int).tolist() for end, beyond in ((first, first - last), (last, last - first))
    ]
    shown = cv2.line(np.zeros(picture.image.shape, np.uint8), ends[0], ends[1], (1,), width)
    with pytest.raises(NoBoardError):
        detect_points(np.where(shown > 0, picture.image, np.uint8(120)), scene.board)


def test_two_lines_of_vertices_are_measured() -> None:
    scene = marked_scene(plane_of("aprilgrid:4x3:40:0.3"), 59, square=34.0, tilt=40.0)
    picture = taken(scene, 59, 4)
    found = detect_points(np.ascontiguousarray(picture.image[63:161, 144:260]), scene.board)
    error, _ = errors_of(replace(found, pixels=found.pixels + np.array([144, 63])), picture)
    assert len(error) >= 8
    assert np.abs(error).max() < 0.3


def test_only_ink_beside_found_vertices_is_taken_off() -> None:
    cell = np.array([[-1, -1], [0, 0], [1, 1], [2, 2], [9, 9]])
    ink = Ink(cell, np.array([0.2, 0.8]), np.ones((5, 1, 1)), -np.ones(5))
    seen = np.zeros((4, 3), dtype=bool)
    seen[1, 1] = True
    assert ink.beside(seen).cell.tolist() == [[0, 0], [1, 1]]
    seen[0, 0] = True
    assert ink.beside(seen).cell.tolist() == [[-1, -1], [0, 0], [1, 1]]


@pytest.mark.slow
def test_a_fifth_of_a_large_board_before_a_bent_lens() -> None:
    """The map of the seen part takes far cells back into the image, where they have no ink."""
    plane = plane_of("charuco:14x10:30:22:DICT_4X4_100")
    scene = marked_scene(plane, 3, square=95, size=(640, 480), k1=-0.2, shift=(150.0, 90.0))
    picture = taken(scene, 3, 4)
    (truth,) = picture.truth.planes
    error, squared = errors_of(detect_points(picture.image, scene.board, "midpoints"), picture)
    assert len(error) >= 0.9 * truth.edges_visible.sum() > 30
    assert np.sqrt((error**2).mean()) < 0.006
    assert 0.4 < squared.mean() < 2


def test_only_borders_of_one_colour_are_borders() -> None:
    light = np.array([[-1.0] * 5] * 5)[None].repeat(2, axis=0)
    light[:, 2, 2] = 1
    lines = np.linspace(0.1, 0.9, 6)
    ink = Ink(np.zeros((2, 2), dtype=np.int64), lines, light, np.ones(2))
    assert ink.border == pytest.approx(2 * 0.16)
    assert ink.gap == pytest.approx(0.1)
    assert ink.filled.inner.shape == (2, 1, 1)
    light[1, 0, 3] = 1
    assert ink.border == 0
    # A tag is as dark as its border.
    assert Ink(ink.cell, lines, light, -np.ones(2)).gap == pytest.approx(0.1)
    assert Ink(ink.cell[:1], lines, light[:1], -np.ones(1)).gap == pytest.approx(0.1 + 2 * 0.16)


def tags_alone(plane: Plane) -> tuple[Array, Array, NDArray[np.bool_]]:
    """What is printed on a board of tags, without the squares at their corners."""
    assert isinstance(plane, TagPlane)
    x, y, dark = printed_rectangles(plane)
    places = (np.concatenate([one[:1] - 1, 0.5 * (one[1:] + one[:-1]), one[-1:] + 1]) for one in (x, y))
    across, down = (one % (1 + plane.spacing) > 1 for one in places)
    return x, y, dark & ~(down[:, None] & across)


@pytest.mark.parametrize("condition", slow_but(({},), ({}, {"psf": 1.6}, {"tilt": 60.0}, {"noise": 8.0})))
def test_tags_without_squares_have_the_mid_points_of_their_edges(
    condition: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neurocal_cli.simulation.rendering.scene.printed_rectangles", tags_alone)
    scene = marked_scene(plane_of("aprilgrid:3x2:40:0.25"), 6, square=56, **condition)
    picture = taken(scene, 6)
    found = detect_points(picture.image, scene.board)
    places, visible = truth_of(picture)
    assert set(found.ids) == {name for name in visible if ":e" in name}
    across = found.across
    assert across is not None
    assert np.hypot(*across.T) == pytest.approx(1, abs=1e-5)
    assert "no squares at the corners of the tags" in found.notes[0]
    error = ((found.pixels - np.array([places[name] for name in found.ids])) * across).sum(axis=1)
    squared = error**2 / variance_across(found.covariance, across)
    assert np.abs(error).max() < (0.05 if condition else 0.015)
    assert 0.5 < squared.mean() < 1.6
    with pytest.raises(NoBoardError, match="no squares at their corners"):
        detect_points(picture.image, scene.board, "vertices")
    (plane,) = scene.board.planes
    assert isinstance(plane, TagPlane)
    with pytest.raises(NoBoardError, match="the tags have a border of two cells; say border: 2"):
        detect_points(picture.image, Board((replace(plane, border=1),)))


@pytest.mark.parametrize(
    ("condition", "spacing"),
    [
        ({}, 0.25),
        # The codes are nearer to the edges than the next markers are.
        ({"square": 34}, 1.0),
        *(
            pytest.param(condition, spacing, marks=pytest.mark.slow)
            for condition in ({"psf": 1.6}, {"tilt": 60.0}, {"noise": 8.0})
            for spacing in (0.25, 0.6)
        ),
    ],
)
def test_markers_that_stand_alone_have_the_mid_points_of_their_edges(
    condition: dict[str, float], spacing: float
) -> None:
    plane = plane_of(f"arucogrid:3x2:40:{spacing}:DICT_4X4_50")
    scene = marked_scene(plane, 6, **{"square": 56 if spacing < 0.5 else 42, **condition})
    picture = taken(scene, 6)
    found = detect_points(picture.image, scene.board)
    assert not found.notes
    places, visible = truth_of(picture)
    assert set(found.ids) == {name for name in visible if ":e" in name}
    across = found.across
    assert across is not None
    error = ((found.pixels - np.array([places[name] for name in found.ids])) * across).sum(axis=1)
    squared = error**2 / variance_across(found.covariance, across)
    assert np.abs(error).max() < (0.05 if condition else 0.015)
    assert 0.5 < squared.mean() < 1.6


def test_markers_without_a_chessboard_around_them_are_named() -> None:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    image = cv2.aruco.GridBoard((6, 4), 30.0, 8.0, family).generateImage((1000, 750), marginSize=60)
    board = Board((plane_of("charuco:12x4:38:30:DICT_5X5_100"),))
    with pytest.raises(NoBoardError, match="markers of the board are read, but the squares of a chessboard"):
        detect_points(cv2.GaussianBlur(image, (0, 0), 0.7), board)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("condition", "most"),
    [
        ({}, 1.2),
        ({"noise": 8.0}, 1.2),
        ({"psf": 2.0}, 1.2),
        ({"tilt": 60.0}, 1.2),
        ({"k1": -0.3}, 1.2),
        ({"illumination": Illumination(0.6, (0.8, 0.5))}, 1.2),
    ],
)
def test_charuco_errors_over_the_bound(condition: dict[str, float], most: float) -> None:
    every, bounds, normal = [], [], []
    for seed in range(4):
        scene = marked_scene(plane_of("charuco:8x8:25.4:19.05:DICT_4X4_50"), seed, **{
            "square": 50.0, "size": (640, 480), **condition})  # type: ignore[arg-type]  # fmt: skip
        picture = taken(scene, seed, 8)
        error, squared = errors_of(detect_points(picture.image, scene.board, "vertices"), picture)
        assert len(error) == picture.truth.planes[0].vertices_visible.sum()
        every.append(error)
        normal.append(squared)
        bounds.append(vertex_bound(scene))
    rms = np.sqrt((np.concatenate(every) ** 2).mean())
    assert rms < most * np.sqrt(np.mean(np.square(bounds)))
    assert 0.8 < np.concatenate(normal).mean() < 1.3


@pytest.mark.slow
def test_squares_of_14_pixels_whose_ink_is_within_two_sigma_of_all_edges() -> None:
    every, bounds, visible = [], [], 0
    for seed in range(4):
        scene = marked_scene(
            plane_of("charuco:8x8:25.4:19.05:DICT_4X4_50"), seed, square=14.0, size=(640, 480)
        )
        picture = taken(scene, seed, 8)
        visible += int(picture.truth.planes[0].vertices_visible.sum())
        every.append(errors_of(detect_points(picture.image, scene.board, "vertices"), picture)[0])
        bounds.append(vertex_bound(scene))
    errors = np.concatenate(every)
    assert len(errors) >= 0.98 * visible
    assert np.sqrt((errors**2).mean()) < 1.6 * np.sqrt(np.mean(np.square(bounds)))


@pytest.mark.slow
def test_all_vertices_of_photographs_are_found(real_files: RealFiles) -> None:
    from neurocal_cli.files.images import read_image

    board = Board((plane_of("charuco:8x8:25.4:19.05"),))
    for name, least in (("new", 763), ("legacy", 630)):
        images = real_files(f"charuco_lifecam/{name}*.jpg")
        found = [detect_points(read_image(path).grey, board, "vertices") for path in images]
        assert sum(len(one.ids) for one in found) >= least


def before_fisheye(flat: Scene, nearer: float = 1.0) -> Scene:
    """A scene before a fisheye of 180 degrees."""
    focal, old = flat.size[0] / np.pi, flat.camera.intrinsics
    lens = Camera(
        Intrinsics(focal, 1.003 * focal, old.u0, old.v0), Distortion("fisheye", (0.0,) * 4), flat.size
    )
    near = replace(flat.pose, t=flat.pose.t * [1.0, 1.0, nearer * focal / old.alpha_u])
    return replace(flat, camera=lens, pose=near)


@pytest.mark.parametrize("seed", slow_but((9702,), (9702, 9707)))
def test_tags_that_are_not_read_before_a_fisheye_are_found_from_the_others(seed: int) -> None:
    """In the second, a saddle point far from all others is none of the board's."""
    flat = marked_scene(plane_of("aprilgrid:6x4:40:0.3"), seed, 67.6, (960, 720))
    picture = taken(before_fisheye(flat), seed, 2 if seed == 9702 else 3)
    error, _ = errors_of(detect_points(picture.image, flat.board, "vertices"), picture)
    assert len(error) == 96  # 74 and 82
    assert np.abs(error).max() < 0.05


def test_six_edges_of_two_tags_do_not_determine_a_map() -> None:
    """A corner of one is read 13 px off, which displaced its mid-points by up to 6 px."""
    light = Illumination(0.580638882712979, (-0.6818860952195618, 0.44167237990467145))
    flat = marked_scene(
        plane_of("aprilgrid:5x3:40:0.4:tag16h5"),
        20503,
        45.97157762929719,
        tilt=37.60850281647947,
        psf=1.0700773244878095,
        noise=3.972972639907888,
        shift=(5.695690030887974, -34.92137959242878),
        illumination=light,
    )
    picture = taken(before_fisheye(flat, 0.7), 20503, 2)
    pale = 128 + 0.6 * (picture.image - 128.0)
    sharpened = np.clip(np.rint(pale + 2 * (pale - gaussian_filter(pale, 1.0))), 0, 255).astype(np.uint8)
    with pytest.raises(NoBoardError, match="only 0 of 8 points"):
        detect_points(sharpened, Board((flat.targets[0].plane,)))


@pytest.mark.parametrize("form", ["charuco:5x4:40:30:DICT_4X4_50", "aprilgrid:3x2:40:0.3"])
def test_two_equal_boards_are_refused_unless_one_is_clearly_nearer(form: str) -> None:
    near, other, far = (
        taken(marked_scene(plane_of(form), seed, square=square), seed, 2).image
        for seed, square in ((1, 48.0), (2, 48.0), (2, 24.0))
    )
    board = short_board(form)
    assert board is not None
    with pytest.raises(NoBoardError, match="two boards with the same markers"):
        detect_points(np.concatenate([near, other], axis=1), board)
    found = detect_points(np.concatenate([far, near], axis=1), board)
    assert found.pixels[:, 0].min() > far.shape[1]


def test_mid_points_before_a_fisheye_with_few_parameters_are_measured() -> None:
    """The edges to the rim are compared with the lens that was found, which is none of the richer ones."""
    flat = marked_scene(plane_of("charuco:5x8:40:30:DICT_4X4_250"), 11, 22.0, psf=1.2)
    picture = taken(before_fisheye(flat, 0.7), 11, 2)
    error, _ = errors_of(detect_points(picture.image, flat.board), picture)
    assert len(error) >= 30  # of 67; other versions of OpenCV read other markers
    assert np.sqrt((error**2).mean()) < 0.1


def test_a_stray_far_beside_a_fisheyes_board_hides_no_other_stray() -> None:
    """A ray at 90 degrees and more from the board's middle does not meet that plane."""
    flattening = Flattening(WideLens(300.0, np.array([480.0, 360.0])), np.eye(3))
    ground = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    found = flattening.pixels(40.0 * (ground - [4.0, 2.5]))
    found[7], found[20] = (960.0, 360.0), found[20] + 9.0
    contrast = np.ones(len(ground))
    leave_out_strays(ground, found, contrast, flattening)
    assert np.flatnonzero(np.isnan(contrast)).tolist() == [7, 20]


_IDS = (
    *(
        f"charuco:{{}}x{{}}:40:{side}:DICT_{n}X{n}_{count}"
        for n in (4, 5, 6, 7)
        for side, count in ((30, 100), (26, 1000))
    ),
    "charuco:{}x{}:40:28:DICT_ARUCO_ORIGINAL",
    *(
        f"aprilgrid:{{}}x{{}}:40:{spacing}:{family}"
        for spacing in (0.2, 0.3)
        for family in ("tag36h11", "tag25h9")
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_a_vertex_has_its_own_id(seed: int) -> None:
    rng = np.random.default_rng([seed, 4412])
    form = _IDS[seed % len(_IDS)].format(*(4 + rng.integers(2, size=2)).tolist())
    plane = plane_of(form)
    assert plane.markers is not None
    first = int(rng.integers(2) * rng.integers(9))
    plane = replace(plane, markers=replace(plane.markers, first_id=first, legacy=False))
    shift = (float(rng.uniform(-80, 80)), float(rng.uniform(-60, 60)))
    square = float(rng.uniform(30, 50))
    scene = marked_scene(
        plane,
        seed,
        square,
        tilt=rng.uniform(0, 60),
        psf=rng.uniform(0.5, 1.2),
        k1=float(rng.choice([0.0, -0.2])),
        shift=shift,
    )
    picture = taken(scene, seed, 3)
    found = detect_points(picture.image, scene.board, "vertices")
    places, _ = truth_of(picture)
    off = np.hypot(*(found.pixels - np.array([places[name] for name in found.ids])).T)
    every = np.array(list(places.values()))
    apart = np.hypot(*(every[:, None] - every).transpose(2, 0, 1))
    assert off.max() < 0.5 * apart[apart > 0].min()


def test_a_board_that_is_drawn_in_whole_pixels_is_measured() -> None:
    """Its edges have no blur, as in the file that is printed."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    drawn = cv2.aruco.CharucoBoard((8, 6), 30.0, 22.0, words).generateImage((1280, 960), marginSize=60)
    found = detect_points(drawn, short_board("charuco:8x6:30:22:DICT_5X5_100"), "vertices")
    assert len(found.ids) == 35
    assert np.abs(found.pixels - (found.world[:, :2] / 30 * 140 + [219.5, 199.5])).max() < 0.1


def test_a_chessboard_that_is_drawn_and_warped_is_measured() -> None:
    """Its edges have steps of a pixel, which a blur smooths."""
    board = np.full((400, 520), 255, np.uint8)
    row, column = np.indices((280, 400)) // 40
    board[60:-60, 60:-60][(row + column) % 2 == 0] = 0
    corners = np.array([[0, 0], [520, 0], [520, 400], [0, 400]], np.float32)
    H = cv2.getPerspectiveTransform(
        corners, np.array([[40, 30], [460, 70], [500, 350], [70, 380]], np.float32)
    )
    found = detect_points(cv2.warpPerspective(board, H, (520, 400), borderValue=255), Board.single(9, 6, 40))
    assert (len(found.ids), found.rejected) == (93, 0)
    places = found.world[:, :2] + np.array([99.5, 99.5])  # of the drawing, or turned by half a turn
    both = cv2.perspectiveTransform(np.stack([places, [519, 399] - places]), H)
    assert np.abs(both - found.pixels).max(axis=(1, 2)).min() < 0.6

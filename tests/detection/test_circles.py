"""Grids of circles: found, placed, and measured at the images of their centres."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support import no_boards
from support.marked import errors_of, marked_scene, plane_of, ringed, taken
from support.occluders import Disc
from support.picture_bound import edge_bound
from support.pictures import Illumination, Rendered, Sensor, digitised, ground_truth, image_light
from support.slow_cases import slow_but
from support.uneven_light import Effect, beside_a_lamp, half_in_shadow, vignetted

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.circles.lattice import Blobs, lattices, place_circles
from neurocal_cli.detection.circles.measuring import _missed
from neurocal_cli.detection.circles.pattern import seen_circles
from neurocal_cli.detection.detect import Detection, detect_points
from neurocal_cli.detection.placement import NoBoardError
from neurocal_cli.errors import InputError
from neurocal_cli.files.board_kinds import short_board
from neurocal_cli.observations.board import Board
from neurocal_cli.observations.board_kinds import CirclePlane

ASYMMETRIC = "asymmetric_circles:4x7:20:16"
SYMMETRIC = "circles:5x4:20:12"


def turned(found: Detection, plane: CirclePlane) -> Detection:
    """The same points with the ids of the board after half a turn."""
    places = [[int(part) for part in name.split(":")] for name in found.ids]
    return replace(found, ids=tuple(f"{plane.cols - 1 - c}:{plane.rows - 1 - r}" for c, r in places))


def errors(found: Detection, picture: Rendered) -> tuple[Array, Array]:
    """Errors [px] and their squares over the covariance, whichever way a symmetric board is called."""
    plane = picture.truth.planes[0].plane
    assert isinstance(plane, CirclePlane)
    every = [errors_of(one, picture) for one in (found, turned(found, plane))]
    return min(every, key=lambda one: float(np.abs(one[0]).max(initial=np.inf)))


def circle_bound(noise: float, sigma: float, radius: float) -> float:
    """Bound on each coordinate of a circle's centre: half of its outline is across either axis."""
    return edge_bound(np.sqrt(noise**2 + 1 / 12), 196.0, sigma, np.pi * radius)


@pytest.mark.parametrize(("form", "tilt"), [(ASYMMETRIC, 30.0), (ASYMMETRIC, 60.0), (SYMMETRIC, 30.0)])
def test_centres_are_measured_to_the_bound_without_the_bias_of_ellipses(form: str, tilt: float) -> None:
    square = 22.0 if form == ASYMMETRIC else 40.0
    scene = marked_scene(plane_of(form), 1, square=square, tilt=tilt)
    picture = taken(scene, 1)
    found = detect_points(picture.image, scene.board)
    error, squared = errors(found, picture)
    plane = scene.targets[0].plane
    assert isinstance(plane, CirclePlane)
    assert len(error) == len(found.ids) == plane.cols * plane.rows
    radius = 0.5 * plane.diameter / plane.square * square * np.sqrt(np.cos(np.radians(tilt)))
    assert np.sqrt((error**2).mean()) < 1.4 * circle_bound(2.0, scene.sigma_t, radius)
    assert np.hypot(*error.mean(axis=0)) < 0.002
    assert 0.6 < squared.mean() < 1.5
    assert bool(found.warnings) == (form == SYMMETRIC)


@pytest.mark.parametrize(
    ("effect", "kept", "most"),
    # With polynomials alone: 0.86 kept with 0.017 px, 0.85 with 0.059, 0.84 with 0.073 and 0.033.
    [
        (vignetted(6.0), 0.97, 0.008),
        (half_in_shadow(0.4, 8.0), 0.8, 0.012),
        pytest.param(half_in_shadow(0.4, 40.0), 0.97, 0.012, marks=pytest.mark.slow),
        pytest.param(beside_a_lamp(8.0), 0.97, 0.022, marks=pytest.mark.slow),
    ],
)
def test_circles_are_measured_in_uneven_light(effect: Effect, kept: float, most: float) -> None:
    error, squared, count = [], [], 0
    for seed in range(2):
        scene = marked_scene(plane_of("circles:9x7:20:12"), seed, square=45.0, size=(640, 480))
        truth = ground_truth(scene)
        light = image_light(replace(scene, sensor=Sensor()), 4)
        rng = np.random.default_rng(seed)
        image = digitised(scene.sensor, effect(light, truth.planes[0].vertices, rng), rng)
        one, normalised = errors(detect_points(image, scene.board), Rendered(image, truth))
        error.append(one)
        squared.append(normalised)
        count += int(truth.planes[0].vertices_visible.sum())
    every = np.concatenate(error)
    assert len(every) >= kept * count
    assert np.sqrt((every**2).mean()) < most
    assert 0.5 < np.concatenate(squared).mean() < 1.6  # 7 to 32


def test_light_circles_on_dark_are_found_too() -> None:
    scene = marked_scene(plane_of(ASYMMETRIC), 2, square=22.0)
    picture = taken(scene, 2)
    found = detect_points(255 - picture.image, scene.board)
    error, _ = errors_of(found, picture)
    assert len(error) == 28
    assert np.abs(error).max() < 0.03


def test_circles_around_found_ones_are_measured_too() -> None:
    plane = plane_of(ASYMMETRIC)
    assert isinstance(plane, CirclePlane)
    every = plane.midpoint_grid().astype(np.int64)
    assert _missed(plane, every).tolist() == []
    assert _missed(plane, np.delete(every, [0, 13], axis=0)).tolist() == every[[0, 13]].tolist()
    assert _missed(plane, every[:8])[:, 1].max() == 2  # not far from these


def test_a_part_that_looks_the_same_after_a_turn_is_refused() -> None:
    plane = plane_of(ASYMMETRIC)
    assert isinstance(plane, CirclePlane)
    seen = plane.spread(plane.midpoint_grid()[plane.cols :]) * 30.0 + 50
    with pytest.raises(NoBoardError, match="which may be several parts of the board"):
        place_circles(plane, Blobs(seen, np.full(len(seen), 300.0)), np.zeros((480, 640), np.uint8))


def test_a_hidden_circle_is_left_out() -> None:
    scene = marked_scene(plane_of(ASYMMETRIC), 3, square=22.0)
    (u, v) = taken(scene, 3).truth.planes[0].vertices[3, 1]
    hidden = replace(scene, occluders=(Disc((u, v + 4.0), 7.0, 0.6),))
    picture = taken(hidden, 3)
    found = detect_points(picture.image, hidden.board)
    error, _ = errors_of(found, picture)
    assert "1:3" not in found.ids
    assert len(error) >= 26
    assert np.abs(error).max() < 0.03


def test_a_round_thing_beside_the_board_does_not_change_the_ids() -> None:
    plane = plane_of(ASYMMETRIC)
    assert isinstance(plane, CirclePlane)
    grid = plane.midpoint_grid()
    seen = plane.spread(grid[plane.cols :]) * 30.0 + 50
    # Nearly at a place of a further row.
    blobs = Blobs(np.concatenate([seen, [[86.0, 262.0]]]), np.full(len(seen) + 1, 300.0))
    with pytest.raises(NoBoardError, match="which may be several parts of the board"):
        place_circles(plane, blobs, np.zeros((480, 640), np.uint8))
    # Beside a whole board it is left out.
    whole = np.concatenate([plane.spread(grid) * 30.0 + 50, [[200.0, 262.0]]])
    placed = place_circles(plane, Blobs(whole, np.full(len(whole), 300.0)), np.zeros((480, 640), np.uint8))
    assert placed is not None
    assert len(placed.place) == plane.cols * plane.rows


@pytest.mark.parametrize(
    ("form", "kind", "seed"), [("circles:11x5:20", "discs", 303), ("circles:11x8:20", "pieces", 304)]
)
def test_marks_of_several_sizes_and_inks_are_no_circles(form: str, kind: str, seed: int) -> None:
    with pytest.raises(NoBoardError, match="no circles of one colour on blank paper"):
        detect_points(no_boards.picture(kind, seed), Board((plane_of(form),)))


@pytest.mark.parametrize(("width", "height", "gap"), [(14, 13, 0), (14, 10, 2), (8, 13, 2)])
def test_windows_are_no_circles(width: int, height: int, gap: int) -> None:
    image = np.full((300, 420), 190, np.uint8)
    for row in range(6):
        for column in range(7):
            left, top = 40 + 50 * column, 30 + 44 * row
            image[top : top + height + 1, left : left + width + 1] = 40
            image[top : top + height + 1, left + width // 2 : left + width // 2 + gap] = 190
    with pytest.raises(NoBoardError):
        detect_points(cv2.GaussianBlur(image, (0, 0), 1.3), Board((plane_of("circles:7x6:20:12"),)))


@pytest.mark.parametrize("hole", slow_but((0.7,), (0.3, 0.5, 0.7, 0.8)))
def test_rings_are_measured_at_the_outline_that_is_found(hole: float) -> None:
    scene = marked_scene(plane_of(ASYMMETRIC), 1, square=22.0, tilt=10.0)
    picture = ringed(scene, hole, 1)
    error, squared = errors_of(detect_points(picture.image, scene.board), picture)
    assert len(error) == 28
    assert np.sqrt((error**2).mean()) < 0.008
    assert 0.6 < squared.mean() < 1.6


@pytest.mark.parametrize(("radius", "width"), [(14, 4), (18, 4), (12, 5)])
def test_rings_are_round(radius: int, width: int) -> None:
    image = np.full((320, 420), 226, np.uint8)
    for row in range(6):
        for column in range(7):
            cv2.circle(image, (45 + 52 * column, 35 + 50 * row), radius, (30,), width, cv2.LINE_AA)
    found = detect_points(cv2.GaussianBlur(image, (0, 0), 0.8), Board((plane_of("circles:7x6:20:12"),)))
    assert len(found.ids) == 42
    at = np.array([[int(part) for part in name.split(":")] for name in found.ids])
    np.testing.assert_allclose(found.pixels, [45, 35] + at * [52, 50], atol=0.05)


@pytest.mark.parametrize(
    ("radius", "width", "blur", "seed"), [(12, 5, 1.2, 0), (12, 5, 1.2, 2), (8, 9, 0.7, 1)]
)
def test_rings_are_found_by_their_outer_edges(radius: int, width: int, blur: float, seed: int) -> None:
    ink = np.zeros((320, 420), np.uint8)
    for row in range(6):
        for column in range(7):
            cv2.circle(ink, (45 + 52 * column, 35 + 50 * row), radius, (255,), width, cv2.LINE_AA)
    light = (90 + 0.3 * np.arange(420)) * (1 - 0.75 * ink / 255)
    noise = 6 * np.random.default_rng(seed).normal(size=ink.shape)
    found = seen_circles(np.clip(cv2.GaussianBlur(light, (0, 0), blur) + noise, 0, 255).astype(np.uint8))
    assert found is not None
    assert (str(found), found.full) == ("7 x 6 circles", True)


def test_two_equal_grids_are_refused_unless_one_is_clearly_nearer() -> None:
    plane = plane_of(SYMMETRIC)
    near, other, far = (
        taken(marked_scene(plane, seed, square=square), seed, 2).image
        for seed, square in ((1, 40.0), (2, 40.0), (2, 22.0))
    )
    with pytest.raises(NoBoardError, match="two grids of 5 x 4 circles"):
        detect_points(np.concatenate([near, other], axis=1), Board((plane,)))
    assert (
        detect_points(np.concatenate([far, near], axis=1), Board((plane,))).pixels[:, 0].min() > far.shape[1]
    )


def test_another_number_of_circles_is_no_board() -> None:
    scene = marked_scene(plane_of(ASYMMETRIC), 2, square=22.0)
    image = taken(scene, 2).image
    for size in ("3x7", "5x9", "4x8"):
        with pytest.raises(NoBoardError, match=f"no part of a board of {size.replace('x', ' x ')} circles"):
            detect_points(image, Board((plane_of(f"asymmetric_circles:{size}:20:16"),)))


@pytest.mark.parametrize("form", [ASYMMETRIC, "circles:5x4:20:16"])
def test_a_part_of_the_board_is_known_by_the_paper_around_it(form: str) -> None:
    scene = marked_scene(plane_of(form), 3, square=22.0)
    picture = taken(scene, 3)
    middle = int(picture.truth.planes[0].vertices[..., 0].mean())
    covered, pale = picture.image.copy(), picture.image.copy()
    covered[:, middle:] = 128
    found = detect_points(covered, scene.board)
    error, _ = errors(found, Rendered(covered, picture.truth))
    assert len(error) == len(found.ids) > 7
    assert np.abs(error).max() < 0.03
    pale[:, middle:] = np.quantile(pale, 0.99)  # a sheet that looks like the paper of the board
    with pytest.raises(NoBoardError, match=r"several parts|no part"):
        detect_points(pale, scene.board)


def test_circles_cut_off_by_the_image_are_left_out() -> None:
    scene = marked_scene(
        plane_of("circles:8x6:30:18"), 7, square=70.0, tilt=60.0, size=(640, 480), shift=(100, -60)
    )
    picture = taken(scene, 7, 3)
    found = detect_points(picture.image, scene.board)
    _, squared = errors(found, picture)
    assert len(squared) >= 36
    assert squared.max() < 16
    assert (found.pixels >= 0).all()  # three cut ones lie outside
    assert (found.pixels <= np.array(scene.camera.image_size) - 1).all()


def test_circles_that_are_partly_hidden_make_the_others_no_less_certain() -> None:
    scene = marked_scene(plane_of("asymmetric_circles:4x11:20:16"), 9, square=14.0, noise=1.0)
    picture = taken(scene, 9)
    image = picture.image.copy()
    image[:, int(picture.truth.planes[0].vertices[..., 0].mean()) :] = 128
    whole, part = (detect_points(one, scene.board) for one in (picture.image, image))
    assert len(part.ids) >= 18
    assert np.median(part.covariance[:, 0]) < 1.15 * np.median(whole.covariance[:, 0])


def test_circles_of_a_board_have_a_file_of_their_own() -> None:
    planes = (replace(plane_of(SYMMETRIC), name="a"), replace(plane_of(ASYMMETRIC), name="b"))
    with pytest.raises(InputError, match="one plane"):
        detect_points(np.zeros((100, 100), np.uint8), Board(planes))


def test_strong_perspective_does_not_change_which_circle_is_which() -> None:
    plane = CirclePlane("", 4, 11, 20.0, diameter=12.0, asymmetric=True)
    ids, world = plane.midpoints()
    H = np.array([[3.0, 2.0, 300], [-1.0, 1.2, 200], [2e-3, -1e-3, 1]])
    mapped = np.column_stack([world[:, :2], np.ones(len(world))]) @ H.T
    centre = mapped[:, :2] / mapped[:, 2:]
    blobs = Blobs(centre, 2e4 / mapped[:, 2] ** 3)
    placed = place_circles(plane, blobs, np.zeros((480, 640), np.uint8))
    assert placed is not None
    names = {f"{c}:{r}": one for (c, r), one in zip(placed.place.tolist(), placed.centre, strict=True)}
    assert len(names) == 44
    for name, one in zip(ids, centre, strict=True):
        np.testing.assert_array_equal(names[name], one)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "square"), [("asymmetric_circles:4x11:20:16", 28.0), ("circles:7x6:20:12", 52.0)]
)
@pytest.mark.parametrize(
    "condition",
    [
        {},
        {"noise": 8.0},
        {"psf": 2.0},
        {"tilt": 60.0},
        {"k1": -0.3},
        {"illumination": Illumination(0.6, (0.8, 0.5))},
    ],
)
def test_errors_over_the_bound(form: str, square: float, condition: dict[str, float]) -> None:
    plane = plane_of(form)
    assert isinstance(plane, CirclePlane)
    every, normal, bounds = [], [], []
    for seed in range(4):
        scene = marked_scene(plane, seed, square=square, size=(640, 480), **condition)  # type: ignore[arg-type]
        picture = taken(scene, seed, 8)
        error, squared = errors(detect_points(picture.image, scene.board), picture)
        assert len(error) == picture.truth.planes[0].vertices_visible.sum()
        every.append(error)
        normal.append(squared)
        tilt = np.radians(condition.get("tilt", 30.0))
        radius = 0.5 * plane.diameter / plane.square * square * np.sqrt(np.cos(tilt))
        bounds.append(circle_bound(scene.sensor.read_noise, scene.sigma_t, radius))
    light = 0.6 if "illumination" in condition else 1.0
    rms = np.sqrt((np.concatenate(every) ** 2).mean())
    assert rms < 1.25 / light * np.mean(bounds)
    assert 0.8 < np.concatenate(normal).mean() < 1.3


def test_thousands_of_marks_do_not_fill_the_memory() -> None:
    """Pictures of grass and skin have as many; a table of their distances would take 256 MB."""
    rng = np.random.default_rng(4)
    blobs = Blobs(rng.uniform(0, 4000, (4000, 2)), rng.uniform(20, 60, 4000))
    tracemalloc.start()
    try:
        lattices(blobs, 3000)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize("radius", [8, 14, 30])
def test_described_circles_may_be_drawn_in_whole_pixels(radius: int) -> None:
    drawn = np.full((960, 1280), 255, np.uint8)
    places = 3 * radius * np.array([(x, y) for y in range(7) for x in range(6)]) + 150
    for place in places:
        cv2.circle(drawn, place.tolist(), radius, 0, -1)
    found = detect_points(drawn, short_board(f"circles:6x7:{3 * radius}:{2 * radius}"))
    assert len(found.ids) == 42
    away = np.abs(found.pixels[:, None] - places).max(axis=2)
    assert away.min(axis=1).max() < 0.1

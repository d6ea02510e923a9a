"""Rendered pictures: the truth that goes with them, the sensor, and the bound."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.clutter import KINDS, Clutter
from support.occluders import Disc, Rectangle
from support.picture_bound import edge_bound, noise_free, scene_bound, vertex_bound
from support.pictures import (
    Illumination,
    Scene,
    Sensor,
    Sides,
    Target,
    digitised,
    ground_truth,
    image_light,
    render,
)
from support.rendered import CONDITIONS, RECIPES, condition, picture
from support.slow_cases import slow_but

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.monotonic import monotonic_radius
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.observations.board import Board, Plane
from neurocal_cli.simulation.rendering.layers import half_plane
from neurocal_cli.simulation.rendering.render import Blur
from neurocal_cli.simulation.rendering.scene import Background

SMALL = Camera(Intrinsics(250.0, 252.0, 81.0, 58.0), image_size=(160, 120))
PLANE = Plane("", 5, 4, 10.0)
AWAY = Pose.from_euler(0.3, -0.25, 0.2, np.array([-18.0, -14.0, 200.0]))
SCENE = Scene(SMALL, AWAY, (Target(PLANE),))
QUICK = ("16 bit", "squares 6", "mix", "clutter only", "stress 2")  # and what others find points in


# The lens


@pytest.mark.parametrize(
    "distortion",
    [(), (-0.3, 0.1, 0.002, -0.003, 0.01), (0.2,), (-0.4, 0.13, 0.0, 0.0, -0.01), (0.1, -0.2, 0.01, 0.01)],
)
def test_the_truth_is_where_opencv_projects_the_points(distortion: tuple[float, ...]) -> None:
    scene = replace(SCENE, camera=replace(SMALL, distortion=Distortion("plumb_bob", distortion)))
    truth = ground_truth(scene).planes[0]
    rotation = cv2.Rodrigues(AWAY.R)[0]
    for world, pixels in (
        (PLANE.vertices().reshape(-1, 3), truth.vertices.reshape(-1, 2)),
        (PLANE.midpoints()[1], truth.midpoints),
    ):
        coefficients = scene.camera.distortion.coefficients
        theirs = cv2.projectPoints(world, rotation, AWAY.t, SMALL.intrinsics.A, coefficients)[0]
        np.testing.assert_allclose(pixels, theirs.reshape(-1, 2), atol=1e-9)


def test_skew_acts_after_distortion() -> None:
    intrinsics = replace(SMALL.intrinsics, theta=1.45)
    skewed = replace(SMALL, intrinsics=intrinsics, distortion=Distortion("plumb_bob", [-0.3, 0.05]))
    truth = ground_truth(replace(SCENE, camera=skewed)).planes[0]
    world = PLANE.vertices().reshape(-1, 3)
    coefficients = skewed.distortion.coefficients
    normal = cv2.projectPoints(world, cv2.Rodrigues(AWAY.R)[0], AWAY.t, np.eye(3), coefficients)[0]
    A = skewed.intrinsics.A
    expected = normal.reshape(-1, 2) @ A[:2, :2].T + A[:2, 2]
    np.testing.assert_allclose(truth.vertices.reshape(-1, 2), expected, atol=1e-9)
    assert A[0, 1] != 0


@given(
    st.floats(-0.45, 0.3),
    st.floats(-0.1, 0.2),
    st.floats(-0.01, 0.01),
    st.floats(-0.01, 0.01),
    st.floats(-1, 1),
)
@settings(max_examples=25)
def test_a_ray_goes_to_its_pixel_and_back(k1: float, k2: float, p1: float, p2: float, tilt: float) -> None:
    intrinsics = Intrinsics(250.0, 252.0, 81.0, 58.0, np.pi / 2 + 0.1 * tilt)
    distortion = Distortion("k1k2p1p2", [k1, k2, p1, p2])
    camera, radius = (
        replace(SMALL, intrinsics=intrinsics, distortion=distortion),
        monotonic_radius(distortion),
    )
    v, u = np.mgrid[0:120:7, 0:160:7].reshape(2, -1).astype(float)
    rays = camera.rays(u, v)
    known = np.isfinite(rays.x)
    assert known.sum() > 0.9 * known.size
    points = np.column_stack([rays.x, rays.y, np.ones_like(u)])[known]
    pixels, seen = camera.project(points)[0], camera.sees(points)
    inside = np.hypot(*points[:, :2].T) < 0.95 * radius
    assert seen[inside].all()
    np.testing.assert_allclose(pixels, np.column_stack([u, v])[known], atol=1e-6)
    step = 1e-4
    inner = np.hypot(rays.x, rays.y) < 0.9 * radius
    for ahead, by in (
        (camera.rays(u + step, v, (rays.x, rays.y)), (rays.xu, rays.yu)),
        (camera.rays(u, v + step, (rays.x, rays.y)), (rays.xv, rays.yv)),
    ):
        np.testing.assert_allclose((ahead.x - rays.x)[inner] / step, by[0][inner], rtol=0.01, atol=1e-5)
        np.testing.assert_allclose((ahead.y - rays.y)[inner] / step, by[1][inner], rtol=0.01, atol=1e-5)


def test_what_a_lens_cannot_see_is_background_and_not_in_the_truth() -> None:
    fisheye = replace(
        SMALL, intrinsics=Intrinsics(60.0, 60.0, 80.0, 60.0), distortion=Distortion("k1", [-0.4])
    )
    wide = Scene(fisheye, Pose(np.eye(3), np.array([-20.0, -15.0, 8.0])), (Target(PLANE),), Background(0.5))
    truth = ground_truth(wide).planes[0]
    assert np.isnan(truth.vertices[0, 0]).all()
    assert not truth.vertices_visible[0, 0]
    assert np.isfinite(truth.vertices[1, 2]).all()
    assert image_light(wide)[0, 0] == pytest.approx(0.5, abs=1e-6)


# Coverage and blur


@given(st.floats(-1.2, 1.2), st.floats(0, 2 * np.pi))
@settings(max_examples=30)
def test_the_area_of_a_cell_on_one_side_of_an_edge_is_exact(distance: float, angle: float) -> None:
    n = np.cos(angle), np.sin(angle)
    share, touched = half_plane(np.array([distance]), np.array([n[0]]), np.array([n[1]]), 1.0)
    x = (np.arange(500) + 0.5) / 500 - 0.5
    counted = float((n[0] * x[:, None] + n[1] * x + distance > 0).mean())
    assert share[0] == pytest.approx(counted, abs=3e-3)
    assert touched[0] or share[0] in (0, 1)


@pytest.mark.parametrize("sigma", [0.0, 0.3, 0.8, 3.0])
def test_kernels_hand_on_all_light_and_have_the_variance_of_blur_and_box(sigma: float) -> None:
    blur = Blur(sigma, 8)
    offsets = np.arange(-blur.radius, blur.radius + 1)
    assert blur.whole.sum() == pytest.approx(1, abs=1e-7)
    assert blur.cell.sum() == pytest.approx(1, abs=1e-7)
    # Twice the pixel's box: that which sends and that which receives.
    if sigma > 0.5:  # wide enough for its samples to have its variance
        assert (blur.whole * offsets**2).sum() == pytest.approx(sigma**2 + 2 / 12, abs=1e-6)
    assert blur.slope.sum() == pytest.approx(0, abs=1e-9)
    assert (blur.slope * offsets).sum() == pytest.approx(0 if sigma == 0 else -1 / 12, abs=0.02)


# The truth


def test_truth_names_every_point() -> None:
    for plane, truth in zip(
        condition("two planes", 0).board.planes, ground_truth(condition("two planes", 0)).planes, strict=True
    ):
        assert truth.midpoint_ids == plane.midpoints()[0]
        assert truth.vertex_ids == plane.vertex_ids()
        assert truth.vertices.shape == (plane.rows, plane.cols, 2)


@pytest.mark.parametrize("first_black", slow_but((False,), [True, False]))
def test_polarity_tells_on_which_side_of_an_edge_it_is_white(first_black: bool) -> None:
    scene = replace(SCENE, targets=(Target(PLANE, first_black=first_black),), psf=0.3)
    picture, truth = noise_free(scene), ground_truth(scene).planes[0]
    for at, normal, polarity in zip(truth.midpoints, truth.normals, truth.polarity, strict=True):
        (u, v), (x, y) = np.rint(at + 3 * normal).astype(int), np.rint(at - 3 * normal).astype(int)
        assert np.sign(picture[v, u] - picture[y, x]) == polarity


def test_an_edge_knows_its_ends_its_length_and_its_normal() -> None:
    truth = ground_truth(SCENE).planes[0]
    vertices = truth.vertices.reshape(-1, 2)
    for k, name in enumerate(truth.midpoint_ids):
        kind, c, r = name[0], *map(int, name.split(":")[1:])
        first = truth.vertices[r, c]
        second = truth.vertices[r, c + 1] if kind == "h" else truth.vertices[r + 1, c]
        np.testing.assert_array_equal(vertices[truth.ends[k]], [first, second])
        assert truth.lengths[k] == pytest.approx(np.linalg.norm(second - first))
        assert abs(truth.normals[k] @ (second - first)) < 1e-6
        side = (
            truth.vertices[1, 0] - truth.vertices[0, 0]
            if kind == "h"
            else (truth.vertices[0, 1] - truth.vertices[0, 0])
        )
        assert truth.normals[k] @ side > 0


def test_points_under_an_occluder_are_not_visible_and_others_are() -> None:
    free = ground_truth(SCENE).planes[0]
    assert free.vertices_visible.all()
    assert free.edges_visible.all()
    at = free.vertices[1, 2]
    for occluder in (Disc(tuple(at), 4.0), Rectangle(tuple(at), (3.0, 9.0), 0.5)):
        hidden = ground_truth(replace(SCENE, occluders=(occluder,))).planes[0]
        assert not hidden.vertices_visible[1, 2]
        assert hidden.vertices_visible.sum() == free.vertices_visible.sum() - 1
        touching = {k for k, ends in enumerate(hidden.ends) if PLANE.cols + 2 in ends}
        assert set(np.flatnonzero(~hidden.edges_visible)) == touching
        assert len(touching) == 4


def test_an_occluder_over_a_quarter_of_an_edge_hides_the_edge_alone() -> None:
    free = ground_truth(SCENE, clearance=1.0).planes[0]
    first, second = free.vertices.reshape(-1, 2)[free.ends[6]]
    spot = Disc(tuple(0.75 * first + 0.25 * second), 1.0)
    hidden = ground_truth(replace(SCENE, occluders=(spot,)), clearance=1.0).planes[0]
    assert hidden.vertices_visible.all()
    assert hidden.midpoints_visible.all()
    assert np.flatnonzero(~hidden.edges_visible).tolist() == [6]


def test_points_near_the_frame_or_beyond_it_are_not_visible() -> None:
    at = ground_truth(SCENE).planes[0].vertices[0, 0]
    for clearance, margin in ((2.0, 2.1), (2.0, 1.9), (5.0, 4.9)):
        i = SMALL.intrinsics
        moved = replace(SMALL, intrinsics=replace(i, u0=i.u0 - at[0] + margin))
        truth = ground_truth(replace(SCENE, camera=moved), clearance).planes[0]
        assert truth.vertices[0, 0, 0] == pytest.approx(margin)
        assert truth.vertices_visible[0, 0] == (margin > clearance)


def test_a_plane_behind_another_is_hidden_where_it_is_covered() -> None:
    truth = ground_truth(condition("two boards", 0))
    back, front = truth.planes
    assert front.vertices_visible.all()
    assert 0 < (~back.vertices_visible).sum() < back.vertices_visible.size / 2


@pytest.mark.slow
def test_the_nearer_plane_is_seen_whatever_the_order_of_the_targets() -> None:
    scene = condition("two boards", 1)
    turned = replace(scene, targets=scene.targets[::-1])
    np.testing.assert_allclose(noise_free(scene), noise_free(turned), atol=1e-6)


def test_a_board_behind_the_camera_is_not_seen() -> None:
    behind = replace(SCENE, pose=Pose(np.eye(3), np.array([-20.0, -15.0, -100.0])))
    truth = ground_truth(behind).planes[0]
    assert np.isnan(truth.vertices).all()
    assert not truth.vertices_visible.any()
    assert np.ptp(image_light(behind)) == 0


def test_a_board_that_reaches_behind_the_camera_is_drawn_up_to_its_visible_part() -> None:
    long = Plane("", 60, 5, 10.0, (-300.0, -20.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    scene = replace(SCENE, targets=(Target(long),), pose=Pose(np.eye(3), np.array([320.0, 0.0, 20.0])))
    truth = ground_truth(scene).planes[0]
    assert 0 < truth.vertices_visible.sum() < truth.vertices_visible.size
    assert np.isfinite(image_light(scene)).all()


def test_a_camera_in_the_boards_plane_is_refused() -> None:
    edge_on = replace(SCENE, pose=Pose.from_euler(np.pi / 2, 0, 0, np.array([0.0, 0.0, 100.0])))
    with pytest.raises(DegenerateGeometryError, match="lies in the plane"):
        render(edge_on, np.random.default_rng(0))


# The sensor


def test_the_same_generator_gives_the_same_picture_and_another_only_other_noise() -> None:
    first, again = (render(SCENE, np.random.default_rng(5)).image for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = render(SCENE, np.random.default_rng(6)).image
    difference = first.astype(float) - other
    assert difference.std() == pytest.approx(np.sqrt(2 * (4 + 1 / 12)), rel=0.03)
    assert abs(difference.mean()) < 0.1


@pytest.mark.parametrize(("bits", "white"), [(8, 255), (16, 65535)])
def test_noise_is_given_in_steps_of_eight_bits_whatever_the_bits(bits: Any, white: int) -> None:
    scene = replace(SCENE, targets=(), sensor=Sensor(read_noise=3.0, bits=bits))
    image = render(scene, np.random.default_rng(0)).image
    assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert image.std() * 255 / white == pytest.approx(3.0, rel=0.03)
    assert image.mean() / white == pytest.approx(0.45, abs=1e-3)


def test_shot_noise_grows_with_the_root_of_the_light() -> None:
    for level in (0.1, 0.8):
        scene = replace(
            SCENE, targets=(), background=Background(level), sensor=Sensor(read_noise=0.0, full_well=2000.0)
        )
        image = render(scene, np.random.default_rng(0)).image
        expected = np.sqrt(level / 2000 * 255**2 + 1 / 12)
        assert image.std() == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("response", [2.2, "srgb"])
def test_the_response_curve_is_inverted_by_its_formula(response: Any) -> None:
    plain, curved = (noise_free(replace(SCENE, sensor=Sensor(response=r))) / 255 for r in (1.0, response))
    if response == "srgb":
        back = np.where(curved <= 0.04045, curved / 12.92, ((curved + 0.055) / 1.055) ** 2.4)
    else:
        back = curved**2.2
    np.testing.assert_allclose(back, plain, atol=1e-12)


def test_light_beyond_full_scale_is_clipped() -> None:
    scene = replace(SCENE, sensor=Sensor(gain=1.5, offset=-0.2, read_noise=0.0))
    image = render(scene, np.random.default_rng(0)).image
    assert image.max() == 255
    assert image.min() == 0


# The bound


@pytest.mark.slow
def test_the_bound_agrees_with_its_closed_form() -> None:
    scene = condition("tilt 0", 0)
    noise, contrast = np.sqrt(4 + 1 / 12), 196.0
    truth, bound = ground_truth(scene).planes[0], scene_bound(scene)[0]
    length = float(truth.lengths.mean())
    # An edge loses near either end half of what a vertex loses to the lines that cross.
    edge = edge_bound(noise, contrast, scene.sigma_t, length - 2.26 * scene.sigma_t)
    np.testing.assert_allclose(bound.edge, edge, rtol=0.02)
    vertex = vertex_bound(noise, contrast, scene.sigma_t, length)
    np.testing.assert_allclose(bound.vertex, vertex, rtol=0.02)
    np.testing.assert_allclose(bound.vertex**2, 0.5 * np.trace(bound.vertex_covariance, axis1=-2, axis2=-1))


def test_the_bound_of_the_base_condition_is_three_thousandths_of_a_pixel() -> None:
    assert edge_bound(2.02, 196, 0.85, 36) == pytest.approx(0.0030, abs=5e-5)


def test_least_squares_with_all_else_known_reaches_the_bound() -> None:
    """Moves of whole boards are estimated from noisy pictures; their information adds up over edges."""
    clean = noise_free(SCENE)
    step = 0.02
    i = SMALL.intrinsics
    J = np.stack(
        [
            (noise_free(replace(SCENE, camera=replace(SMALL, intrinsics=moved))) - clean).ravel() / step
            for moved in (replace(i, u0=i.u0 + step), replace(i, v0=i.v0 + step))
        ],
        axis=-1,
    )
    truth = ground_truth(SCENE).planes[0]
    window = np.zeros(clean.shape, dtype=bool)
    (u0, v0), (u1, v1) = truth.vertices[1, 1], truth.vertices[2, 3]
    window[int(v0) : int(v1), int(u0) : int(u1)] = True
    J = J[window.ravel()]
    estimates = []
    rng, light = np.random.default_rng(0), image_light(SCENE)
    for _ in range(300):
        image = digitised(SCENE.sensor, light, rng)
        estimates.append(np.linalg.lstsq(J, (image - clean)[window], rcond=None)[0])
    expected = (4 + 1 / 12) * np.linalg.inv(J.T @ J)
    ratio = np.linalg.solve(expected, np.cov(np.array(estimates).T))
    np.testing.assert_allclose(ratio, np.eye(2), atol=0.25)
    assert np.abs(np.mean(estimates, axis=0)).max() < 4 * np.sqrt(expected.max() / 300)


@pytest.mark.slow
def test_the_bound_grows_with_noise_and_is_infinite_where_nothing_is_seen() -> None:
    quiet, loud = (scene_bound(replace(SCENE, sensor=Sensor(read_noise=noise)))[0] for noise in (1.0, 4.0))
    np.testing.assert_allclose(loud.edge / quiet.edge, np.sqrt((16 + 1 / 12) / (1 + 1 / 12)), rtol=1e-6)
    hidden = replace(SCENE, occluders=(Rectangle((80.0, 60.0), (400.0, 400.0)),))
    assert np.isinf(scene_bound(hidden)[0].vertex).all()
    assert np.isinf(scene_bound(hidden)[0].edge).all()


# Scenes


@pytest.mark.parametrize("name", slow_but(CONDITIONS[::4], CONDITIONS))
def test_a_condition_shows_what_it_should(name: str) -> None:
    scene = condition(name, 0)
    truth = ground_truth(scene)
    visible = [float(plane.vertices_visible.mean()) for plane in truth.planes]
    if name == "board cut":
        assert 0.5 <= visible[0] <= 0.9
    elif name in ("occluded", "two boards"):
        assert 0.6 < visible[0] < 1
    else:
        assert visible == [1.0] * len(scene.targets)
        assert all(plane.edges_visible.all() for plane in truth.planes)
    assert (len(visible) == 0) == name.startswith("clutter only")


@pytest.mark.parametrize("name", slow_but(QUICK[::3], CONDITIONS))
def test_a_condition_can_be_rendered(name: str) -> None:
    scene = condition(name, 1)
    shown = picture(name, 1)
    assert shown.image.shape == scene.size[::-1]
    assert shown.image.dtype == (np.uint16 if name == "16 bit" else np.uint8)
    assert 20 < 255 * shown.image.mean() / scene.sensor.white_dn < 235


@pytest.mark.parametrize("name", slow_but(("base", "two planes distorted", "clutter only 5 Mpx"), CONDITIONS))
def test_the_images_of_a_condition_are_all_different_and_always_the_same(name: str) -> None:
    scenes = [condition(name, seed) for seed in range(4)]
    again = [condition(name, seed) for seed in range(4)]
    for one, other in zip(scenes, again, strict=True):
        assert one.targets == other.targets
        np.testing.assert_array_equal(one.pose.t, other.pose.t)
    assert len({tuple(scene.pose.t) for scene in scenes}) == 4


def test_conditions_with_room_for_it_show_the_same_poses_as_the_base() -> None:
    alike = [n for n in RECIPES if n.startswith(("noise", "psf", "gamma", "low"))]
    for name in alike:
        np.testing.assert_array_equal(condition(name, 3).pose.t, condition("base", 3).pose.t)


def test_a_scene_tells_which_board_it_shows() -> None:
    assert condition("base", 0).board == Board.single(9, 6, 28.0)
    assert [p.name for p in condition("three planes", 0).board.planes] == ["floor", "wall", "side"]


def test_a_background_is_the_same_inside_whatever_the_blur() -> None:
    clutter = Clutter(kinds=KINDS, amount=40, seed=4)
    sharp, dull = (image_light(replace(SCENE, background=clutter, psf=psf)) for psf in (0.0, 1.5))
    expected = cv2.GaussianBlur(sharp, (0, 0), 1.5, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(dull[12:-12, 12:-12], expected[12:-12, 12:-12], atol=0.02)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(SCENE, camera=Camera(SMALL.intrinsics)), "size"),
        (lambda: Target(PLANE, margin=Sides.all(-1.0)), "margin"),
        (lambda: Illumination(gradient=(1.5, 0.6)), "positive"),
        (lambda: Sensor(bits=12), "bits"),  # type: ignore[arg-type]
        (lambda: Sensor(response=0.0), "response"),
        (lambda: Sensor(read_noise=-1.0), "noise"),
        (lambda: replace(SCENE, psf=-1.0), "psf"),
    ],
)
def test_a_scene_that_cannot_be_is_refused(make: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_rendering_needs_neither_opencv_nor_scipy() -> None:
    code = (
        "import sys, neurocal_cli.simulation.rendering.render\n"
        "sys.exit(bool({'cv2', 'scipy'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

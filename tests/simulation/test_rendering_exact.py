"""Rendered pictures against models that share no code with the renderer."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr
from support.picture_bound import noise_free
from support.pictures import Illumination, Scene, Sensor, Sides, Target, ground_truth, image_light
from support.rendered import board_pose, condition
from support.slow_cases import slow_but

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.observations.board import Plane
from neurocal_cli.simulation.rendering.scene import Background

PLANE = Plane("", 5, 4, 10.0)
EXACT = Sensor(read_noise=0.0, bits=16)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(5)


def facing(square: float, roll: float, middle: tuple[float, float], psf: float, **changes: object) -> Scene:
    """A board parallel to the image, its squares with a side in px."""
    camera = Camera(Intrinsics(500.0, 500.0, 81.3, 58.9), image_size=(160, 120))
    scene = Scene(camera, Pose(np.eye(3), np.ones(3)), (Target(PLANE),), psf=psf, sensor=EXACT)
    scene = replace(scene, **changes)  # type: ignore[arg-type]
    return replace(scene, pose=board_pose(scene, np.array(middle), square, 0.0, 0.0, roll))


def erf_model(scene: Scene, square: float, roll: float, middle: tuple[float, float]) -> Array:
    """The picture of `facing` in [0, 1]: products of error functions along the board's axes.

    The Gaussian is round, so it separates along the board's axes as well; the pixel's box is
    integrated by Gauss and Legendre's rule.
    """
    target, s = scene.targets[0], scene.psf / square
    width, height = scene.size
    t = 0.5 * NODES
    u = np.arange(width)[:, None] + t - middle[0]
    v = (np.arange(height)[:, None] + t - middle[1])[:, :, None, None]
    c, si = np.cos(roll) / square, np.sin(roll) / square
    a = c * u + si * v + 0.5 * (PLANE.cols - 1)
    b = -si * u + c * v + 0.5 * (PLANE.rows - 1)

    def band(x: Array, low: float, high: float) -> Array:
        return np.asarray(ndtr((x - low) / s) - ndtr((x - high) / s))

    signs = [
        sum((-1) ** k * band(x, k, k + 1) for k in range(-1, n))
        for x, n in ((a, PLANE.cols), (b, PLANE.rows))
    ]
    inside = band(a, -1, PLANE.cols) * band(b, -1, PLANE.rows)
    paper = band(a, -1.5, PLANE.cols + 0.5) * band(b, -1.5, PLANE.rows + 0.5)
    ink = 0.5 * (inside + signs[0] * signs[1])
    ground = scene.background.level
    light = ground + (target.white - ground) * paper - (target.white - target.black) * ink
    return np.einsum("vjui,j,i->vu", light, 0.5 * WEIGHTS, 0.5 * WEIGHTS)


def shift(picture: Array, model: Array, gradient: tuple[Array, Array]) -> Array:
    """Least squares estimate of how far the picture lies from its model [px]."""
    J = -np.stack([g.ravel() for g in gradient], axis=-1)
    return np.asarray(np.linalg.lstsq(J, (picture - model).ravel(), rcond=None)[0])


@pytest.mark.parametrize(
    ("psf", "roll"),
    slow_but(((2.0, 0.3),), itertools.product((0.4, 0.8, 2.0), (0.0, 0.3, np.pi / 4, 1.2))),
)
def test_a_board_that_faces_the_camera_is_a_product_of_error_functions(psf: float, roll: float) -> None:
    middle = (79.37, 60.21)
    scene = facing(16.3, roll, middle, psf)
    difference = noise_free(scene) / 65535 - erf_model(scene, 16.3, roll, middle)
    # Lines along the pixels are the worst case: a cell's mean has forgotten where in it they are.
    assert np.abs(difference).max() < 6e-4
    assert np.sqrt((difference**2).mean()) < 1.5e-4


def test_more_cells_to_a_pixel_come_closer_to_the_error_functions() -> None:
    middle = (79.37, 60.21)
    scene = facing(16.3, 0.0, middle, 0.6)
    model = erf_model(scene, 16.3, 0.0, middle)
    errors = [np.abs(image_light(scene, parts) - model).max() for parts in (4, 8, 16)]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]


@pytest.mark.parametrize("roll", slow_but((0.2,), (0.0, 0.2)))
def test_every_edge_and_vertex_lies_within_a_ten_thousandth_of_a_pixel(roll: float) -> None:
    for offset in np.linspace(0.1, 0.6, 3) if roll == 0 else (0.1,):
        middle = (78.0 + offset, 61.0 - 0.7 * offset)
        scene = facing(18.0, roll, middle, 0.7)
        picture = noise_free(scene) / 65535
        step = 1e-3
        model = erf_model(scene, 18.0, roll, middle)
        du, dv = (
            (erf_model(scene, 18.0, roll, m) - model) / -step
            for m in ((middle[0] + step, middle[1]), (middle[0], middle[1] + step))
        )
        truth = ground_truth(scene).planes[0]
        for at in truth.vertices.reshape(-1, 2):
            window = np.s_[round(at[1]) - 6 : round(at[1]) + 7, round(at[0]) - 6 : round(at[0]) + 7]
            error = shift(picture[window], model[window], (du[window], dv[window]))
            assert np.abs(error).max() < 5e-5
        for at, normal in zip(truth.midpoints, truth.normals, strict=True):
            window = np.s_[round(at[1]) - 4 : round(at[1]) + 5, round(at[0]) - 4 : round(at[0]) + 5]
            across = normal[0] * du[window] + normal[1] * dv[window]
            error = -((picture - model)[window] * across).sum() / (across**2).sum()
            assert abs(error) < 1e-4


def straight_edge(distance: Array, normal: Array, psf: float) -> Array:
    """Profile of a straight edge, its normal pointing to white."""
    box = 0.5 * (normal[0] * NODES[:, None] + normal[1] * NODES)
    response = ndtr((distance[..., None, None] + box) / psf)
    return np.asarray(np.einsum("...ij,i,j->...", response, 0.5 * WEIGHTS, 0.5 * WEIGHTS))


@pytest.mark.parametrize("tilt", slow_but((60.0,), [30.0, 60.0, 72.0]))
def test_edges_of_a_tilted_board_are_straight_edges_between_its_vertices(tilt: float) -> None:
    scene = facing(34.0, 0.0, (80.0, 60.0), 0.8)
    scene = replace(scene, camera=replace(scene.camera, image_size=(320, 240)), psf=0.8)
    scene = replace(scene, pose=board_pose(scene, np.array([160.2, 119.6]), 36.0, tilt, 0.7, 0.15))
    picture = noise_free(scene) / 65535
    truth, target = ground_truth(scene).planes[0], scene.targets[0]
    v, u = np.mgrid[0:240, 0:320].astype(float)
    ends = truth.vertices.reshape(-1, 2)[truth.ends]
    errors = []
    for (first, second), middle, polarity, normal in zip(
        ends, truth.midpoints, truth.polarity, truth.normals, strict=True
    ):
        along = (second - first) / np.linalg.norm(second - first)
        white = polarity * np.array([-along[1], along[0]]) * np.sign(normal @ [-along[1], along[0]])
        distance = (u - first[0]) * white[0] + (v - first[1]) * white[1]
        near = (np.abs(u - middle[0]) < 3) & (np.abs(v - middle[1]) < 3) & (np.abs(distance) < 3)
        if np.linalg.norm(second - first) < 24:
            continue  # its vertices blur into the window
        model = target.black + (target.white - target.black) * straight_edge(distance[near], white, 0.8)
        slope = straight_edge(distance[near] + 1e-3, white, 0.8) - straight_edge(distance[near], white, 0.8)
        slope *= (target.white - target.black) / 1e-3
        errors.append(float(((picture[near] - model) * slope).sum() / (slope**2).sum()))
    assert len(errors) > 10
    assert np.abs(errors).max() < 3e-4


def undistorted(camera: Camera, pixels: Array) -> Array:
    """Normalised coordinates of pixels, by OpenCV's fixed point iteration."""
    ideal = np.linalg.solve(camera.intrinsics.A, np.column_stack([pixels, np.ones(len(pixels))]).T)[:2]
    k1, k2, p1, p2, k3 = camera.distortion.coefficients
    x, y = ideal
    for _ in range(14):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        tangential = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (ideal[0] - tangential[0]) / radial, (ideal[1] - tangential[1]) / radial
    return np.column_stack([x, y])


def brute_force(scene: Scene, left: int, top: int, size: int, fine: int = 30) -> Array:
    """A window of the picture in [0, 1] from dense samples, shaken so that no line hides between them."""
    rng = np.random.default_rng(0)
    pad = int(np.ceil(6 * scene.psf)) + 1
    axis = (np.arange((size + 2 * pad) * fine) + 0.5) / fine - 0.5 - pad
    u, v = (
        np.array(np.meshgrid(left + axis, top + axis))
        + rng.uniform(-0.5, 0.5, (2, len(axis), len(axis))) / fine
    )
    rays = undistorted(scene.camera, np.column_stack([u.ravel(), v.ravel()]))
    light = np.full(len(rays), scene.background.level)
    depth = np.full(len(rays), np.inf)
    for target in scene.targets:
        plane, R, t = target.plane, scene.pose.R, scene.pose.t
        normal, origin = R @ plane.normal, R @ np.array(plane.origin) + t
        own = (normal @ origin) / (rays @ normal[:2] + normal[2])
        point = own[:, None] * np.column_stack([rays, np.ones(len(rays))]) - origin
        a, b = (point @ (R @ np.array(axis)) / plane.square for axis in (plane.x_axis, plane.y_axis))
        low_a, high_a, low_b, high_b = target.paper_box
        on = (own > 0) & (own < depth) & (a > low_a) & (a < high_a) & (b > low_b) & (b < high_b)
        low_a, high_a, low_b, high_b = target.printed.box
        black = (np.floor(a) + np.floor(b)) % 2 == (0 if target.first_black else 1)
        black &= (a > low_a) & (a < high_a) & (b > low_b) & (b < high_b)
        light[on] = np.where(black, target.black, target.white)[on]
        depth[on] = own[on]
    shade, (width, height) = scene.illumination, scene.size
    gu, gv = shade.gradient
    slope = gu * (u - (width - 1) / 2) / width + gv * (v - (height - 1) / 2) / height
    samples = light.reshape(u.shape) * shade.level * (1 + slope)
    blurred = gaussian_filter(samples, scene.psf * fine, truncate=6, mode="nearest")
    boxes = blurred.reshape(size + 2 * pad, fine, size + 2 * pad, fine).mean(axis=(1, 3))
    return np.asarray(boxes[pad:-pad, pad:-pad])


def skewed_and_distorted() -> Scene:
    intrinsics = Intrinsics(300.0, 310.0, 158.0, 122.0, np.pi / 2 - 0.06)
    camera = Camera(intrinsics, Distortion("plumb_bob", [-0.3, 0.1, 0.002, -0.003, 0.01]), (320, 240))
    light = Illumination(0.8, (0.9, -0.7))
    scene = Scene(camera, Pose(np.eye(3), np.ones(3)), (Target(PLANE),), illumination=light, sensor=EXACT)
    return replace(scene, pose=board_pose(scene, np.array([110.0, 90.0]), 30.0, 45.0, 0.8, 0.3))


@pytest.mark.slow
def test_skew_distortion_tilt_and_light_agree_with_brute_force() -> None:
    scene = skewed_and_distorted()
    picture = noise_free(scene) / 65535
    truth = ground_truth(scene).planes[0]
    for u, v in truth.vertices[3, 4::2]:
        left, top = int(u) - 5, int(v) - 5
        window = np.s_[top : top + 11, left : left + 11]
        model = brute_force(scene, left, top, 11, fine=64)
        assert np.abs(picture[window] - model).max() < 5e-4
        gradient = np.gradient(model)
        assert np.abs(shift(picture[window], model, (gradient[1], gradient[0]))).max() < 6e-4


@pytest.mark.parametrize(
    "name", slow_but(("two boards",), ("two planes distorted", "three planes across", "two boards"))
)
def test_folds_and_planes_before_one_another_agree_with_brute_force(name: str) -> None:
    scene = replace(condition(name, 3), sensor=EXACT)
    picture = noise_free(scene) / 65535
    fold = scene.targets[1].plane.at([2.05, 0.0 if name == "two boards" else -scene.targets[1].reach.y_low])
    if name == "two boards":
        fold = scene.targets[1].plane.at([-1.5, 2.2])
    u, v = cv2.projectPoints(
        fold[None],
        cv2.Rodrigues(scene.pose.R)[0],
        scene.pose.t,
        scene.camera.intrinsics.A,
        scene.camera.distortion.coefficients,
    )[0].ravel()
    left, top = int(u) - 5, int(v) - 5
    model = brute_force(scene, left, top, 11, fine=60)
    assert np.ptp(model) > 0.5
    assert np.abs(picture[top : top + 11, left : left + 11] - model).max() < 1e-3


def test_two_planes_side_by_side_are_seamless() -> None:
    """A fold of 0 degrees is no fold: one board cut in two gives the same picture."""
    whole = facing(14.0, 0.21, (80.0, 60.0), 0.8)
    whole = replace(whole, pose=board_pose(whole, np.array([80.3, 59.9]), 14.0, 35.0, 0.4, 0.2))
    near = Plane("near", 3, 4, 10.0)
    far = Plane("far", 2, 4, 10.0, (30.0, 0.0, 0.0))
    margin = Sides.all(0.5)
    parts = (
        Target(near, reach=Sides(x_high=0.5), margin=replace(margin, x_high=0.0)),
        Target(far, first_black=False, reach=Sides(x_low=0.5), margin=replace(margin, x_low=0.0)),
    )
    for targets in (parts, parts[::-1]):
        difference = noise_free(replace(whole, targets=targets)) - noise_free(whole)
        assert np.abs(difference).max() / 65535 < 1e-4


@pytest.mark.parametrize("psf", slow_but((0.0, 3.0), [0.0, 0.8, 3.0]))
def test_light_is_neither_made_nor_lost(psf: float) -> None:
    scene = facing(11.7, 0.4, (80.0, 60.0), psf, background=Background(0.0))
    target, square = scene.targets[0], 11.7**2
    paper, black_squares = (PLANE.cols + 2) * (PLANE.rows + 2) * square, 15 * square
    expected = target.white * paper - (target.white - target.black) * black_squares
    assert image_light(scene).sum() == pytest.approx(expected, rel=2e-7)


def test_an_even_scene_is_even_whatever_the_blur() -> None:
    scene = facing(13.0, 0.3, (80.0, 60.0), 1.3, background=Background(0.37))
    grey = Target(PLANE, black=0.37, white=0.37)
    np.testing.assert_allclose(image_light(replace(scene, targets=(grey,))), 0.37, atol=1e-7)


def test_even_paper_under_a_gradient_of_light_shows_the_gradient() -> None:
    scene = facing(13.0, 0.3, (80.0, 60.0), 1.3, background=Background(0.5))
    grey = Target(PLANE, black=0.5, white=0.5)
    scene = replace(scene, targets=(grey,), illumination=Illumination(0.9, (0.8, -0.6), 0.4))
    u, v = np.arange(160) - 79.5, np.arange(120)[:, None] - 59.5
    light = 0.5 * 0.9 * (1 + 0.8 * u / 160 - 0.6 * v / 120)
    light = light * (1 - 0.4 * (u**2 + v**2) / (79.5**2 + 59.5**2))
    np.testing.assert_allclose(image_light(scene), light, atol=3e-6)

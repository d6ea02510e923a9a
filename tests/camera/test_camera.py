"""The 11 parameters: into matrices and back, their derivatives, and what is refused."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.decomposition import decompose
from support.distorted import LENSES
from support.plain_projection import project
from support.slow_cases import slow_but

from neurocal_cli.camera.camera import Camera, camera_of
from neurocal_cli.camera.distortion import MODELS, Distortion, distort
from neurocal_cli.camera.geometry import Array, euler_to_rotation
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.errors import InputError, UsageError

FLAT = Intrinsics(500.0, 500.0, 320.0, 240.0)

quick = settings(max_examples=30, deadline=None)
focal = st.floats(10, 1e5)
centre = st.floats(-1e4, 1e4)
cameras = st.builds(Intrinsics, focal, focal, centre, centre, st.floats(0.3, 2.8))
angle = st.floats(-3, 3)
poses = st.builds(
    lambda x, y, z, t: Pose.from_euler(x, y, z, np.array(t)),
    angle,
    st.floats(-1.5, 1.5),
    angle,
    st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
)


@quick
@given(cameras)
def test_intrinsics_come_back_from_their_matrix(camera: Intrinsics) -> None:
    found = Intrinsics.from_matrix(-3.0 * camera.A)
    np.testing.assert_allclose(found.values(), camera.values(), rtol=1e-12)


def test_the_matrix_is_the_papers() -> None:
    A = Intrinsics(500.0, 600.0, 310.0, 250.0, 1.4).A
    expected = [[500, -500 / np.tan(1.4), 310], [0, 600 / np.sin(1.4), 250], [0, 0, 1]]
    np.testing.assert_allclose(A, expected, rtol=1e-15)


def test_without_skew_the_matrix_has_an_exact_zero_and_theta_is_exactly_a_right_angle() -> None:
    camera = Intrinsics(500.0, 600.0, 310.0, 250.0)
    assert camera.A[0, 1] == 0
    assert camera.A[1, 1] == 600
    assert Intrinsics.from_matrix(camera.A) == camera


@quick
@given(cameras)
def test_entry_jacobian_by_central_differences(camera: Intrinsics) -> None:
    numeric = np.empty((5, 5))
    for n, (i, j) in enumerate(zip(*ENTRIES, strict=True)):
        h = np.zeros((3, 3))
        h[i, j] = 1e-5 * camera.alpha_u
        change = Intrinsics.from_matrix(camera.A + h).values() - Intrinsics.from_matrix(camera.A - h).values()
        numeric[:, n] = change / (2 * h[i, j])
    exact = camera.entry_jacobian()
    # theta's row is smaller by 1 / alpha: each row is compared with its own size, and what the
    # rounding of values around 1e4 leaves in a difference of steps h.
    rounding = 1e-15 * np.abs(camera.values())[:, None] / (1e-5 * camera.alpha_u)
    assert (np.abs(exact - numeric) <= 1e-6 * np.abs(exact).max(axis=1, keepdims=True) + 20 * rounding).all()


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ((np.nan, 1, 0, 0), "finite"),
        ((1, np.inf, 0, 0), "finite"),
        ((0, 1, 0, 0), "positive"),
        ((1, -1, 0, 0), "positive"),
        ((1, 1, 0, 0, 0), "theta"),
        ((1, 1, 0, 0, np.pi), "theta"),
    ],
)
def test_intrinsics_out_of_range_are_refused(values: tuple[float, ...], word: str) -> None:
    with pytest.raises(InputError, match=word):
        Intrinsics(*values)


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (np.eye(2), "3 x 3"),
        (np.full((3, 3), np.nan), "finite"),
        (np.diag([1.0, 1.0, 0.0]), r"A\[2, 2\]"),
        (np.ones((3, 3)), "upper triangular"),
        (np.diag([-1.0, 1.0, 1.0]), "positive|theta"),
    ],
)
def test_matrices_that_are_no_camera_are_refused(matrix: Array, word: str) -> None:
    with pytest.raises(InputError, match=word):
        Intrinsics.from_matrix(matrix)


def test_a_pose_takes_the_nearest_exact_rotation_and_keeps_an_exact_one_bit_by_bit() -> None:
    exact = euler_to_rotation(0.1, 0.2, 0.3)
    assert Pose(exact, np.zeros(3)).R.tobytes() == exact.tobytes()
    rounded = Pose(np.round(exact, 5), np.zeros(3)).R
    np.testing.assert_allclose(rounded @ rounded.T, np.eye(3), atol=1e-15)


@quick
@given(poses, poses)
def test_poses_one_after_the_other_and_back(first: Pose, second: Pose) -> None:
    world = np.array([[0.0, 0.0, 0.0], [100.0, -20.0, 7.0]])
    there = second.after(first)
    np.testing.assert_allclose(there.to_camera(world), second.to_camera(first.to_camera(world)), atol=1e-9)
    np.testing.assert_allclose(there.inverse.to_camera(there.to_camera(world)), world, atol=1e-9)
    np.testing.assert_allclose(there.after(first.inverse).t, there.relative_to(first).t, atol=1e-9)


@pytest.mark.parametrize(
    ("R", "t", "word"),
    [
        (np.eye(2), np.zeros(3), "3 x 3"),
        (np.eye(3), np.zeros(2), "3 numbers"),
        (np.eye(3), np.full(3, np.inf), "finite"),
        (2 * np.eye(3), np.zeros(3), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "not a rotation"),
    ],
)
def test_poses_that_are_none_are_refused(R: Array, t: Array, word: str) -> None:
    with pytest.raises(InputError, match=word):
        Pose(R, t)


def test_a_pose_is_read_only_and_takes_a_copy() -> None:
    t = np.zeros(3)
    pose = Pose(np.eye(3), t)
    t[0] = 1.0
    assert pose.t[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        pose.t[0] = 2.0


@quick
@given(cameras, poses, st.sampled_from([-1, 1]), st.floats(-6, 6))
def test_a_projection_matrix_of_any_sign_and_scale_is_taken_apart(
    camera: Intrinsics, pose: Pose, sign: int, exponent: float
) -> None:
    P = sign * 10.0**exponent * camera.A @ pose.D
    found, found_pose = decompose(P)
    np.testing.assert_allclose(found.A, camera.A, rtol=1e-7, atol=1e-7 * np.abs(camera.A).max())
    np.testing.assert_allclose(found_pose.R, pose.R, atol=1e-6)
    again = found.A @ found_pose.D
    np.testing.assert_allclose(again, P / (sign * 10.0**exponent), rtol=1e-9, atol=1e-9 * np.abs(again).max())


# Projection, beside the same written plainly


SIZE = (640, 480)
every_model = pytest.mark.parametrize("model", list(MODELS))
with_and_without_skew = pytest.mark.parametrize("theta", slow_but((1.5,), (np.pi / 2, 1.5)))


def camera_with(model: str, theta: float = np.pi / 2) -> Camera:
    return Camera(Intrinsics(500.0, 510.0, 320.0, 240.0, theta), Distortion(model, LENSES[model]), SIZE)


def some_points(n: int = 40) -> Array:
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 3, n)
    return np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)) * depth[:, None], depth])


def some_pixels(n: int = 40) -> Array:
    return np.random.default_rng(2).uniform([0, 0], [639, 479], (n, 2))


def slopes(f: Callable[[Array], Array], x: Array, steps: Array) -> Array:
    """Central differences of f (N, d) by each of the entries of x, which is a row or N of them."""
    columns = []
    for n, h in enumerate(steps):
        e = np.zeros(x.shape[-1])
        e[n] = h
        columns.append((f(x + e) - f(x - e)) / (2 * h))
    return np.stack(columns, axis=-1)


def with_parameters(camera: Camera, values: Array) -> Camera:
    """The camera of A11, A12, A22, A13, A23 and coefficients."""
    A = np.eye(3)
    A[ENTRIES] = values[:5]
    distortion = Distortion(camera.distortion.model, values[5:])
    return Camera(Intrinsics.from_matrix(A), distortion, camera.image_size)


@with_and_without_skew
def test_projecting_is_multiplying_by_p_and_dividing(theta: float) -> None:
    camera = camera_with("none", theta)
    pose = Pose.from_euler(0.1, 0.2, 0.3, np.array([1.0, 2.0, 9.0]))
    world = np.random.default_rng(0).normal(size=(7, 3))
    S = np.column_stack([world, np.ones(7)]) @ (camera.A @ pose.D).T
    pixels, in_front = camera.project(pose.to_camera(world))
    np.testing.assert_allclose(pixels, S[:, :2] / S[:, 2:], rtol=1e-13)
    np.testing.assert_allclose(pixels, project(camera.A, pose, world)[0], rtol=1e-13)
    assert in_front.all()


@every_model
def test_skew_acts_after_distortion(model: str) -> None:
    camera, points = camera_with(model, 1.4), some_points()
    x, y = (points[:, :2] / points[:, 2:]).T
    distorted = np.column_stack([*distort(model, LENSES[model], x, y), np.ones(len(x))])
    np.testing.assert_allclose(camera.project(points)[0], (distorted @ camera.A.T)[:, :2], rtol=1e-12)


def test_points_behind_and_beyond_are_told() -> None:
    camera = camera_with("k1")
    points = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [9.0, 0.0, 1.0]])
    pixels, in_front = camera.project(points)
    assert in_front.tolist() == [True, False, False, True]
    assert np.isfinite(pixels).all(axis=1).tolist() == [True, False, False, True]
    assert camera.sees(points).tolist() == [True, False, False, False]


def test_an_image_shows_what_is_within_its_outermost_pixels() -> None:
    camera = Camera(Intrinsics(100.0, 100.0, 50.0, 40.0), Distortion(), (100, 80))
    u = np.array([-0.6, -0.4, 50.0, 99.4, 99.6])
    points = np.column_stack([(u - 50.0) / 100.0, np.zeros(5), np.ones(5)])
    assert camera.shows(points).tolist() == [False, True, True, True, False]
    assert not camera.shows(-points).any()
    assert replace(camera, image_size=None).shows(points).all()


@pytest.mark.parametrize(
    ("model", "theta"),
    slow_but([(model, 1.5) for model in MODELS], itertools.product(MODELS, (np.pi / 2, 1.5))),
)
def test_project_jacobian_by_central_differences(model: str, theta: float) -> None:
    camera, points = camera_with(model, theta), some_points()
    by_camera, by_point = camera.project_jacobian(points)
    numeric = slopes(lambda p: camera.project(p)[0], points, np.full(3, 1e-5))
    np.testing.assert_allclose(by_point, numeric, rtol=1e-6, atol=1e-4)
    values = np.array([*camera.entries, *camera.distortion.coefficients])
    steps = np.array([1e-2] * 5 + [1e-5] * (len(values) - 5))
    numeric = slopes(lambda v: with_parameters(camera, v).project(points)[0], values, steps)
    np.testing.assert_allclose(by_camera, numeric, rtol=1e-6, atol=1e-5)


@every_model
@with_and_without_skew
def test_unproject_inverts_project(model: str, theta: float) -> None:
    camera, points, pixels = camera_with(model, theta), some_points(), some_pixels()
    rays = camera.unproject(camera.project(points)[0])
    np.testing.assert_allclose(rays, points / np.linalg.norm(points, axis=1)[:, None], atol=1e-11)
    np.testing.assert_allclose(camera.project(camera.unproject(pixels))[0], pixels, atol=1e-9)
    assert camera.unproject(pixels.reshape(4, 10, 2)).shape == (4, 10, 3)


def test_a_pixel_that_the_camera_cannot_see_has_no_ray() -> None:
    camera = Camera(Intrinsics(100.0, 100.0, 0.0, 0.0), Distortion("k1", [-1.0]))
    rays = camera.unproject(np.array([[30.0, 0.0], [50.0, 0.0]]))  # the image ends at 38.5
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False]


# Other images of the same camera


@every_model
@pytest.mark.parametrize("theta", slow_but((1.5,), (np.pi / 2, 1.5)))
@pytest.mark.parametrize("scale", slow_but(((0.25, 0.5),), (0.5, 2.0, (0.25, 0.5))))
def test_a_rescaled_camera_sees_every_point_at_its_place_in_the_resized_image(
    model: str, theta: float, scale: float | tuple[float, float]
) -> None:
    camera, points = camera_with(model, theta), some_points()
    rescaled = camera.rescaled(scale)
    expected = (camera.project(points)[0] + 0.5) * scale - 0.5
    np.testing.assert_allclose(rescaled.project(points)[0], expected, rtol=1e-12, atol=1e-9)
    assert rescaled.image_size == tuple(np.round(np.array(SIZE) * scale).astype(int).tolist())


def test_resizing_an_image_moves_its_content_as_rescaled_says() -> None:
    cv2 = pytest.importorskip("cv2")
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    at = np.array([200.0, 150.0])
    dot = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * 6.0**2))
    small = cv2.resize(dot, (160, 120), interpolation=cv2.INTER_AREA)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    found = np.array([(small * u).sum(), (small * v).sum()]) / small.sum()
    camera = Camera(Intrinsics(500.0, 500.0, *at), image_size=SIZE).rescaled(0.25)
    assert [camera.intrinsics.u0, camera.intrinsics.v0] == pytest.approx(found, abs=1e-6)


@every_model
@with_and_without_skew
def test_a_cropped_camera_sees_every_point_moved(model: str, theta: float) -> None:
    camera, points = camera_with(model, theta), some_points()
    cropped = camera.cropped(40, 25, 320, 200)
    np.testing.assert_allclose(cropped.project(points)[0], camera.project(points)[0] - [40, 25], atol=1e-9)
    assert cropped.image_size == (320, 200)


@pytest.mark.parametrize("size", [(0, 5), (1.5, 2), (np.nan, 2), (np.inf, 2), (1,), (10**7, 2), "ab"])
def test_wrong_sizes_of_the_image_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="image_size must be"):
        Camera(Intrinsics(500, 500, 0, 0), image_size=size)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Camera(FLAT.A), "Intrinsics.from_matrix makes of a 3 x 3 matrix"),
        (lambda: Camera(FLAT, [0.1]), "give one such as Distortion"),
        (
            lambda: Camera(FLAT).project(np.zeros((3, 2))),
            r"points must have the shape \(..., 3\), found \(3, 2\)",
        ),
        (lambda: Camera(FLAT).sees(np.float64(1)), r"points must have the shape"),
        (lambda: Camera(FLAT).unproject(np.zeros((3, 3))), r"pixels must have the shape \(..., 2\)"),
        (lambda: Camera(FLAT).unproject([["a", "b"]]), "pixels must be an array of real numbers"),
        (lambda: Distortion("k1", ["a"]), "coefficients must be an array of real numbers"),
        (lambda: Distortion("k1", [np.nan]), "k1 needs 1 finite coefficients"),
        (lambda: Intrinsics("a", 1, 1, 1), "alpha_u must be a number, not 'a'"),
        (lambda: Intrinsics([1], [1], [1], [1], [1]), "alpha_u must be a number, not list of int"),
        (lambda: Intrinsics.from_matrix(FLAT.A.astype(complex)), "A must be an array of real numbers"),
        (lambda: Pose("a", "b"), "R must be an array of real numbers"),
    ],
)
def test_arrays_that_fit_no_camera_are_refused(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_wrong_scales_are_refused() -> None:
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="scale of an image must be positive"):
            camera_with("k1").rescaled(scale)


def test_a_camera_is_taken_in_any_form() -> None:
    intrinsics = Intrinsics(500.0, 510.0, 320.0, 240.0)
    camera = Camera(intrinsics, Distortion("k1", [-0.2]))
    assert camera_of(camera) is camera
    for given_as in (intrinsics, intrinsics.A, intrinsics.A.tolist()):
        assert camera_of(given_as).intrinsics == intrinsics
        assert camera_of(given_as).distortion.is_identity
    with pytest.raises(UsageError, match="must be a Camera, a Calibration"):
        camera_of("camera.yaml")  # type: ignore[arg-type]

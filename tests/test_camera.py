"""The 11 parameters: into matrices and back, their derivatives, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurocal_cli.bundle_adjustment.reprojection import ENTRIES
from neurocal_cli.camera.pinhole import Intrinsics, Pose, decompose, project, projection_jacobian
from neurocal_cli.errors import DegenerateGeometryError, InputError
from neurocal_cli.geometry import Array, euler_to_rotation, rotation_step

quick = settings(max_examples=60, deadline=None)
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
    # Points in front of this camera, at depths 1 to 2.
    ahead = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 2], (20, 3))
    world = (ahead - pose.t) @ pose.R
    for points in (world, None):
        found, found_pose = decompose(P, points)
        np.testing.assert_allclose(found.A, camera.A, rtol=1e-7, atol=1e-7 * np.abs(camera.A).max())
        np.testing.assert_allclose(found_pose.R, pose.R, atol=1e-6)
        again = found.A @ found_pose.D
        np.testing.assert_allclose(
            again, P / (sign * 10.0**exponent), rtol=1e-9, atol=1e-9 * np.abs(again).max()
        )


def test_a_mirrored_camera_points_on_both_sides_and_a_camera_at_infinity_are_refused() -> None:
    world = np.random.default_rng(0).uniform(-1, 1, (10, 3))
    P = np.array([[500.0, 0, 320, 0], [0, 500, 240, 0], [0, 0, 1, 3]])
    with pytest.raises(DegenerateGeometryError, match="mirrored camera"):
        decompose(P @ np.diag([1.0, 1, -1, 1]), world)
    with pytest.raises(DegenerateGeometryError, match="both sides"):
        decompose(P - [[0] * 4, [0] * 4, [0, 0, 0, 3]], world)
    with pytest.raises(DegenerateGeometryError, match="singular"):
        decompose(np.array([[500.0, 0, 0, 0], [0, 500, 0, 0], [0, 0, 0, 3]]), world)


def test_projecting_is_multiplying_by_p_and_dividing() -> None:
    camera, pose = (
        Intrinsics(500.0, 510.0, 320.0, 240.0, 1.5),
        Pose.from_euler(0.1, 0.2, 0.3, [1.0, 2.0, 9.0]),
    )
    world = np.random.default_rng(0).normal(size=(7, 3))
    S = np.column_stack([world, np.ones(7)]) @ (camera.A @ pose.D).T
    pixels, depth = project(camera.A, pose, world)
    np.testing.assert_allclose(pixels, S[:, :2] / S[:, 2:], rtol=1e-13)
    np.testing.assert_allclose(depth, S[:, 2], rtol=1e-13)


@quick
@given(cameras, st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 5)))
def test_projection_jacobian_by_central_differences(camera: Intrinsics, point: tuple[float, ...]) -> None:
    Xc = np.array(point)
    by_A, by_pose = projection_jacobian(camera.A, Xc)

    def pixel(A: Array, M: Array) -> Array:
        S = A @ M
        return np.asarray(S[:2] / S[2])

    numeric_A, numeric = np.empty((2, 5)), np.empty((2, 6))
    for n, (i, j) in enumerate(zip(*ENTRIES, strict=True)):
        dA = np.zeros((3, 3))
        dA[i, j] = 1e-3 * camera.alpha_u
        numeric_A[:, n] = (pixel(camera.A + dA, Xc) - pixel(camera.A - dA, Xc)) / (2 * dA[i, j])
    h = 1e-5
    for n in range(3):
        e = h * np.eye(3)[n]
        turned, back = rotation_step(e) @ Xc, rotation_step(-e) @ Xc
        numeric[:, n] = (pixel(camera.A, turned) - pixel(camera.A, back)) / (2 * h)
        numeric[:, n + 3] = (pixel(camera.A, Xc + e) - pixel(camera.A, Xc - e)) / (2 * h)
    rounding = 1e-15 * np.abs(camera.A).max() / h
    assert np.abs(by_A - numeric_A).max() <= 1e-6 + rounding
    assert np.abs(by_pose - numeric).max() <= 1e-6 * np.abs(by_pose).max() + 20 * rounding

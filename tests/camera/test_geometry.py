"""Rotations, factorisations and similarities: identities over random input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import (
    Array,
    cross_matrix,
    distinct_rows,
    euler_jacobian,
    euler_to_rotation,
    nearest_rotation,
    orthonormalised,
    rotation_step,
    rotation_to_euler,
    similarity,
)

angle = st.floats(-np.pi, np.pi)
vector = arrays(float, 3, elements=st.floats(-1, 1))
matrix = arrays(float, (3, 3), elements=st.floats(-1, 1).map(lambda x: round(x, 6)))
quick = settings(max_examples=30, deadline=None)


def about(axis: Array, angle: float) -> Array:
    """Rotation by Rodrigues' formula."""
    K = cross_matrix(axis / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def rotations(n: int, seed: int = 0) -> Array:
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, 3, 3)))[0]
    return q * np.linalg.det(q)[:, None, None]


def assert_rotation(R: Array, tolerance: float = 1e-14) -> None:
    assert np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max() < tolerance
    assert (np.linalg.det(R) > 0).all()


@quick
@given(angle, angle, angle)
def test_a_rotation_is_rx_first_then_ry_then_rz_about_fixed_axes(R_x: float, R_y: float, R_z: float) -> None:
    x, y, z = np.eye(3)
    expected = about(z, R_z) @ about(y, R_y) @ about(x, R_x)
    np.testing.assert_allclose(euler_to_rotation(R_x, R_y, R_z), expected, atol=2e-15)


@quick
@given(angle, st.floats(-1.5, 1.5), angle)
def test_euler_angles_come_back(R_x: float, R_y: float, R_z: float) -> None:
    found = rotation_to_euler(euler_to_rotation(R_x, R_y, R_z))
    turns = (found - [R_x, R_y, R_z]) / (2 * np.pi)
    assert np.abs(turns - np.round(turns)).max() < 1e-13
    assert abs(found[1]) <= np.pi / 2


@settings(max_examples=50, deadline=None)
@given(angle, angle, st.floats(0, 17), st.sampled_from([-1, 1]))
@example(R_x=0.3, R_z=-0.8, digits=11.0, side=1)
@example(R_x=0.3, R_z=-0.8, digits=17.0, side=-1)
def test_a_rotation_survives_its_angles_however_near_the_gimbal_lock(
    R_x: float, R_z: float, digits: float, side: int
) -> None:
    R = euler_to_rotation(R_x, side * (np.pi / 2 - 10.0**-digits), R_z)
    np.testing.assert_allclose(euler_to_rotation(*rotation_to_euler(R)), R, atol=3e-12)


def test_at_the_gimbal_lock_r_z_is_zero() -> None:
    for side in (-1, 1):
        R = euler_to_rotation(0.4, side * np.pi / 2, 0.9)
        R_x, R_y, R_z = rotation_to_euler(R)
        assert R_z == 0
        assert R_y == pytest.approx(side * np.pi / 2)
        assert R_x == pytest.approx(0.4 - side * 0.9)


def test_angles_of_a_stack_are_the_angles_of_each() -> None:
    R = rotations(6).reshape(2, 3, 3, 3)
    each = [[rotation_to_euler(r) for r in row] for row in R]
    np.testing.assert_array_equal(rotation_to_euler(R), each)


def test_euler_jacobian_by_central_differences() -> None:
    for R in rotations(40):
        if abs(R[2, 0]) > 0.99:
            continue
        h = 1e-5
        steps = [
            (rotation_to_euler(about(e, h) @ R) - rotation_to_euler(about(e, -h) @ R)) / (2 * h)
            for e in np.eye(3)
        ]
        numeric = np.column_stack(steps)
        assert np.abs(euler_jacobian(R) - numeric).max() <= 1e-6 * np.abs(numeric).max()


def test_at_the_gimbal_lock_the_euler_jacobian_moves_what_is_defined() -> None:
    R = euler_to_rotation(0.4, np.pi / 2, 0.0)
    J = euler_jacobian(R)
    assert np.isfinite(J).all()
    assert np.linalg.matrix_rank(J, tol=1e-6) == 2


@quick
@given(vector, vector)
def test_cross_matrix_is_the_cross_product(w: Array, x: Array) -> None:
    np.testing.assert_allclose(cross_matrix(w) @ x, np.cross(w, x), atol=1e-15)


@quick
@given(vector, st.floats(-12, 6))
def test_a_step_is_a_rotation_for_any_w(direction: Array, exponent: float) -> None:
    assert_rotation(rotation_step(direction * 10.0**exponent), 1e-9 if exponent > 3 else 1e-14)


@quick
@given(vector.filter(lambda w: np.linalg.norm(w) > 1e-3), st.floats(0.01, 0.5))
def test_a_step_is_the_rotation_by_w_up_to_third_order(direction: Array, size: float) -> None:
    w = direction / np.linalg.norm(direction) * size
    # Cayley turns by 2 atan(|w| / 2) = |w| - |w|^3 / 12 + ...
    assert np.abs(rotation_step(w) - about(w, size)).max() <= size**3 / 12
    np.testing.assert_allclose(rotation_step(w), about(w, 2 * np.arctan(size / 2)), atol=1e-14)


def test_orthonormalising_squares_the_error() -> None:
    R = rotations(5)
    rough = R + 1e-6 * np.random.default_rng(1).normal(size=R.shape)
    assert_rotation(orthonormalised(rough), 1e-10)
    np.testing.assert_allclose(orthonormalised(R), R, atol=1e-15)


@quick
@given(matrix, st.integers(0, 10))
def test_no_rotation_is_nearer_than_the_nearest(M: Array, seed: int) -> None:
    R = nearest_rotation(M)
    assert_rotation(R)
    others = rotations(50, seed)
    assert np.linalg.norm(M - R) <= np.linalg.norm(M - others, axis=(1, 2)).min() + 1e-12
    # Nor is a small turn of it.
    turned = rotation_step(1e-3 * np.random.default_rng(seed).normal(size=(50, 3))) @ R
    assert np.linalg.norm(M - R) <= np.linalg.norm(M - turned, axis=(1, 2)).min() + 1e-12


def test_the_nearest_rotation_of_a_scaled_one_is_itself_and_of_a_mirrored_one_proper() -> None:
    R = rotations(5)
    np.testing.assert_allclose(nearest_rotation(7.0 * R), R, atol=1e-14)
    assert_rotation(nearest_rotation(-R))


@quick
@given(arrays(float, (5, 2), elements=st.floats(-1e6, 1e6)))
def test_a_similarity_brings_points_into_the_unit_square(points: Array) -> None:
    centre, scale = similarity(points)
    normal = (points - centre) / scale
    assert np.abs(normal).max() <= 1
    assert np.abs(normal).max() == pytest.approx(1) or np.ptp(points, axis=0).max() < 1e-9


def test_points_that_coincide_have_scale_1() -> None:
    centre, scale = similarity(np.full((4, 2), 3.0))
    assert centre.tolist() == [3.0, 3.0]
    assert scale == 1.0


@quick
@given(arrays(np.intp, st.tuples(st.integers(0, 12), st.integers(1, 3)), elements=st.integers(-1, 1)))
def test_distinct_rows_are_those_of_numpy(table: NDArray[np.intp]) -> None:
    first, label = distinct_rows(table)
    _, expected, places = np.unique(table, axis=0, return_index=True, return_inverse=True)
    assert first.tolist() == expected.tolist()
    assert label.tolist() == places.ravel().tolist()

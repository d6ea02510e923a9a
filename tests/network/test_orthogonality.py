"""The orthogonality conditions: products in, the shared camera and its poses out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.slow_cases import slow_but

from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.camera.geometry import Array
from neurocal_cli.network.orthogonality import _Conditions, pose_from_product, shared_intrinsics

CAMERA = np.array([1.9, 0.05, 2.0, 0.1, -0.1])
ALL = np.ones(5, dtype=bool)
NO_SKEW = np.array([1, 0, 1, 1, 1], dtype=bool)
CENTRED = np.array([1, 1, 1, 0, 0], dtype=bool)
BOTH = np.array([1, 0, 1, 0, 0], dtype=bool)


def poses(n: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    R = Rotation.from_euler("xyz", rng.uniform(-0.7, 0.7, (n, 3))).as_matrix()
    return R, np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), rng.uniform(3, 4, n)])


def products(n: int, flat: bool, entries: Array = CAMERA, seed: int = 0) -> Array:
    """A [R | t] of random poses with random scale and sign; (n, 3, 4 or 3)."""
    R, t = poses(n, seed)
    D = np.concatenate([R[..., :2] if flat else R, t[..., None]], axis=2)
    factor = np.random.default_rng(seed + 1).uniform(0.1, 5, n) * np.where(np.arange(n) % 2, -1, 1)
    return np.asarray(factor[:, None, None] * (intrinsic_matrix(entries) @ D))


def without_skew(free: Array) -> Array:
    return np.where(free[1], CAMERA, CAMERA * [1, 0, 1, 1, 1])


@pytest.mark.parametrize("free", [ALL, NO_SKEW, CENTRED, BOTH], ids=["all", "no skew", "centred", "both"])
@pytest.mark.parametrize(("n_solid", "n_flat"), [(1, 0), (4, 0), (0, 3), (0, 12), (1, 1), (2, 5)])
@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_exact_products_give_back_the_camera(n_solid: int, n_flat: int, free: Array, seed: int) -> None:
    true = without_skew(free)
    solid = products(n_solid, False, true, seed)[:, :, :3] if n_solid else np.zeros((0, 3, 3))
    flat = products(n_flat, True, true, seed + 10)[:, :, :2] if n_flat else np.zeros((0, 3, 2))
    shared = shared_intrinsics(solid, flat, np.where(free, 0.0, true), free, np.random.default_rng(0))
    np.testing.assert_allclose(shared.entries[0], true, atol=1e-5)
    np.testing.assert_array_equal(
        shared.entries[:, ~free][:, 1:], np.tile(true[~free][1:], (len(shared.loss), 1))
    )
    assert (np.diff(shared.loss) >= 0).all()
    assert shared.agreed >= 2


def test_derivatives_of_the_conditions_by_central_differences() -> None:
    conditions = _Conditions(products(2, False)[:, :, :3], products(3, True)[:, :, :2], ALL)
    p = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 5))
    residuals, derivatives = conditions(p)
    # Solid views give 3 pairs of columns, flat ones 1, two conditions each.
    assert residuals.shape == (4, 2 * (3 * 2 + 3))
    h = 1e-6
    for n in range(5):
        step = h * np.eye(5)[n]
        numeric = (conditions(p + step)[0] - conditions(p - step)[0]) / (2 * h)
        assert np.abs(derivatives[:, n] - numeric).max() < 1e-6 * np.abs(derivatives).max()


def test_conditions_hold_for_the_true_camera_alone() -> None:
    conditions = _Conditions(products(2, False)[:, :, :3], products(3, True)[:, :, :2], ALL)
    true = CAMERA.copy()
    true[[0, 2]] = np.log(true[[0, 2]])
    assert np.abs(conditions(true[None])[0]).max() < 1e-12
    assert np.abs(conditions(true[None] + 0.01)[0]).max() > 1e-4


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_poses_come_back_from_their_products_of_either_sign(flat: bool) -> None:
    R, t = poses(8)
    found_R, found_t = pose_from_product(intrinsic_matrix(CAMERA), products(8, flat))
    np.testing.assert_allclose(found_R, R, atol=1e-13)
    np.testing.assert_allclose(found_t, t, atol=1e-12)


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
def test_poses_of_inexact_products_are_rotations_in_front(flat: bool) -> None:
    rough = products(20, flat)
    rough += 0.3 * np.random.default_rng(5).normal(size=rough.shape)
    R, t = pose_from_product(intrinsic_matrix(CAMERA), rough)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-13)
    assert (np.linalg.det(R) > 0).all()
    assert (t[:, 2] > 0).all()

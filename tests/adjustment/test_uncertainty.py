"""Standard deviations against the dense inverse of the whole normal matrix, in the user's own units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.noise import noisy, whitener
from support.plain_projection import project
from support.scenes import pinhole, random_flat_set, random_solid
from support.slow_cases import slow_but

from neurocal_cli import Correspondences
from neurocal_cli.adjustment.cross_validation import Minimum
from neurocal_cli.adjustment.reprojection import normal_blocks
from neurocal_cli.adjustment.views import arrange
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES, POSE_NAMES, Intrinsics, Pose
from neurocal_cli.camera.state import CameraState


def parameters(cal: Calibration) -> Array:
    poses = [np.concatenate([view.pose.euler, view.pose.t]) for view in cal.views.values()]
    return np.concatenate([cal.intrinsics.values(), *poses])


def seen(points: Correspondences, p: Array, U: Array) -> Array:
    """Whitened pixels (2 N,) for the parameters by their names in the paper."""
    pixels = np.empty((len(points), 2))
    A = Intrinsics(*p[:5]).A
    for k in range(points.n_views):
        x, y, z, *t = p[5 + 6 * k : 11 + 6 * k]
        mine = points.view_index == k
        pixels[mine] = project(A, Pose.from_euler(x, y, z, np.array(t)), points.world[mine])[0]
    return np.asarray((U @ pixels[..., None]).reshape(-1))


def dense_covariance(cal: Calibration, type: int) -> Array:
    """Covariance of all the parameters, zero for given ones, by central differences."""
    points, p = cal.points, parameters(cal)
    U = whitener(points)
    free = np.array([name not in cal.fixed for name in INTRINSIC_NAMES] + [type != 4] * (len(p) - 5))
    # Steps that move the pixels by about 1e-3 of the image, whatever the unit.
    size = np.abs(points.world).max()
    scale = np.concatenate(
        [[p[0], p[1], p[0], p[1], 1.0], np.tile([1.0, 1.0, 1.0] + [size] * 3, len(cal.views))]
    )
    columns = []
    for n in np.flatnonzero(free):
        h = 1e-6 * scale[n] * np.eye(len(p))[n]
        columns.append((seen(points, p + h, U) - seen(points, p - h, U)) / (2e-6 * scale[n]))
    J = np.column_stack(columns)
    length = np.linalg.norm(J, axis=0)
    _, R = np.linalg.qr(J / length)
    inverse = np.linalg.inv(R) / length[:, None]
    r = (U @ points.pixels[..., None]).reshape(-1) - seen(points, p, U)
    found = np.zeros((len(p), len(p)))
    found[np.ix_(free, free)] = inverse @ inverse.T * (r @ r) / (len(r) - free.sum())
    return found


def reported(cal: Calibration) -> Array:
    """Standard deviations of all the parameters."""
    of_poses = [view.std[name] for view in cal.views.values() for name in POSE_NAMES]
    return np.array([cal.std[name] for name in INTRINSIC_NAMES] + of_poses)


def assert_std(cal: Calibration, type: int, relative: float = 1e-5) -> None:
    dense = dense_covariance(cal, type)
    std = np.sqrt(np.diagonal(dense))
    np.testing.assert_allclose(reported(cal), std, rtol=relative)
    rows = [INTRINSIC_NAMES.index(name) for name in cal.covariance_names]
    limit = relative * std[rows][:, None] * std[rows]
    assert (np.abs(cal.covariance - dense[np.ix_(rows, rows)]) <= limit).all()


@pytest.mark.parametrize("weights", slow_but(("suu,suv,svv",), ["none", "sigma", "suu,suv,svv"]))
@pytest.mark.parametrize("skew", slow_but((True,), [True, False]))
@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_std_and_covariance_of_a_solid_target(type: int, skew: bool, weights: str) -> None:
    rng = np.random.default_rng(type)
    scene = random_solid(np.random.default_rng(5), 1, skew)
    assert len(scene.view) > 20
    assert_std(pinhole(noisy(scene, weights, rng), skew=skew, **scene.given(type)), type)


@pytest.mark.parametrize("weights", slow_but(("suu,suv,svv",), ["none", "suu,suv,svv"]))
@pytest.mark.parametrize("skew", slow_but((False,), [True, False]))
@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_std_and_covariance_of_flat_boards(type: int, skew: bool, weights: str) -> None:
    """By chance views contradict each other in one draw of twenty, and share their noise in another one."""
    rng = np.random.default_rng(type)
    scene = random_flat_set(np.random.default_rng(3), 4, skew, cols=9, rows=6)
    as_dense = 0
    for _ in range(8):
        found = pinhole(noisy(scene, weights, rng), skew=skew, target="given", **scene.given(type))
        std = np.sqrt(np.diagonal(dense_covariance(found, type)))
        assert (reported(found) >= (1 - 1e-5) * std).all()
        if np.allclose(reported(found), std, rtol=1e-5):
            assert_std(found, type)
            as_dense += 1
    assert as_dense >= 5


def test_std_of_theta_and_alpha_v_with_axes_that_are_far_from_perpendicular() -> None:
    rng = np.random.default_rng(0)
    scene = random_solid(np.random.default_rng(5), 1, True)
    camera = Intrinsics(scene.intrinsics.alpha_u, scene.intrinsics.alpha_v, 500.0, 400.0, 1.2)
    pixels = project(camera.A, scene.poses["view"], scene.world)[0]
    points = Correspondences(scene.world, pixels + 0.2 * rng.normal(size=pixels.shape))
    assert_std(pinhole(points), 1)


@pytest.mark.parametrize("type", [1, 3])
def test_std_of_a_pose_whose_world_origin_is_300_target_sizes_away(type: int) -> None:
    rng = np.random.default_rng(0)
    scene = random_solid(np.random.default_rng(5), 1, False)
    size = np.ptp(scene.world, axis=0).max()
    shift = np.array([300.0, -200.0, 100.0]) * size
    points = replace(scene.points(0.3, rng), world=scene.world - scene.world.mean(axis=0) + shift)
    # Differences of numbers 300 times larger than the target leave 1e-4 of the answer open.
    assert_std(pinhole(points, skew=False, **scene.given(type)), type, 1e-4)


@pytest.mark.parametrize("free", [[1, 1, 1, 1, 1], [1, 0, 1, 0, 0], [0, 0, 0, 0, 0]])
@pytest.mark.parametrize("poses", [True, False])
def test_elimination_view_by_view_is_the_inverse_of_the_whole(free: list[int], poses: bool) -> None:
    f = np.flatnonzero(free)
    if not poses and not f.size:
        return
    scene = random_flat_set(np.random.default_rng(1), 5, False, cols=6, rows=5)
    views = arrange(scene.points(0.5, np.random.default_rng(2)))
    state = scene.true_state(views)
    normal, _ = normal_blocks(views.batches, state)
    whole = np.zeros((len(f) + 30 * poses,) * 2)
    whole[: len(f), : len(f)] = normal[:, f[:, None], f].sum(axis=0)
    for k in range(5 * poses):
        mine = slice(len(f) + 6 * k, len(f) + 6 * k + 6)
        whole[mine, mine] = normal[k, 5:11, 5:11]
        whole[: len(f), mine] = normal[k][f, 5:11]
        whole[mine, : len(f)] = normal[k][f, 5:11].T
    variance = normal[:, 11, 11].sum() / (2 * len(scene.view) - len(whole))
    expected = variance * np.linalg.inv(whole)
    found = Minimum(views, state, normal, np.array(free, bool), poses).covariance(2 * len(scene.view))
    np.testing.assert_allclose(found.shared, expected[: len(f), : len(f)], rtol=1e-8)
    assert found.own.shape == (5, 6 * poses, 6 * poses)
    for k in range(5 * poses):
        mine = slice(len(f) + 6 * k, len(f) + 6 * k + 6)
        block = expected[mine, mine]
        np.testing.assert_allclose(found.own[k], block, rtol=1e-7, atol=1e-9 * np.abs(block).max())
    assert found.smallest > 0


def test_a_singular_normal_matrix_is_called_so_without_a_warning() -> None:
    scene = random_flat_set(np.random.default_rng(1), 3, False, cols=6, rows=5)
    views = arrange(scene.points())
    state = scene.true_state(views)
    normal, _ = normal_blocks(views.batches, state)
    normal[1, 5:11] = normal[1, :, 5:11] = 0.0  # a pose that nothing depends on
    assert Minimum(views, state, normal, np.ones(5, bool), True).covariance(180).smallest == 0
    # Without the third view's tilt the focal length and the distance are one unknown.
    state = scene.true_state(views)
    flat = CameraState(state.entries, np.tile(np.eye(3), (3, 1, 1)), np.tile([0.0, 0.0, 5.0], (3, 1)))
    normal, _ = normal_blocks(views.batches, flat)
    assert Minimum(views, state, normal, np.ones(5, bool), True).covariance(180).smallest < 1e-13


@pytest.mark.parametrize(
    ("n_views", "trials", "least"), slow_but((), [(5, 40, 0.55), (5, 400, 0.6), (20, 600, 0.8)])
)
def test_the_std_is_the_spread_over_many_noises(n_views: int, trials: int, least: float) -> None:
    """Never less, and more by what it costs to count views: the variance between five of them is rough."""
    rng = np.random.default_rng(0)
    scene = random_flat_set(np.random.default_rng(3), n_views, True, cols=9, rows=6)
    results = [pinhole(noisy(scene, "suu,suv,svv", rng)) for _ in range(trials)]
    values = np.array([parameters(cal) for cal in results])
    std = np.array([reported(cal) for cal in results])
    # The noise of each result is drawn anew with its covariances, which all have one distribution;
    # n draws know a standard deviation to 1 / sqrt(2 n), the largest of 35 to 4 times that.
    ratio = values.std(axis=0) / np.sqrt((std**2).mean(axis=0))
    assert least < ratio.min() <= ratio.max() < 1 + 4 / np.sqrt(2 * trials)

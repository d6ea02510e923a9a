"""`calibrate`: the same camera whatever the order, the frame and the units, and the true minimum."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from support.noise import noisy, whitener
from support.plain_projection import project
from support.scenes import FEWEST, Scene, pinhole, random_flat_set, random_solid, table_1
from support.slow_cases import slow_but

from neurocal_cli import Correspondences, Intrinsics, Pose
from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.calibration.calibration import Calibration
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import INTRINSIC_NAMES
from neurocal_cli.camera.projection import ENTRIES

CAMERA = Intrinsics(800.0, 820.0, 330.0, 250.0)
BOARD = np.array([(30.0 * x, 30.0 * y, 0.0) for y in range(6) for x in range(9)])
FOLDED = np.concatenate([BOARD, BOARD[:, [0, 2, 1]] + [0.0, 0.0, 30.0]])


def tilted(rng: np.random.Generator) -> Pose:
    """A board some 700 units away, tilted by 20 degrees or so to any side."""
    x, y, z = rng.uniform(-0.5, 0.5, 3)
    return Pose.from_euler(x, y, z, np.array([-120.0, -75.0, 700.0]) + 20 * rng.normal(size=3))


def several(worlds: list[Array], sigma: float, seed: int = 0, K: Intrinsics = CAMERA) -> Scene:
    """Each world seen from a pose of its own, with noise in the pixels."""
    rng = np.random.default_rng(seed)
    poses = {f"v{k}": tilted(rng) for k in range(len(worlds))}
    pixels = [project(K.A, pose, world)[0] for pose, world in zip(poses.values(), worlds, strict=True)]
    view = [name for name, world in zip(poses, worlds, strict=True) for _ in world]
    clean = np.concatenate(pixels)
    return Scene(
        np.concatenate(worlds), clean + sigma * rng.normal(size=clean.shape), view, K, poses, (640, 480)
    )


def scipy_minimum(
    scene: Scene, points: Correspondences, type: int, skew: bool
) -> tuple[Array, dict[str, Array], float]:
    """A's entries, each view's R and the whitened cost, by SciPy from the truth in pixels and world units."""
    U = whitener(points)
    f = np.flatnonzero(
        {1: [1, skew, 1, 1, 1], 2: [1, skew, 1, 0, 0], 3: [0] * 5, 4: [1, skew, 1, 1, 1]}[type]
    )
    names, start = points.view_names, scene.intrinsics.A[ENTRIES]
    centres = np.array([points.world[points.view_index == k].mean(axis=0) for k in range(len(names))])

    def model(p: Array) -> tuple[Array, dict[str, Array], Array]:
        entries = start.copy()
        entries[f] += p[: len(f)]
        pixels, rotations = np.empty_like(points.pixels), {}
        for k, name in enumerate(names):
            pose, mine = scene.poses[name], points.view_index == k
            omega, tau = (np.zeros(3), np.zeros(3)) if type == 4 else p[len(f) + 6 * k :][:6].reshape(2, 3)
            R = Rotation.from_rotvec(omega).as_matrix() @ pose.R
            # Turned about its middle, the target does not fly away.
            t = pose.R @ centres[k] + pose.t + tau
            Xc = (points.world[mine] - centres[k]) @ R.T + t
            S = Xc @ intrinsic_matrix(entries).T
            pixels[mine], rotations[name] = S[:, :2] / S[:, 2:], R
        return entries, rotations, pixels

    def residuals(p: Array) -> Array:
        return np.asarray((U @ (points.pixels - model(p)[2])[..., None]).reshape(-1))

    n = len(f) + (0 if type == 4 else 6 * len(names))
    fit = least_squares(
        residuals, np.zeros(n), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, jac="3-point"
    )
    entries, rotations, _ = model(fit.x)
    return entries, rotations, 2 * float(fit.cost)


def whitened_cost(cal: Calibration) -> float:
    U, total = whitener(cal.points), 0.0
    for k, view in enumerate(cal.views.values()):
        mine = cal.points.view_index == k
        r = cal.points.pixels[mine] - project(cal.K, view.pose, cal.points.world[mine])[0]
        total += float(((U[mine] @ r[..., None]) ** 2).sum())
    return total


def assert_minimum(scene: Scene, points: Correspondences, type: int, skew: bool) -> None:
    cal = pinhole(points, skew=skew, **scene.given(type))
    entries, rotations, cost = scipy_minimum(scene, points, type, skew)
    assert cal.converged
    assert whitened_cost(cal) == pytest.approx(cost, rel=1e-8)
    # A step is the last when it gains 1e-9 of E, so within 1e-3 of the standard deviation, by far.
    std = np.array([cal.std[name] for name in INTRINSIC_NAMES])
    found = cal.intrinsics.values()
    assert (
        np.abs(found - Intrinsics.from_matrix(intrinsic_matrix(entries)).values())
        <= 1e-3 * std + 1e-9 * found
    ).all()
    for name, R in rotations.items():
        assert np.abs(cal.rotations[name] - R).max() < 1e-6


@pytest.mark.parametrize(
    ("weights", "skew"),
    slow_but(
        [("suu,suv,svv", True)],
        itertools.product(("none", "sigma", "suu,suv,svv"), (True, False)),
    ),
)
@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_a_solid_target_ends_where_scipy_does_from_the_truth(type: int, skew: bool, weights: str) -> None:
    rng = np.random.default_rng(10 * type + skew)
    scene = random_solid(np.random.default_rng(5), 1, skew)
    assert_minimum(scene, noisy(scene, weights, rng), type, skew)


@pytest.mark.parametrize(
    ("weights", "skew"),
    slow_but([("suu,suv,svv", True)], itertools.product(("none", "suu,suv,svv"), (True, False))),
)
@pytest.mark.parametrize("type", slow_but((1, 4), [1, 2, 3, 4]))
def test_flat_boards_end_where_scipy_does_from_the_truth(type: int, skew: bool, weights: str) -> None:
    rng = np.random.default_rng(10 * type + skew)
    scene = random_flat_set(np.random.default_rng(3), 4, skew, cols=6, rows=5)
    assert_minimum(scene, noisy(scene, weights, rng), type, skew)


def assert_same(one: Calibration, two: Calibration, relative: float = 1e-9) -> None:
    """The same camera and poses, to `relative` and to a millionth of the standard deviations."""
    for name in INTRINSIC_NAMES:
        a, b = getattr(one.intrinsics, name), getattr(two.intrinsics, name)
        assert abs(a - b) <= relative * abs(a) + 1e-5 * one.std[name], name
    assert two.rmse_px == pytest.approx(one.rmse_px, rel=1e-9)
    assert two.std["alpha_u"] == pytest.approx(one.std["alpha_u"], rel=1e-5)
    for name in one.views:
        assert np.abs(one.rotations[name] - two.rotations[name]).max() < 1e-7
        np.testing.assert_allclose(two.translations[name], one.translations[name], rtol=1e-6, atol=1e-4)


SOLID = table_1().points(0.3, np.random.default_rng(0))
FLAT = random_flat_set(np.random.default_rng(2), 6, False, cols=7, rows=5).points(
    0.3, np.random.default_rng(0)
)
BOTH = pytest.mark.parametrize("points", [SOLID, FLAT], ids=["solid", "flat"])
plainly = cache(pinhole)  # what the other calibrations of the same points are compared with


@BOTH
def test_the_order_of_the_rows_and_of_the_views_does_not_matter(points: Correspondences) -> None:
    plain = plainly(points)
    for seed in range(3):
        mixed = points.select(np.random.default_rng(seed).permutation(len(points)))
        assert_same(plain, pinhole(mixed))


@BOTH
def test_each_seed_gives_the_same_camera_and_one_seed_the_same_bytes(points: Correspondences) -> None:
    plain, again = plainly(points), pinhole(points)
    assert plain.intrinsics == again.intrinsics
    assert plain.std == again.std
    for name in plain.views:
        assert plain.rotations[name].tobytes() == again.rotations[name].tobytes()
        assert plain.translations[name].tobytes() == again.translations[name].tobytes()
    assert plain.network is not None
    assert again.network is not None
    assert plain.network.curve == again.network.curve
    for seed in range(1, 4):
        assert_same(plain, pinhole(points, seed=seed))


@BOTH
def test_a_world_turned_moved_and_in_other_units_gives_the_same_camera(points: Correspondences) -> None:
    plain = plainly(points)
    R, c = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix(), np.array([300.0, -500.0, 40.0])
    for unit in (1e-3, 1.0, 1e6):
        cal = pinhole(replace(points, world=unit * (points.world @ R.T + c)))
        moved = {name: plain.rotations[name] @ R.T for name in plain.views}
        for name in INTRINSIC_NAMES:
            a, b = getattr(plain.intrinsics, name), getattr(cal.intrinsics, name)
            assert abs(a - b) <= 1e-9 * abs(a) + 1e-5 * plain.std[name]
        for name, view in cal.views.items():
            assert np.abs(view.pose.R - moved[name]).max() < 1e-7
            expected = unit * (plain.translations[name] - moved[name] @ c)
            np.testing.assert_allclose(view.pose.t, expected, rtol=1e-6)
        assert cal.rmse_px == pytest.approx(plain.rmse_px, rel=1e-9)


@BOTH
def test_pixels_moved_and_scaled_move_and_scale_the_camera(points: Correspondences) -> None:
    plain = plainly(points)
    s, move = 3.7, np.array([1000.0, -250.0])
    cal = pinhole(replace(points, pixels=s * points.pixels + move))
    expected = plain.intrinsics.values() * [s, s, s, s, 1.0] + [0.0, 0.0, *move, 0.0]
    std = np.array([plain.std[name] for name in INTRINSIC_NAMES]) * [s, s, s, s, 1.0]
    assert (np.abs(cal.intrinsics.values() - expected) <= 1e-9 * np.abs(expected) + 1e-5 * std).all()
    assert cal.rmse_px == pytest.approx(s * plain.rmse_px, rel=1e-9)
    for name in plain.views:
        assert np.abs(cal.rotations[name] - plain.rotations[name]).max() < 1e-7


@BOTH
def test_rows_given_twice_do_not_move_the_camera(points: Correspondences) -> None:
    plain = plainly(points)
    twice = pinhole(points.select(np.repeat(np.arange(len(points)), 2)))
    for name in INTRINSIC_NAMES:
        a, b = getattr(plain.intrinsics, name), getattr(twice.intrinsics, name)
        assert abs(a - b) <= 1e-9 * abs(a) + 1e-5 * plain.std[name]
    assert twice.rmse_px == pytest.approx(plain.rmse_px, rel=1e-9)


@BOTH
def test_a_row_of_twice_the_weight_is_a_row_given_twice(points: Correspondences) -> None:
    heavy = np.arange(len(points)) % 3 == 0
    variance = np.where(heavy, 0.5, 1.0)
    weighted = replace(points, covariance=np.column_stack([variance, 0 * variance, variance]))
    doubled = points.select(np.sort(np.concatenate([np.arange(len(points)), np.flatnonzero(heavy)])))
    one, two = pinhole(weighted), pinhole(doubled)
    for name in INTRINSIC_NAMES:
        a, b = getattr(one.intrinsics, name), getattr(two.intrinsics, name)
        assert abs(a - b) <= 1e-9 * abs(a) + 1e-5 * one.std[name]


@BOTH
def test_only_ratios_of_the_noise_matter(points: Correspondences) -> None:
    rng = np.random.default_rng(0)
    s = rng.uniform(0.1, 2.0, (len(points), 2))
    covariance = np.column_stack([s[:, 0] ** 2, 0.3 * s[:, 0] * s[:, 1], s[:, 1] ** 2])
    points = replace(points, pixels=points.pixels + s * rng.normal(size=s.shape))  # as stated, nearly
    one = pinhole(replace(points, covariance=covariance))
    for factor in (7.0, 1e-6, 1e6):
        assert_same(one, pinhole(replace(points, covariance=factor**2 * covariance)))
    assert abs(one.intrinsics.alpha_u - pinhole(points).intrinsics.alpha_u) > 1e-3


def test_equal_weights_are_no_weights() -> None:
    for points in (SOLID, FLAT):
        weighted = replace(points, covariance=np.tile([0.09, 0.0, 0.09], (len(points), 1)))
        assert_same(plainly(points), pinhole(weighted))


def close(cal: Calibration, scene: Scene, types_std: float = 6.0) -> None:
    """The truth within some standard deviations, and not far in itself."""
    for name in INTRINSIC_NAMES:
        error = abs(getattr(cal.intrinsics, name) - getattr(scene.intrinsics, name))
        assert error <= types_std * cal.std[name] + 1e-9, name
    assert cal.std["alpha_u"] < 0.1 * cal.intrinsics.alpha_u
    assert cal.converged
    for name, pose in scene.poses.items():
        assert np.abs(cal.rotations[name] - pose.R).max() < 0.05


@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_one_heavy_view_among_small_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    many = np.column_stack([rng.uniform(0, 240, 20_000), rng.uniform(0, 150, 20_000), np.zeros(20_000)])
    scene = several([BOARD[:12], many, BOARD[20:30], BOARD, BOARD[5:25], BOARD[30:]], 0.2, seed)
    close(pinhole(scene.points(), seed=seed), scene)


@pytest.mark.parametrize("skew", [True, False])
@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_views_of_all_sizes(seed: int, skew: bool) -> None:
    rng = np.random.default_rng(seed)
    sizes = [4, 5, 54, 9, 30, 6, 17, 54, 4]
    scene = several([BOARD[np.sort(rng.permutation(54)[:n])] for n in sizes], 0.1, seed)
    close(pinhole(scene.points(), skew=skew, seed=seed), scene)


@pytest.mark.parametrize("seed", slow_but((0, 5), range(12)))
def test_a_view_whose_product_is_noise_does_not_spoil_the_camera(seed: int) -> None:
    # Three of four points are nearly on a line: noise decides which product they have.
    true = BOARD[[0, 1, 2, 11]] - [[0, 0, 0], [0, 0.1, 0], [0, 0, 0], [0, 0, 0]]
    scene = several([*[BOARD] * 6, true], 0.1, seed)
    given = scene.world.copy()
    given[-3, 1] += 0.2
    cal = pinhole(replace(scene, world=given).points(), skew=False, seed=seed)
    assert cal.converged
    for name in INTRINSIC_NAMES:
        error = abs(getattr(cal.intrinsics, name) - getattr(scene.intrinsics, name))
        assert error <= 6 * cal.std[name] + 1e-9, name


@pytest.mark.parametrize("type", [1, 2])
@pytest.mark.parametrize("seed", slow_but((0,), range(3)))
def test_flat_and_folded_views_together(seed: int, type: int) -> None:
    scene = several([BOARD, FOLDED, BOARD, FOLDED[::3]], 0.2, seed)
    close(pinhole(scene.points(), seed=seed, **scene.given(type)), scene)


@pytest.mark.parametrize("bow", slow_but((0.5, 6.0), [1e-5, 1e-3, 0.5, 2.0, 6.0]))
@pytest.mark.parametrize("type", slow_but((1,), [1, 2, 3]))
def test_boards_that_are_nearly_flat(bow: float, type: int) -> None:
    bowed = BOARD.copy()
    bowed[:, 2] = bow * (((BOARD[:, 0] - 120) / 120) ** 2 + 0.5 * ((BOARD[:, 1] - 75) / 75) ** 2)
    scene = several([bowed] * 5, 0.05)
    cal = pinhole(scene.points(), **scene.given(type))
    close(cal, scene)
    # Every coordinate counts in the end: the fit is as good as the noise.
    assert cal.rmse_px < 0.05 * 1.5 * np.sqrt(2)


@pytest.mark.parametrize("few", [4, 5])
@pytest.mark.parametrize("seed", slow_but((0,), range(4)))
def test_views_with_too_few_points_of_their_own_are_helped_by_others(few: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    corner = FOLDED[rng.permutation(len(FOLDED))[:few]]
    scene = several([FOLDED, corner, FOLDED[::2]], 0.05, seed)
    close(pinhole(scene.points(), seed=seed), scene)


def spread_out(rng: np.random.Generator, n: int, flat: bool) -> Array:
    """n points of which no four of a flat target are nearly on a line and no solid ones in a plane."""
    while True:
        world = rng.uniform(-100, 100, (n, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
        sizes = np.linalg.svd(world - world.mean(axis=0))[1]
        if sizes[1] > 0.5 * sizes[0] and (flat or sizes[2] > 0.3 * sizes[0]):
            return np.asarray(world + np.array([120.0, 75.0, 0.0]))


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 20), marks=pytest.mark.slow)])
@pytest.mark.parametrize("flat", [True, False], ids=["flat", "solid"])
def test_a_pose_from_four_points(flat: bool, seeds: range) -> None:
    for seed in seeds:
        world = spread_out(np.random.default_rng(seed), 4, flat)
        scene = several([world], 0.0, seed)
        cal = pinhole(scene.points(), seed=seed, **scene.given(3))
        # Four points in space may be seen alike from two places; then both fit to rounding.
        assert cal.rmse_px < 1e-6
        if flat:
            np.testing.assert_allclose(cal.rotations["v0"], scene.poses["v0"].R, atol=1e-6)


@pytest.mark.parametrize("type", [2, 3])
@pytest.mark.parametrize("skew", slow_but((True,), [True, False]))
def test_all_points_but_one_in_a_plane(type: int, skew: bool) -> None:
    world = np.concatenate([BOARD, [[100.0, 90.0, -150.0]]])
    for seed in range(3):
        scene = several([world], 0.0, seed)
        cal = pinhole(scene.points(), skew=skew, seed=seed, **scene.given(type))
        np.testing.assert_allclose(cal.K, CAMERA.A, rtol=1e-6, atol=1e-4)
        np.testing.assert_allclose(cal.rotations["v0"], scene.poses["v0"].R, atol=1e-7)


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 5), marks=pytest.mark.slow)])
def test_the_fewest_points_fit_to_rounding(seeds: range) -> None:
    for kind, n in FEWEST.items():
        for seed in seeds:
            rng = np.random.default_rng(seed)
            scene = several([spread_out(rng, n, flat=n == 3)], 0.0, seed)
            cal = pinhole(scene.points(), skew=False, seed=seed, **scene.given(kind))
            assert cal.rmse_px < 1e-5, (kind, seed)


@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_without_noise_every_parameter_is_exact(type: int) -> None:
    for scene in (table_1(), several([BOARD] * 4, 0.0), several([FOLDED, BOARD], 0.0)):
        cal = pinhole(scene.points(), **scene.given(type))
        np.testing.assert_allclose(cal.intrinsics.values(), scene.intrinsics.values(), rtol=1e-7)
        for name, pose in scene.poses.items():
            np.testing.assert_allclose(cal.rotations[name], pose.R, atol=1e-8)
            np.testing.assert_allclose(cal.translations[name], pose.t, rtol=1e-6, atol=1e-5)


def test_labels_may_be_anything_that_sorts() -> None:
    scene = several([BOARD] * 3, 0.1)
    by_name = pinhole(scene.points(), skew=False)
    numbers = replace(scene.points(), view=np.repeat([30, 10, 20], 54))
    by_number = pinhole(numbers, skew=False)
    assert list(by_number.views) == ["30", "10", "20"]
    assert by_number.intrinsics == by_name.intrinsics


def test_progress_is_told_in_order_and_changes_nothing() -> None:
    told: list[tuple[str, float]] = []
    cal = pinhole(SOLID, progress=lambda stage, share: told.append((stage, share)))
    assert told[0] == ("training the networks", 0.0)
    assert told[-1] == ("refining", 1.0)
    assert all(0 <= share <= 1 for _, share in told)
    assert cal.intrinsics == plainly(SOLID).intrinsics


def test_the_record_of_the_network_is_the_camera() -> None:
    for points in (SOLID, FLAT):
        cal = plainly(points)
        net = cal.network
        assert net is not None
        np.testing.assert_allclose(net.S1 @ net.W, cal.K, rtol=1e-12, atol=1e-10)
        for name, P in cal.projections.items():
            product = net.S1 @ net.W @ net.V[name] @ net.S2[name]  # eq. (12)
            np.testing.assert_allclose(product / product[2, 2] * P[2, 2], P, rtol=1e-9, atol=1e-7)
        assert net.rmse_after == cal.rmse_px <= net.rmse_before


def test_the_network_s_errors_in_pixels_are_of_every_point_whatever_it_weighs() -> None:
    pixels, covariance = SOLID.pixels.copy(), np.tile([0.04, 0.0, 0.04], (len(SOLID), 1))
    pixels[7] += 20.0
    covariance[7] = [1e6, 0.0, 1e6]
    net = pinhole(replace(SOLID, pixels=pixels, covariance=covariance)).network
    assert net is not None
    assert net.rmse_before > 20.0 / np.sqrt(len(SOLID))
    assert net.rmse_after > 20.0 / np.sqrt(len(SOLID))


def test_errors_are_those_of_the_points() -> None:
    cal = plainly(FLAT)
    squared = []
    for k, (name, view) in enumerate(cal.views.items()):
        mine = FLAT.view_index == k
        error = project(cal.K, view.pose, FLAT.world[mine])[0] - FLAT.pixels[mine]
        squared.append((error**2).sum(axis=1))
        assert view.rmse_px == pytest.approx(np.sqrt(squared[-1].mean())), name
        assert view.n_points == mine.sum()
    assert cal.rmse_px == pytest.approx(np.sqrt(np.concatenate(squared).mean()))
    assert cal.max_px == pytest.approx(np.sqrt(np.concatenate(squared).max()))


@pytest.mark.parametrize("kind", ["solid", "flat"])
@pytest.mark.slow
def test_every_seed_of_many_scenes_gives_one_camera(kind: str) -> None:
    for n in range(40):
        rng = np.random.default_rng(n)
        scene: Any = random_solid(rng, 2, False) if kind == "solid" else random_flat_set(rng, 5, False)
        if len(scene.view) < 12:
            continue
        points = scene.points(0.1, rng)
        cals = [pinhole(points, skew=False, seed=seed, **scene.given(2)) for seed in range(5)]
        for cal in cals[1:]:
            assert_same(cals[0], cal)

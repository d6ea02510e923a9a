"""Triangulation: the least-squares point, its covariance, and OpenCV's beside it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rigs import KINDS, RigScene, random_rig
from support.slow_cases import slow_but

from neurocal_cli import Pose, calibrate_stereo, triangulate
from neurocal_cli.calibration.rig.triangulation import METHODS, Triangulated, epipolar_limit
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.errors import InputError, UsageError

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def scattered(scene: RigScene, n: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Points around the targets and their pixels."""
    middle = np.mean([pose.R @ scene.world.mean(axis=0) + pose.t for pose in scene.poses.values()], axis=0)
    X = middle + rng.uniform(-1, 1, (n, 3)) * 0.25 * middle[2]
    return X, scene.see(0, X), scene.see(1, X @ scene.rig.R.T + scene.rig.t)


def through(scene: RigScene, left: Array, right: Array, method: str = "optimal") -> Triangulated:
    return triangulate(scene.camera(0), scene.camera(1), scene.rig, left, right, method=method)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lens", ["none", "k1k2"])
@pytest.mark.parametrize("method", METHODS)
def test_without_noise_points_are_exact(method: str, lens: str, kind: str) -> None:
    rng = np.random.default_rng(1)
    scene = random_rig(rng, kind, 3, lens)
    X, left, right = scattered(scene, 200, rng)
    found = through(scene, left, right, method)
    assert found.points == pytest.approx(X, abs=1e-6)
    assert found.epipolar.max() < 1e-8
    assert not found.behind.any()


def test_a_rig_stands_for_its_cameras_and_their_pose() -> None:
    from support.places import SAMPLES

    from neurocal_cli import Rig, calibrate_stereo, read_points

    left, right = (read_points(SAMPLES / f"stereo_{side}.csv") for side in ("left", "right"))
    rig: Rig = calibrate_stereo(left, right, skew=False, distortion="none", target="given")
    noise = rig.noise_shares
    parts = triangulate(rig.left, rig.right, rig.pose, left.pixels, right.pixels, noise=noise)
    whole = triangulate(rig, left.pixels, right.pixels)
    np.testing.assert_array_equal(whole.points, parts.points)
    found = whole.space_covariance(rig.sigma)
    assert whole.covariance is not None
    assert found.shape == (len(left), 3, 3)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    for k, (i, j) in enumerate(PAIRS):
        np.testing.assert_allclose(found[:, i, j], rig.sigma**2 * whole.covariance[:, k])
    assert (np.linalg.eigvalsh(found) > 0).all()
    with pytest.raises(InputError, match="only the method optimal gives the covariance"):
        triangulate(rig, left.pixels, right.pixels, method="linear").space_covariance(1.0)


def opencv(scene: RigScene, left: Array, right: Array) -> Array:
    cv2 = pytest.importorskip("cv2")
    P = scene.cameras[0].A @ np.eye(3, 4), scene.cameras[1].A @ scene.rig.D
    X = np.asarray(cv2.triangulatePoints(*P, left.T, right.T))
    return np.asarray((X[:3] / X[3]).T)


def image_errors(scene: RigScene, X: Array, left: Array, right: Array) -> Array:
    du = left - scene.see(0, X)
    dv = right - scene.see(1, X @ scene.rig.R.T + scene.rig.t)
    return np.asarray((du**2).sum(axis=1) + (dv**2).sum(axis=1))


@pytest.mark.parametrize("seed", slow_but(range(4), range(20)))
def test_opencv_gives_the_same_without_noise_and_never_better_with_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_rig(rng, KINDS[seed % len(KINDS)], 3)
    X, left, right = scattered(scene, 2000, rng)
    assert through(scene, left, right).points == pytest.approx(opencv(scene, left, right), rel=1e-6, abs=1e-6)
    for sigma in (0.1, 1.0) if KINDS[seed % len(KINDS)] == "narrow" else (0.1, 1.0, 5.0):
        noisy = left + sigma * rng.normal(size=left.shape), right + sigma * rng.normal(size=right.shape)
        ours, theirs = through(scene, *noisy), opencv(scene, *noisy)
        assert not ours.behind.any()
        assert (ours.epipolar**2 <= image_errors(scene, theirs, *noisy) * (1 + 1e-9)).all()
        rms = [np.sqrt(((found - X) ** 2).sum(axis=1).mean()) for found in (ours.points, theirs)]
        assert rms[0] < rms[1] * 1.002


@pytest.mark.parametrize("lens", ["none", "k1k2", "fisheye"])
@pytest.mark.parametrize("ratio", slow_but((0.2,), [1.0, 0.2]))
def test_the_point_is_the_minimum_of_the_pixel_error_over_the_noise(lens: str, ratio: float) -> None:
    from dataclasses import replace

    from scipy.optimize import least_squares

    rng = np.random.default_rng(5)
    scene = random_rig(rng, "verging", 3, lens)
    if lens == "fisheye":
        scene = replace(scene, lenses=(Distortion("fisheye", np.array([0.02, -0.01, 0.0, 0.0])),) * 2)
    X, left, right = scattered(scene, 12, rng)
    left, right = left + rng.normal(size=left.shape), right + rng.normal(size=right.shape)
    noise = 2.0 * ratio, 2.0
    found = triangulate(scene.camera(0), scene.camera(1), scene.rig, left, right, noise=noise)

    def errors(x: Array, n: int) -> Array:
        seen = scene.see(0, x[None])[0], scene.see(1, (x @ scene.rig.R.T + scene.rig.t)[None])[0]
        return np.concatenate([(left[n] - seen[0]) / noise[0], (right[n] - seen[1]) / noise[1]])

    for n in range(12):
        fit = least_squares(errors, X[n], args=(n,), xtol=1e-15, ftol=1e-15, x_scale="jac")
        assert found.points[n] == pytest.approx(fit.x, rel=1e-6, abs=1e-5)
        assert found.epipolar[n] ** 2 == pytest.approx(2 * fit.cost, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_the_covariance_is_that_of_the_errors(kind: str) -> None:
    rng = np.random.default_rng(7)
    scene, sigma, n = random_rig(rng, kind, 3, "k1k2"), 0.1, 20000
    X, left, right = scattered(scene, n, rng)
    found = through(
        scene, left + sigma * rng.normal(size=left.shape), right + sigma * rng.normal(size=right.shape)
    )
    assert found.covariance is not None
    C = np.empty((n, 3, 3))
    for k, (a, b) in enumerate(PAIRS):
        C[:, a, b] = C[:, b, a] = sigma**2 * found.covariance[:, k]
    e = found.points - X
    chi = np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e)
    assert chi.mean() == pytest.approx(3, rel=0.05)
    assert np.sqrt((found.epipolar**2).mean()) == pytest.approx(sigma, rel=0.02)
    assert found.off(epipolar_limit(sigma)).sum() < 3


def test_each_of_two_cameras_counts_by_its_noise() -> None:
    """The covariance is that of the errors, which are smaller than those of a pooled noise."""
    rng, sigma = np.random.default_rng(9), (0.05, 0.5)
    scene = random_rig(rng, "parallel", 12)
    left, right = (scene.points(side, sigma[side], rng) for side in (0, 1))
    rig = calibrate_stereo(left, right, skew=False, distortion="none", target="given")
    assert rig.noise_shares * rig.sigma == pytest.approx(sigma, rel=0.2)
    assert rig.noise_shares == pytest.approx(replace(rig.lean, warnings=()).noise_shares)
    X = np.tile([0.0, 0.0, np.mean([pose.t[2] for pose in scene.poses.values()])], (4000, 1))
    exact = rig.left.camera.project(X)[0], rig.right.camera.project(rig.pose.to_camera(X))[0]
    pixels = [one + rng.normal(0, s, one.shape) for one, s in zip(exact, sigma, strict=True)]
    found, alike = triangulate(rig, *pixels), triangulate(rig.left, rig.right, rig.pose, *pixels)
    assert found.covariance is not None
    squares = [((one.points - X) ** 2).mean(axis=0) for one in (found, alike)]
    stated = rig.sigma**2 * found.covariance[:, [0, 3, 5]].mean(axis=0)
    assert squares[0] == pytest.approx(stated, rel=0.3)
    assert (squares[0] < [1.01, 0.1, 1.01] * squares[1]).all()
    assert np.sqrt((found.epipolar**2).mean()) == pytest.approx(rig.sigma, rel=0.2)
    assert found.off(epipolar_limit(rig.sigma)).mean() < 0.001
    for wrong in (0.3, (1.0, 0.0), (1.0, np.nan), (1.0, 2.0, 3.0)):
        with pytest.raises(InputError, match="noise must be two positive numbers"):
            triangulate(rig.left, rig.right, rig.pose, *pixels, noise=wrong)


def test_each_point_may_have_a_rig_of_its_own() -> None:
    rng = np.random.default_rng(2)
    scene = random_rig(rng, "wide", 3)
    rigs = [
        scene.rig,
        Pose(scene.rig.R, scene.rig.t + np.array([5.0, 0, 0])),
        Pose(scene.rig.R.T, scene.rig.t),
    ]
    X, left, _ = scattered(scene, 300, rng)
    which = rng.integers(0, 3, 300)
    R, t = np.stack([r.R for r in rigs])[which], np.stack([r.t for r in rigs])[which]
    right = scene.see(1, (R @ X[..., None])[..., 0] + t)
    for method in METHODS:
        found = triangulate(scene.camera(0), scene.camera(1), rigs, left, right, which=which, method=method)
        assert found.points == pytest.approx(X, abs=1e-6)


def test_points_behind_a_camera_or_nowhere_are_marked() -> None:
    scene = random_rig(np.random.default_rng(3), "parallel", 3)
    X = np.array([[0.0, 0, 800], [0, 0, -800], [30, 20, -1500]])
    right = X @ scene.rig.R.T + scene.rig.t
    found = through(scene, scene.see(0, X), scene.see(1, right))
    assert found.behind.tolist() == [False, True, True]
    assert found.points == pytest.approx(X, rel=1e-6, abs=1e-6)


def test_a_pixel_that_no_lens_could_have_seen_gives_no_point() -> None:
    from dataclasses import replace

    scene = replace(
        random_rig(np.random.default_rng(3), "parallel", 3),
        lenses=(Distortion("fisheye", np.zeros(4)), Distortion()),
    )
    found = through(scene, np.array([[5000.0, 0.0], [320, 240]]), np.array([[0.0, 0.0], [250, 240]]))
    assert found.behind[0]
    assert np.isnan(found.points[0]).all()
    assert found.off(1e9)[0]
    assert np.isfinite(found.points[1]).all()


@settings(max_examples=30, deadline=None)
@given(st.floats(-3000, 3000), st.floats(-3000, 3000), st.floats(-3000, 3000), st.floats(-3000, 3000))
def test_any_two_pixels_give_an_answer_or_a_mark(a: float, b: float, c: float, d: float) -> None:
    scene = random_rig(np.random.default_rng(4), "verging", 3, "k1k2")
    found = through(scene, np.array([[a, b]]), np.array([[c, d]]))
    assert found.behind[0] or np.isfinite(found.points).all()
    assert found.behind[0] or np.isfinite(found.epipolar).all()


def test_rays_that_are_parallel_end_at_infinity_without_a_fault() -> None:
    scene = random_rig(np.random.default_rng(8), "verging", 3)
    far = np.array([[0.1, 0.05, 1.0]])
    found = through(scene, scene.see(0, far), scene.see(1, far @ scene.rig.R.T))
    assert found.behind[0] or found.points[0, 2] > 1e6


def test_wrong_arguments_are_refused() -> None:
    scene = random_rig(np.random.default_rng(8), "verging", 3)
    two, three = np.zeros((2, 2)), np.zeros((3, 2))
    with pytest.raises(InputError, match="2 left pixels but 3 right ones"):
        through(scene, two, three)
    with pytest.raises(InputError, match="shape"):
        through(scene, np.zeros(4), np.zeros(4))
    with pytest.raises(UsageError, match="method must be one of"):
        through(scene, two, two, "guess")
    with pytest.raises(InputError, match="several rigs"):
        triangulate(scene.camera(0), scene.camera(1), [scene.rig, scene.rig], two, two)
    with pytest.raises(InputError, match="must be a Pose"):
        triangulate(scene.camera(0), scene.camera(1), scene.rig.D, two, two)
    assert len(through(scene, np.zeros((0, 2)), np.zeros((0, 2))).points) == 0

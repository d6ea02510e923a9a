"""Stereo calibration and triangulation beside OpenCV's, same unknowns, in the same run.

Run with ``pytest tests/benchmarks/test_stereo_speed.py -n 0 --benchmark-enable --benchmark-group-by=group``.
"""

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from support.rigs import RigScene, random_rig

from neurocal_cli import Correspondences, calibrate_stereo, triangulate

PAIRS = [13, 200]
MILLION = 1_000_000


def scene(n_views: int, lens: str = "none") -> RigScene:
    return random_rig(np.random.default_rng(5), "verging", n_views, lens)


def seen(n_views: int, lens: str) -> tuple[Correspondences, Correspondences]:
    rng = np.random.default_rng(1)
    made = scene(n_views, lens)
    return made.points(0, 0.2, rng), made.points(1, 0.2, rng)


@pytest.mark.parametrize("lens", ["none", "k1k2"])
@pytest.mark.parametrize("n_views", PAIRS)
def test_neurocal_calibrates_a_rig(benchmark: BenchmarkFixture, n_views: int, lens: str) -> None:
    points = seen(n_views, lens)
    benchmark.group = f"{n_views} pairs of 54 points, lens {lens}"
    rig = benchmark(lambda: calibrate_stereo(*points, skew=False, distortion=lens, target="given"))
    assert rig.converged


@pytest.mark.parametrize("lens", ["none", "k1k2"])
@pytest.mark.parametrize("n_views", PAIRS)
def test_opencv_calibrates_the_same(benchmark: BenchmarkFixture, n_views: int, lens: str) -> None:
    cv2 = pytest.importorskip("cv2")
    cv2.setNumThreads(1)
    points = seen(n_views, lens)
    world = [points[0].world[points[0].view_index == k].astype(np.float32) for k in range(n_views)]
    left, right = ([p.pixels[p.view_index == k].astype(np.float32) for k in range(n_views)] for p in points)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if lens == "none":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2

    def run() -> float:
        start = [
            cv2.calibrateCamera(world, side, points[0].image_size, None, None, flags=flags)[1:3]
            for side in (left, right)
        ]
        return float(
            cv2.stereoCalibrate(
                world, left, right, *start[0], *start[1], points[0].image_size,
                flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
            )[0]
        )  # fmt: skip

    benchmark.group = f"{n_views} pairs of 54 points, lens {lens}"
    rms = benchmark(run)
    assert rms >= calibrate_stereo(*points, skew=False, distortion=lens, target="given").rmse_px * (1 - 1e-3)


def pixels(lens: str) -> tuple[RigScene, np.ndarray, np.ndarray]:
    made, rng = scene(3, lens), np.random.default_rng(2)
    X = rng.uniform(-1, 1, (MILLION, 3)) * [60, 40, 150] + [0, 0, 650]
    left, right = made.see(0, X), made.see(1, X @ made.rig.R.T + made.rig.t)
    return made, *(m + 0.2 * rng.normal(size=m.shape) for m in (left, right))


@pytest.mark.benchmark(group="a million points")
@pytest.mark.parametrize("lens", ["none", "k1k2"])
def test_neurocal_triangulates(benchmark: BenchmarkFixture, lens: str) -> None:
    made, left, right = pixels(lens)
    found = benchmark.pedantic(
        lambda: triangulate(made.camera(0), made.camera(1), made.rig, left, right), rounds=3
    )
    assert not found.behind.any()


@pytest.mark.benchmark(group="a million points")
def test_opencv_triangulates(benchmark: BenchmarkFixture) -> None:
    cv2 = pytest.importorskip("cv2")
    made, left, right = pixels("none")
    P = made.cameras[0].A @ np.eye(3, 4), made.cameras[1].A @ made.rig.D
    benchmark.pedantic(lambda: cv2.triangulatePoints(*P, left.T, right.T), rounds=3)

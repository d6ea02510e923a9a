"""Rigs of many cameras: the time grows with the number of views.

Run with ``pytest tests/benchmarks/test_rig_speed.py -n 0 --benchmark-enable --benchmark-group-by=group``.
"""

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from neurocal_cli import calibrate_rig, triangulate_many
from neurocal_cli.simulation.rigs import random_rig

SIZES = [(3, 50), (8, 200), (8, 500), (32, 500)]


@pytest.mark.parametrize(("cameras", "frames"), SIZES)
def test_a_ring_is_calibrated_from_random_weights(
    benchmark: BenchmarkFixture, cameras: int, frames: int
) -> None:
    rng = np.random.default_rng(1)
    rig = random_rig("ring" if cameras > 3 else "line", cameras, frames, rng)
    points = rig.points(0.3, rng)
    views = sum(one.n_views for one in points.values())
    benchmark.group = f"{cameras} cameras, {frames} frames, {views} views"
    found = benchmark.pedantic(lambda: calibrate_rig(points, skew=False), rounds=1)
    assert found.converged


def test_a_large_board_is_seen_by_eight_cameras(benchmark: BenchmarkFixture) -> None:
    rng = np.random.default_rng(2)
    rig = random_rig("line", 8, 200, rng, columns=9, rows=6, square=50.0)
    points = rig.points(0.3, rng)
    benchmark.group = f"8 cameras in a line, 200 frames of 54 points, {sum(map(len, points.values()))} points"
    assert benchmark.pedantic(lambda: calibrate_rig(points, skew=False), rounds=1).converged


def test_a_hundred_thousand_points_in_eight_cameras(benchmark: BenchmarkFixture) -> None:
    rng = np.random.default_rng(3)
    rig = random_rig("line", 8, 4, rng)
    points = np.array([0.0, 0.0, 2500.0]) + rng.uniform(-300, 300, (100_000, 3))
    seen = [camera.project(rig.relative[name].to_camera(points))[0] for name, camera in rig.cameras.items()]
    pixels = np.concatenate(seen) + 0.3 * rng.normal(size=(800_000, 2))
    names = np.repeat(list(rig.cameras), len(points))
    number = np.tile(np.arange(len(points)), 8)
    found = benchmark.pedantic(
        lambda: triangulate_many(rig.cameras, number, names, pixels, rig.relative), rounds=1
    )
    assert np.linalg.norm(found.points - points, axis=1).max() < 50

"""Speed, beside OpenCV in the same run; nothing is asserted about time.

Run with ``pytest tests/benchmarks -n 0 --benchmark-enable --benchmark-group-by=param:n_views``.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from pytest_benchmark.fixture import BenchmarkFixture
from support.distorted import through
from support.made_calibration import made_calibration
from support.plain_projection import project
from support.scenes import random_flat_set, table_1
from support.targets import COLS, photographed

from neurocal_cli import Correspondences, calibrate, read_points, write_points
from neurocal_cli.files.calibration_yaml import format_calibration

VIEWS = [13, 100, 1000]
GIVEN = ["--distortion", "plumb_bob", "--outliers", "keep", "--target", "given"]


PLAIN = {"distortion": "none", "outliers": "keep", "target": "given"}
PLUMB_BOB = [-0.2, 0.05, 0.001, -0.001, 0.02]


def flat_points(n_views: int, model: str) -> Correspondences:
    scene = random_flat_set(np.random.default_rng(5), n_views, False, cols=9, rows=6, f=1500)
    if model != "none":
        scene = through(scene, model, PLUMB_BOB)
    return scene.points(0.3, np.random.default_rng(1))


@pytest.mark.benchmark(group="flat views of 54 points")
@pytest.mark.parametrize(
    ("n_views", "model"), [*((n, "none") for n in (*VIEWS, 3000)), *((n, "plumb_bob") for n in VIEWS)]
)
def test_neurocal_on_flat_views(benchmark: BenchmarkFixture, n_views: int, model: str) -> None:
    points = flat_points(n_views, model)
    calibration = benchmark(
        lambda: calibrate(points, skew=False, distortion=model, outliers="keep", target="given")
    )
    assert calibration.converged


@pytest.mark.benchmark(group="flat views of 54 points")
@pytest.mark.parametrize(("n_views", "model"), [(n, model) for model in ("none", "plumb_bob") for n in VIEWS])
def test_neurocal_with_the_target_looked_for(benchmark: BenchmarkFixture, n_views: int, model: str) -> None:
    points = flat_points(n_views, model)
    assert benchmark(lambda: calibrate(points, skew=False, distortion=model, outliers="keep")).converged


@pytest.mark.benchmark(group="flat views of 54 points")
@pytest.mark.parametrize(("n_views", "model"), [(n, "plumb_bob") for n in VIEWS[:2]])
def test_neurocal_with_all_its_defaults(benchmark: BenchmarkFixture, n_views: int, model: str) -> None:
    points = flat_points(n_views, model)
    assert benchmark(lambda: calibrate(points, skew=False)).converged


@pytest.mark.benchmark(group="flat views of 54 points")
@pytest.mark.parametrize(("n_views", "model"), [(n, model) for model in ("none", "plumb_bob") for n in VIEWS])
def test_opencv_on_the_same_views(benchmark: BenchmarkFixture, n_views: int, model: str) -> None:
    cv2 = pytest.importorskip("cv2")
    cv2.setNumThreads(1)
    points = flat_points(n_views, model)
    views = range(points.n_views)
    world = [points.world[points.view_index == k].astype(np.float32) for k in views]
    pixels = [points.pixels[points.view_index == k].astype(np.float32) for k in views]
    # Without skew and, for a pinhole, without distortion: the same unknowns.
    pinhole = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    flags = pinhole if model == "none" else 0
    result = benchmark(lambda: cv2.calibrateCamera(world, pixels, points.image_size, None, None, flags=flags))
    same = calibrate(points, skew=False, distortion=model, outliers="keep", target="given")
    assert result[0] == pytest.approx(same.rmse_px, rel=1e-3)


BOARDS = [("flat", 0.0), ("parabola", 0.3), ("stretch", 0.0), ("both", 0.3), ("flexing", 0.3)]


@pytest.mark.benchmark(group="views of 63 points of boards that are not as their file says")
@pytest.mark.parametrize("target", ["given", "auto"])
@pytest.mark.parametrize(("kind", "amount"), BOARDS)
@pytest.mark.parametrize("n_views", VIEWS)
def test_neurocal_on_a_board(
    benchmark: BenchmarkFixture, n_views: int, kind: str, amount: float, target: str
) -> None:
    points, _ = photographed(kind, 3, n_views, amount)
    assert benchmark(lambda: calibrate(points, distortion="k1k2", target=target)).converged


@pytest.mark.benchmark(group="views of 63 points of boards that are not as their file says")
@pytest.mark.parametrize(("kind", "amount"), BOARDS)
@pytest.mark.parametrize("n_views", VIEWS)
def test_opencv_with_free_points_on_a_board(
    benchmark: BenchmarkFixture, n_views: int, kind: str, amount: float
) -> None:
    cv2 = pytest.importorskip("cv2")
    cv2.setNumThreads(1)
    points, _ = photographed(kind, 3, n_views, amount)
    world = list(points.world.reshape(n_views, -1, 3).astype(np.float32))
    pixels = list(points.pixels.reshape(n_views, -1, 2).astype(np.float32))
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    found = benchmark.pedantic(
        lambda: cv2.calibrateCameraRO(world, pixels, points.image_size, COLS - 1, None, None, flags=flags)
    )
    assert found[0] < 0.5


@pytest.mark.benchmark(group="one view")
@pytest.mark.parametrize("type", [1, 2, 3, 4])
def test_one_view_of_440_points(benchmark: BenchmarkFixture, type: int) -> None:
    scene = table_1()
    points = scene.points(0.3, np.random.default_rng(1))
    assert benchmark(lambda: calibrate(points, **PLAIN, **scene.given(type))).converged


def million_points() -> Correspondences:
    scene, rng = table_1(), np.random.default_rng(2)
    world = rng.uniform(-90, 90, (1_000_000, 3))
    pixels, _ = project(scene.intrinsics.A, scene.poses["view"], world)
    return Correspondences(world, pixels + 0.3 * rng.normal(size=pixels.shape))


@pytest.mark.benchmark(group="one view")
def test_one_view_of_a_million_points(benchmark: BenchmarkFixture) -> None:
    points = million_points()
    assert benchmark.pedantic(lambda: calibrate(points, **PLAIN), rounds=3).converged


@pytest.mark.benchmark(group="reading")
def test_reading_a_million_rows(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    points = million_points()
    rows = np.column_stack([points.world, points.pixels])
    file = tmp_path / "million.csv"
    file.write_text("X,Y,Z,u,v\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n")
    assert len(benchmark.pedantic(lambda: read_points(str(file)), rounds=3)) == 1_000_000


@pytest.mark.benchmark(group="whole commands")
@pytest.mark.parametrize(
    "command",
    [
        ["-c", "import click, rich"],
        ["-m", "neurocal_cli", "--help"],
        ["-c", "import numpy, yaml, click"],
        ["-m", "neurocal_cli", "calibrate", "sample_data/points.csv", "-o", "{tmp}/camera.yaml"],
    ],
    ids=["import click, rich", "neurocal --help", "import numpy, yaml, click", "calibrate 440 points"],
)
def test_a_whole_process(benchmark: BenchmarkFixture, tmp_path: Path, command: list[str]) -> None:
    root = Path(__file__).resolve().parents[2]
    full = [sys.executable, *(part.replace("{tmp}", str(tmp_path)) for part in command)]
    benchmark.pedantic(
        lambda: subprocess.run(full, cwd=root, check=True, capture_output=True), rounds=10, warmup_rounds=2
    )


@pytest.mark.benchmark(group="whole commands on flat views")
@pytest.mark.parametrize("n_views", VIEWS)
@pytest.mark.parametrize(
    "command",
    [
        ["-m", "neurocal_cli", "calibrate", "{points}", "--no-skew", *GIVEN, "-o", "{tmp}/camera.yaml"],
        ["-m", "neurocal_cli", "calibrate", "{points}", "-o", "{tmp}/camera.yaml"],
        ["tests/benchmarks/opencv_script.py", "{points}", "{tmp}/opencv.yaml"],
    ],
    ids=["calibrate", "calibrate with defaults", "opencv script"],
)
def test_a_whole_command(
    benchmark: BenchmarkFixture, tmp_path: Path, n_views: int, command: list[str]
) -> None:
    points = tmp_path / "points.csv"
    write_points(flat_points(n_views, "plumb_bob"), points)
    root = Path(__file__).resolve().parents[2]
    full = [part.replace("{tmp}", str(tmp_path)).replace("{points}", str(points)) for part in command]
    benchmark.pedantic(
        lambda: subprocess.run([sys.executable, *full], cwd=root, check=True, capture_output=True),
        rounds=5,
        warmup_rounds=1,
    )


@pytest.mark.benchmark(group="loading 500 views with PyYAML")
@pytest.mark.parametrize("n_points", [54, 93, 190])
def test_loading_a_calibration_file(benchmark: BenchmarkFixture, n_points: int) -> None:
    """With all digits, and a covariance for each point."""
    cal = made_calibration(500)
    chosen = cal.points.select(np.arange(len(cal.points)) % 190 < n_points)
    noise = np.random.default_rng(0).normal(0, 0.1, (len(chosen), 4))
    covariance = np.column_stack([noise[:, 0] ** 2, noise[:, 0] * noise[:, 1], 2 * noise[:, 1] ** 2])
    points = replace(chosen, pixels=chosen.pixels + noise[:, 2:], covariance=covariance)
    text = format_calibration(replace(cal, points=points))
    benchmark.pedantic(lambda: yaml.safe_load(text), rounds=3, warmup_rounds=1)

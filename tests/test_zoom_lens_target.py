"""A board that is bent, before a zoom lens: found once for all settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.targets import COLS, ROWS, board, offsets

from neurocal_cli import Correspondences
from neurocal_cli.geometry import rotation_step
from neurocal_cli.io.lens_yaml import read_lens, write_lens
from neurocal_cli.zoom_lens.evaluation import evaluate_lens
from neurocal_cli.zoom_lens.fit_points import fit_lens
from neurocal_cli.zoom_lens.settings import LensPoints
from neurocal_cli.zoom_lens.target import lens_target, on_target

SIGMA = 0.1
ZOOMS = np.linspace(0, 1000, 6)


def alpha(zoom: np.ndarray) -> np.ndarray:
    return np.asarray(800 * np.exp(0.0009 * zoom))


def scene(rng: np.random.Generator, zooms: np.ndarray, n_views: int, bend: np.ndarray) -> LensPoints:
    """Several views of one board at each zoom."""
    given, pixels = board(), []
    at = np.repeat(zooms, n_views)
    while len(pixels) < len(at):
        a = float(alpha(at[len(pixels)]))
        R = rotation_step(rng.uniform(-1, 1, 3) * [0.8, 0.8, 0.3])
        X = (given + bend - given.mean(axis=0)) @ R.T + np.array([*rng.uniform(-10, 10, 2), 0.5 * a])
        uv = a * X[:, :2] / X[:, 2:] + [320.0, 240.0]
        if (uv > 0).all() and (uv < [640, 480]).all():
            pixels.append(uv + SIGMA * rng.standard_normal(uv.shape))
    ids = [f"{c}:{r}" for r in range(ROWS) for c in range(COLS)]
    names = np.repeat([f"view{k}" for k in range(len(at))], len(given))
    points = Correspondences(
        np.tile(given, (len(at), 1)), np.concatenate(pixels), names, (640, 480), point=np.array(ids * len(at))
    )
    return LensPoints.grouped(points, {"zoom": np.repeat(at, len(given))})


def found(lens: LensPoints, choice: str = "auto") -> object:
    return lens_target(lens, choice, "none", False, 0, lambda stage, share: None)


def test_the_board_is_found_where_it_is_bent_and_left_where_it_is_flat() -> None:
    rng = np.random.default_rng(0)
    bend = offsets("parabola", 0.5, rng)
    lens = scene(rng, ZOOMS[::2], 4, bend)
    target = lens_target(lens, "auto", "none", False, 0, lambda stage, share: None)
    assert target is not None
    assert target.bend() == pytest.approx(np.ptp(bend[:, 2]), rel=0.2)
    assert not np.array_equal(on_target(lens, target).points.world, lens.points.world)
    assert found(scene(rng, ZOOMS[::2], 4, np.zeros_like(bend))) is None
    assert found(lens, "given") is None


def test_settings_with_few_views_find_it_together() -> None:
    """Where a fold has no view of some setting, the others tell."""
    rng = np.random.default_rng(1)
    bend = offsets("parabola", 0.5, rng)
    lens = scene(rng, ZOOMS[::2], 4, bend)
    few = (lens.point_setting > 0) | np.isin(lens.points.view_index, [0, 1, 2])
    points = lens.points.select(few)
    settings = lens.settings[lens.point_setting[few], 0]
    assert found(LensPoints.grouped(points, {"zoom": settings})) is not None


@pytest.mark.slow
def test_a_lens_is_better_with_its_board_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    bend = offsets("parabola", 0.5, rng)
    points, others = scene(rng, ZOOMS, 5, bend), scene(rng, np.linspace(100, 900, 5), 3, bend)
    options = {"distortion": "none", "skew": False, "topologies": ((1, 0), (2, 0))}
    given, free = (fit_lens(points, **options, target=choice) for choice in ("given", "auto"))
    at = np.linspace(100, 900, 9)
    error = [np.abs(lens.predict(at[:, None]).local[:, 0] - alpha(at)).max() for lens in (given, free)]
    assert error[1] < 0.3 * error[0]
    write_lens(free, tmp_path / "lens.yaml")
    stored = read_lens(tmp_path / "lens.yaml")
    assert evaluate_lens(given, others).rmse_px > 1.5 * SIGMA * np.sqrt(2)
    assert evaluate_lens(stored, others).rmse_px < 1.05 * SIGMA * np.sqrt(2)
    assert evaluate_lens(stored, others).rmse_px == evaluate_lens(free, others).rmse_px

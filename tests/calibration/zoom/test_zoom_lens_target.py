"""A board that is bent, before a zoom lens: found once for all settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.targets import COLS, ROWS, board, offsets

from neurocal_cli import Correspondences
from neurocal_cli.calibration.zoom.evaluation import evaluate_lens
from neurocal_cli.calibration.zoom.fit import fit_lens
from neurocal_cli.calibration.zoom.settings import LensPoints
from neurocal_cli.calibration.zoom.target import lens_target, on_target
from neurocal_cli.calibration.zoom.zoom_lens import with_target_uncertain
from neurocal_cli.camera.geometry import rotation_step
from neurocal_cli.files.lens_files import read_lens, write_lens

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


def test_the_covariance_is_that_of_lens_and_target_together() -> None:
    """Against the inverse of the whole normal matrix, of lens and offsets with their prior."""
    rng = np.random.default_rng(3)
    S, L, Q, P, d, variance = 5, 4, 1, 6, 7, 0.04
    J = rng.standard_normal((S, L, P))
    rows = rng.standard_normal((S, 40, L + Q + d))
    C, D = rows[:, :, : L + Q], rows[:, :, L + Q :]
    spread = np.cov(rng.standard_normal((d, 3 * d))) * 0.01  # a priori
    whole = [np.concatenate([c[:, :L] @ j, c[:, L:], e], axis=1) for c, j, e in zip(C, J, D, strict=True)]
    H = sum(one.T @ one for one in whole) / variance
    H[P + Q :, P + Q :] += np.linalg.inv(spread)
    E = np.linalg.inv(sum(e.T @ e for e in D) / variance + np.linalg.inv(spread))
    coupling = np.swapaxes(C, 1, 2) @ D @ np.linalg.cholesky(E)
    known = np.linalg.inv(H[: P + Q, : P + Q])
    found = with_target_uncertain(known, J, coupling, variance)
    np.testing.assert_allclose(found, np.linalg.inv(H)[: P + Q, : P + Q], rtol=1e-8)
    assert (np.diagonal(found) > np.diagonal(known)).all()


@pytest.mark.slow
def test_standard_deviations_count_that_the_board_is_uncertain() -> None:
    z = []
    at = np.linspace(100, 900, 5)
    for seed in range(4):
        rng = np.random.default_rng([seed, 5])
        points = scene(rng, ZOOMS, 5, offsets("both", 0.1, rng))
        lens = fit_lens(points, distortion="none", skew=False, topologies=((1, 0), (2, 0)))
        assert lens.target is not None
        found = lens.predict(at[:, None])
        true = np.column_stack([alpha(at), np.full(5, 320.0), np.full(5, 240.0)])
        z.append((found.local[:, [0, 2, 3]] - true) / found.std[:, [0, 2, 3]])
    # The errors of one lens are nearly the same at all of its settings: twelve numbers.
    assert 0.4 < np.sqrt(np.square(z).mean()) < 1.5


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
    np.testing.assert_array_equal(stored.predict(at[:, None]).std, free.predict(at[:, None]).std)

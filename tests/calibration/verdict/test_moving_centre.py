"""An image centre that moves from view to view, as image stabilisation moves it, is told as such."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.slow_cases import slow_but
from support.targets import photographed, stabilised

from neurocal_cli import Calibration, calibrate
from neurocal_cli.calibration.verdict.assessment import gather_evidence
from neurocal_cli.calibration.verdict.moving_centre import MovingCentre


def told(calibration: Calibration) -> bool:
    assert calibration.verdict is not None
    return any("the image centre moves from view to view" in text for text in calibration.verdict.reasons)


def found(calibration: Calibration) -> MovingCentre | None:
    return gather_evidence(calibration).centre


@pytest.mark.parametrize(
    ("size", "shape", "amount"),
    slow_but(
        [(10.0, "parabola", 0.5)],
        [(size, *shape) for size in (10.0, 20.0) for shape in (("flat", 0.0), ("parabola", 0.5))],
    ),
)
def test_a_centre_that_moves_is_told_with_its_size(size: float, shape: str, amount: float) -> None:
    points, truth = photographed(shape, 3, amount=amount, sigma=0.15)
    calibration = calibrate(stabilised(points, size, 3), distortion="k1k2")
    centre = found(calibration)
    assert centre is not None
    assert centre.size == pytest.approx(size, rel=0.4)
    assert told(calibration)
    assert calibration.verdict is not None
    assert "image stabilisation" in calibration.verdict.reasons[0]
    off = (calibration.intrinsics.alpha_u - truth.K[0, 0]) / calibration.std["alpha_u"]
    assert abs(off) < 4


@pytest.mark.parametrize("seed", slow_but((0,), range(40)))
def test_no_centre_moves_in_clean_views(seed: int) -> None:
    assert found(calibrate(photographed("flat", seed, 5 + seed % 20, sigma=0.15)[0])) is None


@pytest.mark.parametrize(
    ("amount", "n_views", "target", "seed"),
    slow_but(
        [(0.3, 10, "auto", 0)],
        [
            (amount, n_views, target, seed)
            for amount in (0.05, 0.1, 0.3, 1.0)
            for n_views in (6, 10, 20)
            for target in ("auto", "given")
            for seed in range(4)
        ],
    ),
)
def test_a_board_that_bends_from_view_to_view_moves_no_centre(
    amount: float, n_views: int, target: str, seed: int
) -> None:
    points, _ = photographed("flexing", seed + 10, n_views, amount, sigma=0.12)
    assert not told(calibrate(points, distortion="k1k2", target=target))


def test_one_image_that_is_cropped_is_no_moving_centre() -> None:
    points, _ = photographed("flat", 1, sigma=0.15)
    cropped = replace(points, pixels=points.pixels - [40.0, 0.0] * (points.view_index == 4)[:, None])
    assert found(calibrate(cropped, outliers="keep")) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "amount", "size", "share"),
    [
        ("flat", 0.0, 5.0, 0.4), ("flat", 0.0, 10.0, 0.7), ("flat", 0.0, 20.0, 0.9),
        ("parabola", 0.5, 10.0, 0.5), ("both", 0.1, 10.0, 0.4),
    ],
)  # fmt: skip
def test_most_moving_centres_are_told(shape: str, amount: float, size: float, share: float) -> None:
    seeds = range(30)
    points = [photographed(shape, seed, amount=amount, sigma=0.15)[0] for seed in seeds]
    hits = [told(calibrate(stabilised(some, size, seed))) for seed, some in zip(seeds, points, strict=True)]
    assert np.mean(hits) >= share, hits

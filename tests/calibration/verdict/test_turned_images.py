"""Images turned by 180 degrees, as programs turn photographs upright, are named."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from support.slow_cases import slow_but
from support.targets import photographed, stabilised

from neurocal_cli import Calibration, Correspondences, calibrate
from neurocal_cli.calibration.verdict.assessment import gather_evidence

OFF = np.array([45.0, -45.0])  # px; of the image centre from where the simulated cameras have it


def turned(points: Correspondences, which: Iterable[int]) -> Correspondences:
    """The same points in images of which some are turned."""
    assert points.image_size is not None
    pixels, size = points.pixels + OFF, np.array(points.image_size)
    those = np.isin(points.view_index, list(which))[:, None]
    return replace(points, pixels=np.where(those, size - 1 - pixels, pixels))


def named(calibration: Calibration) -> set[str]:
    return set(gather_evidence(calibration).turned)


@pytest.mark.parametrize(
    ("n_turned", "shape", "amount"),
    slow_but(
        [(2, "both", 0.1), (7, "both", 0.1)],
        [(n, *shape) for n in (2, 4, 7) for shape in (("flat", 0.0), ("parabola", 0.5), ("both", 0.1))],
    ),
)
def test_turned_images_are_named(n_turned: int, shape: str, amount: float) -> None:
    points, _ = photographed(shape, 5, 14, amount=amount, sigma=0.15)
    which = np.random.default_rng(n_turned).permutation(14)[:n_turned].tolist()
    calibration = calibrate(turned(points, which), distortion="k1k2", outliers="keep")
    names = {points.view_names[k] for k in which}
    others = set(points.view_names) - names
    assert named(calibration) in ([names, others] if n_turned == 7 else [names])
    assert calibration.verdict is not None
    assert calibration.verdict.word == "poor"
    assert "turned by 180 degrees" in calibration.verdict.reasons[0]
    assert "as the camera has stored them" in calibration.verdict.advice[0]


def test_a_turned_image_that_is_left_out_is_named_through_a_strong_lens() -> None:
    points, _ = photographed("flat", 5, 14, k=(-0.3, 0.1), sigma=0.15)
    calibration = calibrate(turned(points, [3]), distortion="k1k2")
    assert "turned by 180 degrees" in calibration.rejected.views[points.view_names[3]]


@pytest.mark.parametrize(
    ("kind", "n_views", "seed"),
    slow_but(
        [("flat", 6, 0), ("stabilised", 6, 0), ("flexing", 20, 0), ("parabola", 6, 0)],
        itertools.product(("flat", "stabilised", "flexing", "parabola"), (6, 9, 20), range(24)),
    ),
)
def test_no_image_is_turned_in_other_data(kind: str, n_views: int, seed: int) -> None:
    amount = {"flexing": 0.3, "parabola": 1.0}.get(kind, 0.0)
    shape = "flat" if kind == "stabilised" else kind
    points, _ = photographed(shape, seed, n_views, amount=amount, sigma=0.12)
    if kind == "stabilised":
        points = stabilised(points, 20.0, seed)
    assert not named(calibrate(points, target="given"))

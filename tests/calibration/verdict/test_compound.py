"""Sets with two causes of error: what is told of them is true."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from support.compound import KIND, PAIRS, compound, told

from neurocal_cli import calibrate


def outcome(pair: tuple[str, str], seed: int) -> tuple[str, bool]:
    """Whether both causes, one or none are told, and whether another one is."""
    of = compound(pair, 1000 * PAIRS.index(pair) + seed)
    found, true = told(calibrate(of.points), of), {KIND.get(cause, cause) for cause in pair}
    return ("none", "one", "both")[len(found & true)], bool(found - true)


def test_a_cropped_view_beside_a_rolling_shutter_is_no_stabilisation() -> None:
    assert outcome(("crop", "rolling"), 1) == ("both", False)


def test_a_cut_costs_no_views_and_no_points_but_outliers() -> None:
    of = compound(("drift", "cut"), 1000 * PAIRS.index(("drift", "cut")) + 3)
    rng = np.random.default_rng(3)
    points = of.points
    wrong = rng.choice(len(points), len(points) // 40, replace=False)
    pixels = points.pixels.copy()
    pixels[wrong] += rng.choice([-1, 1], (len(wrong), 2)) * rng.uniform(5, 40, (len(wrong), 2))
    for some, outliers in ((points, []), (replace(points, pixels=pixels), wrong)):
        found = calibrate(some)
        assert told(found, of) == {"cut", "zoom"}
        assert not found.rejected.views
        assert set(outliers) <= set(found.rejected.rows)
        assert len(found.rejected) <= len(outliers) + 3


@pytest.mark.slow
def test_most_pairs_are_told_and_hardly_another_cause() -> None:
    seen = [outcome(pair, seed) for pair in PAIRS for seed in range(10)]
    counts = Counter(which for which, _ in seen)
    assert counts["both"] >= 58, counts
    assert counts["none"] <= 4, counts
    assert sum(false for _, false in seen) <= 2

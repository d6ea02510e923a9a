"""Sets with two causes of error: what is told of them is true."""

from __future__ import annotations

from collections import Counter

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


@pytest.mark.slow
def test_most_pairs_are_told_and_hardly_another_cause() -> None:
    seen = [outcome(pair, seed) for pair in PAIRS for seed in range(10)]
    counts = Counter(which for which, _ in seen)
    assert counts["both"] >= 55, counts
    assert counts["none"] <= 6, counts
    assert sum(false for _, false in seen) <= 4

"""Keep images of one size, because one camera has one image size."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neurocal_cli.detection.batch import Outcome


def of_one_size(outcomes: list[tuple[str, Outcome]]) -> list[tuple[str, Outcome]]:
    """Leave out boards in images whose size differs from the most common one; none if two sizes tie.

    Parameters
    ----------
    outcomes : list of (name, Outcome)
    """
    sizes = Counter(outcome.detection.image_size for _, outcome in outcomes if outcome.detection is not None)
    counts = [count for _, count in sizes.most_common(2)]
    if len(counts) < 2 or counts[0] == counts[1]:
        return outcomes
    most = sizes.most_common(1)[0][0]
    kept = []
    for name, outcome in outcomes:
        found = outcome.detection
        if found is not None and found.image_size != most:
            both = "{} x {} px and most have {} x {}".format(*found.image_size, *most)
            problem = f"{name}: the image has {both}; run detect for each camera separately"
            outcome = replace(outcome, detection=None, overlay=None, problem=problem)
        kept.append((name, outcome))
    return kept

"""What a verdict is made of: findings, each with a grade, a reason and an advice."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from neurocal_cli.points import Correspondences

__all__ = ["WORDS", "Finding", "image_diagonal", "name_some", "pixel_spread"]

WORDS = ("good", "usable", "poor")
"""By grade."""

Finding = tuple[int, str, str]
"""Grade (0 good, 1 usable, 2 poor), reason, advice."""

_SHOWN = 3


def name_some(names: Iterable[object]) -> str:
    """The first names, and how many there are more."""
    some = [str(name) for name in names]
    more = len(some) - _SHOWN
    return ", ".join(some[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def image_diagonal(points: Correspondences) -> float:
    """Diagonal of the image [px], or of what the points span of it."""
    return float(np.hypot(*(points.image_size or np.ptp(points.pixels, axis=0))))


def pixel_spread(points: Correspondences) -> float:
    """Rms distance of the pixels from their mean [px]."""
    return float(np.sqrt(points.pixels.var(axis=0).sum()))

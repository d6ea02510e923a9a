"""Medians and quantiles of a few hundred numbers.

NumPy's own functions take about ten times as long for so few, and detection calls them often.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array

MAD_TO_SIGMA = 1.4826  # ratio of standard deviation to median absolute deviation for a normal distribution
CHI2_MEDIAN = 0.455  # median of chi-squared with one degree of freedom


def median(x: Array) -> float:
    """Median of an array of any shape, ignoring NaNs; NaN if nothing is left."""
    return quantile(x, 0.5)


def quantile(x: Array, share: float) -> float:
    """Quantile of an array by linear interpolation, ignoring NaNs; NaN if nothing is left."""
    ordered = x.flatten()
    ordered.sort()  # nan comes last
    count = len(ordered) - int(np.count_nonzero(np.isnan(ordered)))
    if count == 0:
        return float("nan")
    place = share * (count - 1)
    low = int(place)
    high = min(low + 1, count - 1)
    return float(ordered[low] + (place - low) * (ordered[high] - ordered[low]))


def upper_median(x: Array) -> float:
    """Median, or the upper of the two middle values for an even count; NaN for an empty array."""
    flat = x.flatten()
    if not len(flat):
        return float("nan")
    flat.partition(len(flat) // 2)
    return float(flat[len(flat) // 2])

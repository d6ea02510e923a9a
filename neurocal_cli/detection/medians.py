"""Medians and quantiles of a few hundred numbers.

NumPy's own functions take about ten times as long for so few, and detection calls them often.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array

MAD_TO_SIGMA = 1.4826  # standard deviation over the median absolute deviation, of normal numbers
CHI2_MEDIAN = 0.455  # of chi-squared with one degree of freedom


def median(x: Array) -> float:
    """The median of an array of any shape, ignoring NaNs; NaN if all are NaN."""
    return quantile(x, 0.5)


def quantile(x: Array, share: float) -> float:
    """A quantile of an array by linear interpolation, ignoring NaNs; NaN if all are NaN."""
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
    """The median, of an even count the upper middle value; NaN for an empty array."""
    flat = x.flatten()
    if not len(flat):
        return float("nan")
    flat.partition(len(flat) // 2)
    return float(flat[len(flat) // 2])

"""The median, where a command's start counts: `numpy.median` and `numpy.quantile` import numpy.ma, 10 ms."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array


def median(values: Array) -> Array:
    """Median along the first axis; of no values or with nan, not what NumPy makes of them."""
    ordered = np.sort(values, axis=0)
    return np.asarray((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)

"""Cameras of one model that explain the points about as well as the best one, and what they add to its std.

A unified or double-sphere lens may have several minima that are nearly as low, or a valley without a lowest
place: xi and the scale make up for each other. The covariance of one minimum knows nothing of the others.
A value of xi is as probable as all cameras that have it: with the volume V of those that are about as good as
the best one among them, weighed by what is known of lenses beforehand, w = V exp(-chi^2 / 2) to second order
(MacKay 1992). The mean square of what a parameter is off is

    E (p - p0)^2 = var(p | xi) + sum_j w_j (p_j - p0)^2.

What is projected is about the same for all these cameras: it is the covariance of the minimum that tells how
certain that is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array


@frozen_dataclass(eq=False)
class Ambiguity:
    """Cameras along xi, sorted by it.

    Attributes
    ----------
    xi : (m,) array
    offsets : (m, 5 + K) array
        Of A's entries and the coefficients from those of the best camera.
    excess : (m,) array
        chi^2 above that of the best camera.
    volume : (m,) array
        Logarithm of V, but for a constant.
    """

    xi: Array
    offsets: Array
    excess: Array
    volume: Array

    def weights(self, inflation: float = 1.0) -> Array:
        """(m,) how probable each camera is, for a variance that is larger than that of the residuals."""
        step = np.diff(self.xi)
        logarithm = self.volume - 0.5 * self.excess / inflation
        weight = (np.append(step, 0.0) + np.insert(step, 0, 0.0)) * np.exp(logarithm - logarithm.max())
        return np.asarray(weight / weight.sum())

    @property
    def range(self) -> tuple[float, float]:
        """Between which xi nine tenths of the probability lie."""
        below = np.cumsum(self.weights())
        first, last = np.searchsorted(below, [0.05, 0.95])
        return float(self.xi[first]), float(self.xi[min(last, len(self.xi) - 1)])

    def spread(self, free: NDArray[np.bool_], inflation: float = 1.0) -> Array:
        """(f, f) mean of offset times offset."""
        offsets = self.offsets[:, free]
        return np.asarray((offsets.T * self.weights(inflation)) @ offsets)

    def widened(self, covariance: Array, free: NDArray[np.bool_], inflation: float = 1.0) -> Array:
        """Mean square error of what is free, xi (the first coefficient) included.

        Parameters
        ----------
        covariance : (f, f) array
            At the best camera; with 0 for an xi that was held there.
        free : (5 + K,) bool array
        inflation : float
            Variance of what is known over that for independent residuals.
        """
        xi = int(free[:5].sum())
        column = covariance[:, xi]
        given = covariance.copy()
        if column[xi] > 0:
            given -= np.outer(column, column) / column[xi]
        return given + self.spread(free, inflation)

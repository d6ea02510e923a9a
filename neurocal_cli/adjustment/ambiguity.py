"""Ambiguity of xi: cameras of one model that fit almost as well as the best one, and their share of its std.

A unified or double-sphere model may have several minima of nearly the same cost, or a flat valley, because xi
and the scale compensate. The covariance at one minimum does not include the others. The probability of a
value of xi is the posterior mass of all cameras with that xi. To second order (Laplace approximation, MacKay
1992) it is w = V exp(-chi^2 / 2), where V is the posterior volume around the best of these cameras, including
the prior on lenses. The mean squared error of a parameter is

    E (p - p0)^2 = var(p | xi) + sum_j w_j (p_j - p0)^2.

All these cameras project nearly alike, so the covariance at the minimum still holds for the projection.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


@frozen_dataclass(eq=False)
class Ambiguity:
    """Cameras along the valley, in ascending order of xi."""

    xi: Array  # (m,)
    offsets: Array  # (m, 5 + K) differences of A's entries and the coefficients from those of the best camera
    excess: Array  # (m,) chi^2 above that of the best camera
    volume: Array  # (m,) logarithm of V up to a constant

    def weights(self, inflation: float = 1.0) -> Array:
        """(m,) probability of each camera, for a variance `inflation` times that of the residuals."""
        step = np.diff(self.xi)
        logarithm = self.volume - 0.5 * self.excess / inflation
        weight = (np.append(step, 0.0) + np.insert(step, 0, 0.0)) * np.exp(logarithm - logarithm.max())
        return np.asarray(weight / weight.sum())

    @property
    def range(self) -> tuple[float, float]:
        """Central interval of xi that contains 90 % of the probability."""
        below = np.cumsum(self.weights())
        first, last = np.searchsorted(below, [0.05, 0.95])
        return float(self.xi[first]), float(self.xi[min(last, len(self.xi) - 1)])

    def spread(self, free: NDArray[np.bool_], inflation: float = 1.0) -> Array:
        """(f, f) weighted second moment of the offsets."""
        offsets = self.offsets[:, free]
        return np.asarray((offsets.T * self.weights(inflation)) @ offsets)

    def widened(self, covariance: Array, free: NDArray[np.bool_], inflation: float = 1.0) -> Array:
        """(f, f) mean squared error of the free parameters (5 + K,), including xi (the first coefficient).

        `covariance` (f, f) is that at the best camera; it is 0 for an xi that was held fixed there.
        `inflation` is the variance of the parameters over the variance that independent residuals would give.
        """
        xi = int(free[:5].sum())
        column = covariance[:, xi]
        given = covariance.copy()
        if column[xi] > 0:
            given -= np.outer(column, column) / column[xi]
        return given + self.spread(free, inflation)

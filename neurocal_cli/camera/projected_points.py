"""Pixels of points in space, with what the uncertainty of the calibration does to them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


@frozen_dataclass(eq=False)
class ProjectedPoints:
    """Pixels of N points.

    Attributes
    ----------
    pixels : (N, 2) array [px]
        ``nan`` for points that the camera does not see.
    covariance : (N, 2, 2) array or None [px^2]
        Of the pixels, due to the calibration alone: a measured pixel has its own noise in addition. None if
        the calibration has no points from which it can be computed, as after ``--lean``.
    seen : (N,) bool array
        Whether the point is in front of the camera, so that it has a pixel; it may lie outside the image.
    """

    pixels: Array
    covariance: Array | None
    seen: NDArray[np.bool_]

    @property
    def std(self) -> Array | None:
        """(N,) standard deviation of both coordinates together, ``sqrt(var u + var v)`` [px]."""
        if self.covariance is None:
            return None
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2)))

"""Points and lengths on a plane, with what makes them uncertain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


@frozen_dataclass(eq=False)
class PlanePoints:
    """Points on the plane of a target, from their pixels.

    Attributes
    ----------
    points : (N, 3) array [world unit]
        In the target's coordinates, with Z = 0; ``nan`` for pixels whose ray does not meet the plane.
    by_calibration : (N, 2, 2) array or None [world unit^2]
        Covariance of X and Y due to the camera and the pose; None if the calibration has no points.
    by_pixel : (N, 2, 2) array [world unit^2]
        The same due to the noise of the pixel.
    seen : (N,) bool array
        Whether the ray meets the plane in front of the camera.
    """

    points: Array
    by_calibration: Array | None
    by_pixel: Array
    seen: NDArray[np.bool_]

    @property
    def covariance(self) -> Array:
        """(N, 2, 2) covariance of X and Y [world unit^2], as far as it is known."""
        return self.by_pixel if self.by_calibration is None else self.by_pixel + self.by_calibration


@frozen_dataclass
class Spread:
    """Standard deviation of a measured length or place [world unit], and its two parts."""

    by_calibration: float
    by_pixel: float

    @property
    def std(self) -> float:
        """Both together."""
        return float(np.hypot(self.by_calibration, self.by_pixel))


@frozen_dataclass
class PlaneErrors:
    """What is measured how well on a plane that faces the camera.

    Of one camera, the distance is taken as exact. Points of a rig are triangulated, and their errors are in
    all three directions.
    """

    distance: float  # from the camera, along its axis [world unit]
    sigma: float  # standard deviation of a pixel, in u and in v [px]
    length: float  # measured in the middle of the image, half as long as what the image shows [world unit]
    of_length: Spread
    of_middle: Spread  # of a point in the middle of the image, all coordinates together
    of_worst: Spread  # of the least certain point of the image
    of_depth: Spread | None = None  # of a triangulated point in the middle, along the axis

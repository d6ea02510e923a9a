"""Positions, pixels, points and lengths that a calibration tells, with what makes them uncertain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array


@frozen_dataclass(eq=False)
class CameraPosition:
    """The centre of a camera in the coordinates of the target of a view.

    Attributes
    ----------
    point : (3,) array [world unit]
    covariance : (3, 3) array or None [world unit^2]
        None if the calibration has no points of its own.
    """

    point: Array
    covariance: Array | None

    @property
    def std(self) -> Array:
        """(3,) standard deviations of X, Y and Z [world unit]; nan where they are unknown."""
        if self.covariance is None:
            return np.full(3, np.nan)
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0)))


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

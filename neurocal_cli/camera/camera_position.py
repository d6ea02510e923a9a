"""Where a camera was, with what makes it uncertain."""

from __future__ import annotations

import numpy as np

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

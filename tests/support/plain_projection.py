"""The pinhole camera written once more, in the plainest way, to check the package's by."""

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.pinhole import Pose

Array = NDArray[np.float64]


def project(A: Array, pose: Pose, world: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) of world points (N, 3), paper eq. (1), and their depths (N,)."""
    camera = world @ pose.R.T + pose.t
    depth = camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        image = camera[:, :2] / depth[:, None]
    return image @ A[:2, :2].T + A[:2, 2], depth

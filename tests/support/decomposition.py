"""A projection matrix taken apart into its camera and its pose (Faugeras 1993)."""

from __future__ import annotations

import numpy as np
from scipy.linalg import rq

from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.pinhole import Intrinsics, Pose


def decompose(P: Array) -> tuple[Intrinsics, Pose]:
    """The camera and the pose of P (3, 4), whatever its scale and sign."""
    sign = np.sign(np.linalg.det(P[:, :3]))
    K, R = rq(sign * P[:, :3])
    sides = np.sign(np.diagonal(K))
    K, R = K * sides, sides[:, None] * R
    return Intrinsics.from_matrix(K / K[2, 2]), Pose(nearest_rotation(R), np.linalg.solve(K, sign * P[:, 3]))

"""Rotations in the forms of other programs: rotation vector and unit quaternion.

SciPy gets copies, because older versions refuse read-only arrays.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.geometry import Array


def to_vector(R: Array) -> Array:
    """Rotation vector (axis times angle [rad]) of a rotation (3, 3), like ``cv2.Rodrigues``; also near pi."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(np.array(R)).as_rotvec())


def from_vector(r: Array) -> Array:
    """Rotation (3, 3) of a rotation vector (axis times angle [rad])."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.array(r, dtype=float).reshape(3)).as_matrix())


def to_quaternion(R: Array) -> Array:
    """Unit quaternion w, x, y, z of a rotation (3, 3), with w >= 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(np.array(R)).as_quat()
    return np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)


def from_quaternion(q: Array) -> Array:
    """Rotation (3, 3) of a quaternion w, x, y, z of any non-zero length."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(np.roll(np.asarray(q, dtype=float), -1)).as_matrix())


def inverse(pose: Pose) -> Pose:
    """Inverse of a pose."""
    return Pose(pose.R.T, -pose.R.T @ pose.t)


def after(second: Pose, first: Pose) -> Pose:
    """Compose two poses: ``X'' = R2 (R1 X + t1) + t2``."""
    return Pose(second.R @ first.R, second.R @ first.t + second.t)

"""The pinhole camera of the paper's section 2: A, D, P = A D and its 11 parameters.

A has five intrinsic parameters, D = [R | t] six extrinsic ones. The estimators work with the five free
entries of A, which are the network's output weights; the paper's alpha_v and theta follow from them. Linear
methods solve for the image of the absolute conic, ``omega = A^-T A^-1``. For conventions see `geometry`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, euler_to_rotation, nearest_rotation, rotation_to_euler
from neurocal_cli.camera.given_values import real_array, real_rows
from neurocal_cli.errors import InputError

INTRINSIC_NAMES = ("alpha_u", "alpha_v", "u0", "v0", "theta")
POSE_NAMES = ("R_x", "R_y", "R_z", "t_x", "t_y", "t_z")

# A given matrix counts as a rotation if R R^T is the identity to this accuracy.
_ROTATION_TOLERANCE = 1e-4

# Rows and columns of omega's entries 11, 12, 22, 13, 23, 33.
_ROW, _COLUMN = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])


@frozen_dataclass
class Intrinsics:
    """The five intrinsic parameters of the paper's matrix A.

    Parameters
    ----------
    alpha_u, alpha_v : float [px]
        Scale factors, both positive.
    u0, v0 : float [px]
        Principal point.
    theta : float [rad]
        Angle between the image axes, in (0, pi); pi/2 means no skew.

    Raises
    ------
    InputError
        A value that is not finite or out of range.
    """

    alpha_u: float
    alpha_v: float
    u0: float
    v0: float
    theta: float = np.pi / 2

    def __post_init__(self) -> None:
        values = real_array("intrinsic parameters", [getattr(self, name) for name in INTRINSIC_NAMES])
        if values.shape != (5,) or not np.isfinite(values).all():
            raise InputError("intrinsic parameters must be finite numbers")
        vars(self).update(zip(INTRINSIC_NAMES, values.tolist(), strict=True))
        if self.alpha_u <= 0 or self.alpha_v <= 0:
            raise InputError("alpha_u and alpha_v must be positive")
        if not 0 < self.theta < np.pi:
            raise InputError("theta must lie between 0 and pi")

    @property
    def A(self) -> Array:
        """(3, 3) array: the paper's A without its last, zero column."""
        a, s, b, u0, v0 = entries_of(self.alpha_u, self.alpha_v, self.u0, self.v0, self.theta)
        return np.array([[a, s, u0], [0.0, b, v0], [0.0, 0.0, 1.0]])

    @property
    def skewed(self) -> bool:
        """Whether theta differs from the float nearest to pi/2, where tan is not infinite."""
        return self.theta != np.pi / 2

    @classmethod
    def from_matrix(cls, A: Array) -> Intrinsics:
        """Parameters of an upper triangular A.

        Parameters
        ----------
        A : (3, 3) array
            It is scaled to ``A[2, 2] = 1``.

        Raises
        ------
        InputError
            A is not finite or not upper triangular, or its last entry is 0.
        """
        A = real_array("a camera matrix", A)
        if A.shape != (3, 3) or not np.isfinite(A).all() or A[2, 2] == 0:
            raise InputError("a camera matrix must be 3 x 3, finite, with A[2, 2] = 1")
        with np.errstate(over="ignore"):  # refused below
            A = A / A[2, 2]
        if not np.isfinite(A).all():
            raise InputError("a camera matrix must be 3 x 3, finite, with A[2, 2] = 1")
        if np.abs(A[[1, 2, 2], [0, 0, 1]]).max() > 1e-9 * np.abs(A).max():
            raise InputError("a camera matrix must be upper triangular")
        theta = float(np.arctan2(A[0, 0], -A[0, 1])) if A[0, 1] != 0 else np.pi / 2
        return cls(A[0, 0], A[1, 1] * np.sin(theta), A[0, 2], A[1, 2], theta)

    def values(self) -> Array:
        """(5,) array in the order of `INTRINSIC_NAMES`."""
        return np.array([getattr(self, name) for name in INTRINSIC_NAMES])

    def entry_jacobian(self) -> Array:
        """Derivative of (alpha_u, alpha_v, u0, v0, theta) by A's (A11, A12, A22, A13, A23); (5, 5)."""
        sine, cosine = np.sin(self.theta), np.cos(self.theta)
        # theta = atan2(A11, -A12) and alpha_v = A22 sin(theta).
        theta_by_a11 = sine * cosine / self.alpha_u
        theta_by_a12 = sine * sine / self.alpha_u
        alpha_v_by_theta = self.alpha_v / np.tan(self.theta)
        J = np.zeros((5, 5))
        J[0, 0] = J[2, 3] = J[3, 4] = 1.0
        J[1] = [alpha_v_by_theta * theta_by_a11, alpha_v_by_theta * theta_by_a12, sine, 0.0, 0.0]
        J[4, :2] = theta_by_a11, theta_by_a12
        return J


@frozen_dataclass
class Pose:
    """World to camera, ``Xc = R M + t``.

    Parameters
    ----------
    R : (3, 3) array
        A rotation; it is replaced by the nearest exact one.
    t : (3,) array
        In the world's unit.

    Raises
    ------
    InputError
        Wrong shapes, values that are not finite, R not a rotation.
    """

    R: Array
    t: Array

    def __post_init__(self) -> None:
        R, t = np.array(real_array("R", self.R)), np.array(real_array("t", self.t)).ravel()
        if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
            raise InputError("a pose needs a finite 3 x 3 rotation R and 3 numbers t")
        large = np.abs(R).max() > 2.0  # whose product may overflow
        if large or np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            raise InputError("R is not a rotation: R R^T must be the identity and det R = +1")
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-14:
            R = nearest_rotation(R)
        for name, array in (("R", R), ("t", t)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def exact(cls, R: Array, t: Array) -> Pose:
        """Pose from an exact rotation R, without the checks, which take time for thousands of views."""
        pose = object.__new__(cls)
        object.__setattr__(pose, "R", R)
        object.__setattr__(pose, "t", t)
        return pose

    @classmethod
    def from_euler(cls, R_x: float, R_y: float, R_z: float, t: Array) -> Pose:
        """Pose from Euler angles [rad] and a translation."""
        return cls(euler_to_rotation(R_x, R_y, R_z), t)

    @property
    def inverse(self) -> Pose:
        """Camera to world, ``M = R^T (Xc - t)``; its t is the camera's position."""
        return Pose(self.R.T, -self.R.T @ self.t)

    def after(self, first: Pose) -> Pose:
        """Two poses, one after the other: ``X'' = R (R1 X + t1) + t``."""
        return Pose(self.R @ first.R, self.R @ first.t + self.t)

    def relative_to(self, other: Pose) -> Pose:
        """The pose of this camera in the frame of another one: ``X_self = R X_other + t``."""
        R = self.R @ other.R.T
        return Pose.exact(R, self.t - R @ other.t)

    def to_camera(self, world: Array) -> Array:
        """World points (..., 3) in the camera's frame."""
        return np.asarray(real_rows("world", world, 3, stacked=True) @ self.R.T + self.t)

    @property
    def euler(self) -> Array:
        """(3,) array R_x, R_y, R_z [rad]."""
        return rotation_to_euler(self.R)

    @property
    def values(self) -> dict[str, float]:
        """The angles [rad] and the translation, by `POSE_NAMES`."""
        return dict(zip(POSE_NAMES, [*self.euler.tolist(), *self.t.tolist()], strict=True))

    @property
    def D(self) -> Array:
        """(3, 4) array [R | t], the paper's D without its last row."""
        return np.column_stack([self.R, self.t])


def entries_of(alpha_u: Any, alpha_v: Any, u0: Any, v0: Any, theta: float) -> tuple[Any, Any, Any, Any, Any]:
    """A11, A12, A22, A13, A23 from numbers, or from arrays with one element per camera; theta is a number."""
    # The tangent of the float nearest to pi/2 is finite, so this case is separate.
    skew = -alpha_u / np.tan(theta) if theta != np.pi / 2 else 0.0
    return alpha_u, skew, alpha_v / np.sin(theta), u0, v0


def in_cameras(poses: Sequence[Pose], world: Array, view: NDArray[np.intp]) -> Array:
    """World points (N, 3) in the camera's frame of their views; `view` (N,) are indices of poses."""
    R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
    return np.asarray((R[view] @ world[..., None])[..., 0] + t[view])


def product_of(a: Array, b: Array) -> Array:
    """Coefficients (V, 6) of a . omega b, for omega's entries 11, 12, 22, 13, 23, 33."""
    other = np.where(_ROW == _COLUMN, 0.0, 1.0)
    return np.asarray(a[:, _ROW] * b[:, _COLUMN] + other * a[:, _COLUMN] * b[:, _ROW])


def omega_of(entries: Array) -> Array:
    """The matrix omega (3, 3) from these entries up to sign; the first one becomes positive."""
    omega = np.zeros((3, 3))
    omega[_ROW, _COLUMN] = omega[_COLUMN, _ROW] = entries * np.sign(entries[0])
    return omega

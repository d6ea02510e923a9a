"""Rotations, similarities and the conventions of the whole package.

Conventions
-----------
* Pixels: the centre of the top-left pixel is (0, 0); u grows to the right, v downwards.
* World to camera: ``Xc = R M + t``, column vectors, right-handed; camera x right, y down, z forward.
* Euler angles in radians, fixed axes: ``R = Rz(R_z) Ry(R_y) Rx(R_x)``, R_y in [-pi/2, pi/2].
  The paper never states its order; this one reproduces its Table 1 scene.
* ``P = A [R | t]`` with A upper triangular, positive diagonal, ``A[2, 2] = 1``.
* A point in front of the camera has positive depth.

Arrays of rotations carry leading batch axes: ``(..., 3, 3)``.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Shape = Literal["plane", "cylinder", "equirectangular"]
UNDISTORTED = get_args(Shape)
"""Shapes that undistorted pixels are projected on."""

# Below this cosine of R_y the x and z axes coincide and only R_x -/+ R_z is defined.
_GIMBAL_COSINE = 1e-12
_SINGULAR = 1e-9  # below it only the combination is taken to vary with a rotation


def euler_to_rotation(R_x: float, R_y: float, R_z: float) -> Array:
    """Rotation matrix ``Rz(R_z) Ry(R_y) Rx(R_x)``, (3, 3), of angles in radians."""
    cx, cy, cz = np.cos(R_x), np.cos(R_y), np.cos(R_z)
    sx, sy, sz = np.sin(R_x), np.sin(R_y), np.sin(R_z)
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def rotation_to_euler(R: Array) -> Array:
    """Euler angles R_x, R_y, R_z [rad], (..., 3, 3) -> (..., 3); R_z is 0 where R_y is +-pi/2."""
    R = np.asarray(R, dtype=float)
    cy = np.hypot(R[..., 0, 0], R[..., 1, 0])
    locked = cy < _GIMBAL_COSINE
    R_y = np.arctan2(-R[..., 2, 0], cy)
    R_z = np.where(locked, 0.0, np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    # From Rz^-1 R, whose second row is (0, cos R_x, -sin R_x): near gimbal lock R_z is only rounding, and
    # this R_x compensates for it, while R_x from the third row would have an independent error.
    cz, sz = np.cos(R_z), np.sin(R_z)
    R_x = np.arctan2(sz * R[..., 0, 2] - cz * R[..., 1, 2], cz * R[..., 1, 1] - sz * R[..., 0, 1])
    return np.stack([R_x, R_y, R_z], axis=-1)


def euler_jacobian(R: Array) -> Array:
    """Derivative (..., 3, 3) of the Euler angles of rotations by a small left one, ``R -> exp(omega) R``.

    Columns of the inverse are the instantaneous axes of R_x, R_y, R_z in the camera frame. At gimbal lock the
    pseudo-inverse is returned: only the defined combination moves.
    """
    R = np.asarray(R, dtype=float)
    cy, sy = np.hypot(R[..., 0, 0], R[..., 1, 0]), -R[..., 2, 0]
    if (cy > _SINGULAR).all():
        cz, sz = R[..., 0, 0] / cy, R[..., 1, 0] / cy
        J = np.zeros_like(R)
        J[..., 0, 0], J[..., 0, 1] = cz / cy, sz / cy
        J[..., 1, 0], J[..., 1, 1] = -sz, cz
        J[..., 2, 0], J[..., 2, 1], J[..., 2, 2] = cz * sy / cy, sz * sy / cy, 1.0
        return J
    _, R_y, R_z = np.moveaxis(rotation_to_euler(R), -1, 0)
    cy, sy, cz, sz = np.cos(R_y), np.sin(R_y), np.cos(R_z), np.sin(R_z)
    zero, one = np.zeros_like(cy), np.ones_like(cy)
    axes = np.stack(
        [
            np.stack([cz * cy, -sz, zero], -1),
            np.stack([sz * cy, cz, zero], -1),
            np.stack([-sy, zero, one], -1),
        ],
        axis=-2,
    )
    return np.linalg.pinv(axes, rcond=_SINGULAR)


def cross_matrix(w: Array) -> Array:
    """Matrix of the cross product, ``cross_matrix(w) @ x == np.cross(w, x)``; (..., 3) -> (..., 3, 3)."""
    w = np.asarray(w, dtype=float)
    K = np.zeros((*w.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2] = -w[..., 2], w[..., 1]
    K[..., 1, 0], K[..., 1, 2] = w[..., 2], -w[..., 0]
    K[..., 2, 0], K[..., 2, 1] = -w[..., 1], w[..., 0]
    return K


def by_motion(points: Array, unit: Array | float = 1.0) -> Array:
    """(N, 3, 6) derivatives of points by a turn about the origin and by a shift in a unit, one or (N,)."""
    shift = np.eye(3) * np.broadcast_to(unit, len(points))[:, None, None]
    return np.concatenate([-cross_matrix(points), shift], axis=2)


def rotation_step(w: Array) -> Array:
    """Rotation by Cayley's formula, ``(I - K/2)^-1 (I + K/2)`` with K the cross matrix of w.

    Equal to the rotation by |w| about w up to the third order, exactly a rotation for any w, and
    a good deal cheaper than Rodrigues' formula. (..., 3) -> (..., 3, 3)
    """
    half = 0.5 * np.asarray(w, dtype=float)
    K = cross_matrix(half)
    factor = 2.0 / (1.0 + (half * half).sum(-1))
    return np.eye(3) + factor[..., None, None] * (K + K @ K)


def rotation_vector(R: Array) -> Array:
    """Axis times angle [rad] of rotations by less than pi, the logarithm of R; (..., 3, 3) -> (..., 3)."""
    R = np.asarray(R, dtype=float)
    sines = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    sine = np.linalg.norm(sines, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0))
    return np.asarray(sines * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 1.0)[..., None])


def rotation_to_axis(directions: Array) -> Array:
    """Smallest rotations (V, 3, 3) that turn unit vectors (V, 3) to the z axis.

    With v = d x z, R = I + [v]_x + [v]_x^2 / (1 + d_z); half a turn about x for the opposite direction.
    """
    directions = np.asarray(directions, dtype=float)
    v = np.column_stack([directions[:, 1], -directions[:, 0], np.zeros(len(directions))])
    opposite = directions[:, 2] < -1 + 1e-12
    K = cross_matrix(v)
    R = np.eye(3) + K + K @ K / np.where(opposite, 1.0, 1.0 + directions[:, 2])[:, None, None]
    R[opposite] = np.diag([1.0, -1.0, -1.0])
    return np.asarray(R)


def orthonormalised(R: Array) -> Array:
    """Remove rounding errors from rotations by one Newton-Schulz step; (..., 3, 3)."""
    return np.asarray(R @ (1.5 * np.eye(3) - 0.5 * (np.swapaxes(R, -1, -2) @ R)))


def nearest_rotation(M: Array) -> Array:
    """Rotation nearest to M in the Frobenius norm, determinant +1; (..., 3, 3) -> (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    flip = np.ones((*np.shape(M)[:-2], 3))
    flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return (U * flip[..., None, :]) @ Vt


def nearest_similarity(points: Array, to: Array) -> tuple[float, Array, Array]:
    """Least-squares scale s, rotation R (3, 3) and translation t (3,) from points x to others, ``s R x + t``.

    Umeyama, Least-squares estimation of transformation parameters, IEEE PAMI 13 (1991).
    """
    centre, other = points.mean(axis=0), to.mean(axis=0)
    x, y = points - centre, to - other
    R = nearest_rotation(y.T @ x)
    s = float(((x @ R.T) * y).sum() / (x * x).sum())
    return s, R, other - s * R @ centre


def distinct_rows(table: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index of the first occurrence of each distinct row (N, m), sorted by rows, and the inverse indices.

    The same as `numpy.unique` along the first axis, in a twentieth of the time. Only the first rows are
    sorted if all others repeat them in order, as where every view shows the whole target.
    """
    n = len(table)
    again = np.flatnonzero(_equal(table[1:], table[:1]))
    period = int(again[0]) + 1 if again.size else n
    if period < n and n % period == 0 and np.array_equal(table[period:], table[:-period]):
        first, label = distinct_rows(table[:period])
        return first, np.tile(label, n // period)
    order = np.lexsort(table.T[::-1])
    ordered = table.take(order, axis=0)
    new = np.ones(n, dtype=bool)
    new[1:] = ~_equal(ordered[1:], ordered[:-1])
    label = np.empty(n, dtype=np.intp)
    label[order] = np.cumsum(new) - 1
    return order[new], label


def _equal(rows: NDArray[Any], others: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) whether rows are equal, column by column: five times as fast as ``all(axis=1)``."""
    equal = np.ones(len(rows), dtype=bool)
    for a, b in zip(rows.T, others.T, strict=True):
        equal &= a == b
    return equal


def similarity(points: Array) -> tuple[Array, float]:
    """Centre (D,) and scale that bring points (N, D) into [-1, 1], the paper's s_1 and s_2 with an origin.

    Dividing by s alone leaves data far from the origin badly conditioned (Hartley 1997), so the centroid is
    subtracted first. The scale is 1 when all the points coincide.
    """
    centre = points.mean(axis=0)
    scale = float(np.abs(points - centre).max(initial=0.0))
    return centre, scale if scale > 0 else 1.0


def median(values: Array) -> Array:
    """Median along the first axis; of no values or with nan, not what NumPy makes of them.

    `numpy.median` imports numpy.ma, which would add 10 ms to the start of a command.
    """
    ordered = np.sort(values, axis=0)
    return np.asarray((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)

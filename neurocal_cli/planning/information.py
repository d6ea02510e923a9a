"""Fisher information of views on a camera, and the resulting uncertainty of pixels.

Each view adds the normal matrix of the camera's parameters with the view's pose eliminated, ``A - C B^-1
C^T``. It needs no observed pixels, so views that were not taken can be compared. All points have equal
weight, with the noise of the calibration.

Changes of the camera that a motion of its frame compensates do not count, as in
`verdict.projection_uncertainty`. There the frame moves with the poses of the views. Here it moves so that the
pixels of near and far points all over the image move least, which does not depend on the views. So no view
can make the camera less certain, and the numbers of both modules are similar but not equal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.geometry import Array, cross_matrix

_SINGULAR = 1e-13  # eigenvalue of a matrix with unit diagonal, below which it is rounding


def view_information(camera: Camera, free: NDArray[np.bool_], pose: Pose, world: Array) -> Array:
    """Information of a view of points on the camera.

    Parameters
    ----------
    camera : Camera
    free : (5 + K,) bool array
        Mask of A11, A12, A22, A13, A23 and the coefficients that are estimated.
    pose : Pose
    world : (N, 3) array

    Returns
    -------
    normal : (f, f) array
        Normal matrix of the free parameters with the pose eliminated, for residuals of unit variance.
    """
    points = pose.to_camera(world)
    J, P = _derivatives(camera, free, points)
    J, P = J.reshape(-1, J.shape[2]), P.reshape(-1, 6)
    C = J.T @ P
    return np.asarray(J.T @ J - C @ np.linalg.pinv(P.T @ P, hermitian=True) @ C.T)


def pixel_changes(camera: Camera, free: NDArray[np.bool_], pixels: Array, depths: Array) -> Array:
    """Derivatives of pixels by the free parameters, without the part that a motion of the frame compensates.

    Parameters
    ----------
    camera : Camera
    free : (5 + K,) bool array
    pixels : (G, 2) array [px]
        Pixels all over the image; those without a ray are left out.
    depths : (D,) array
        Depths of the points; each pixel has a point at each depth.

    Returns
    -------
    J : (g, 2, f) array
    """
    rays = camera.seen_points(pixels)
    rays = rays[np.isfinite(rays[:, 0])]
    J, P = _derivatives(camera, free, np.concatenate([depth * rays for depth in depths]))
    motion = np.linalg.lstsq(P.reshape(-1, 6), J.reshape(-1, J.shape[2]), rcond=None)[0]
    return np.asarray(J - P @ motion)


def worst_std(normal: Array, changes: Array, sigma: float) -> float:
    """Largest standard deviation of a projected pixel [px]; infinite if the views determine no camera.

    Parameters
    ----------
    normal : (f, f) array
        Sum of the views' `view_information`.
    changes : (g, 2, f) array
        See `pixel_changes`.
    sigma : float [px]
        Noise of the points, in u and in v.
    """
    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    S = normal / np.outer(scale, scale)
    if np.linalg.eigvalsh(S)[0] < _SINGULAR:
        return float("inf")
    scaled = changes / scale
    variance = np.sum((scaled @ np.linalg.inv(S)) * scaled, axis=(1, 2))
    return sigma * float(np.sqrt(variance.max()))


def _derivatives(camera: Camera, free: NDArray[np.bool_], points: Array) -> tuple[Array, Array]:
    """Derivatives of pixels by the free parameters (N, 2, f) and a motion of the points' frame (N, 2, 6)."""
    by_camera, by_point = camera.project_jacobian(points)
    moved = np.concatenate([-cross_matrix(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
    return by_camera[:, :, free], by_point @ moved

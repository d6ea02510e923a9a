"""The information that views give on a camera, and the resulting uncertainty of its pixels.

Each view, real or planned, adds the normal matrix of the camera's parameters with the view's pose eliminated
(Schur complement ``A - C B^-1 C^T``). All points have the noise of the calibration.

A change of the camera that a motion of its frame compensates does not count, as in
`verdict.projection_uncertainty`. There the frame moves with the poses of the views; here it moves so that the
pixels of near and far points all over the image change least, which does not depend on the views. So no view
can make the camera less certain, and the two modules give similar but not equal numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.geometry import Array, cross_matrix

_SINGULAR = 1e-13  # a smaller eigenvalue of a matrix with unit diagonal is rounding


def view_information(camera: Camera, free: NDArray[np.bool_], pose: Pose, world: Array) -> Array:
    """Information on the camera from one view of these points.

    Parameters
    ----------
    camera : Camera
    free : (5 + K,) bool array
        Which of A11, A12, A22, A13, A23 and the coefficients are estimated.
    pose : Pose
    world : (N, 3) array

    Returns
    -------
    normal : (f, f) array
        Normal matrix of the free parameters, the pose eliminated; residuals of unit variance.
    """
    points = pose.to_camera(world)
    J, P = _derivatives(camera, free, points)
    J, P = J.reshape(-1, J.shape[2]), P.reshape(-1, 6)
    C = J.T @ P
    return np.asarray(J.T @ J - C @ np.linalg.pinv(P.T @ P, hermitian=True) @ C.T)


def pixel_changes(camera: Camera, free: NDArray[np.bool_], pixels: Array, depths: Array) -> Array:
    """Derivative of pixels by the free parameters, minus the part that a motion of the frame compensates.

    Parameters
    ----------
    camera : Camera
    free : (5 + K,) bool array
    pixels : (G, 2) array [px]
        All over the image; those without a ray are left out.
    depths : (D,) array
        Depths of the points on each pixel's ray.

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
    """Largest standard deviation of a projected pixel [px]; infinite where the views determine no camera.

    Parameters
    ----------
    normal : (f, f) array
        Sum of the views' `view_information`.
    changes : (g, 2, f) array
        See `pixel_changes`.
    sigma : float [px]
        Of the points, in u and in v.
    """
    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    S = normal / np.outer(scale, scale)
    if np.linalg.eigvalsh(S)[0] < _SINGULAR:
        return float("inf")
    scaled = changes / scale
    variance = np.sum((scaled @ np.linalg.inv(S)) * scaled, axis=(1, 2))
    return sigma * float(np.sqrt(variance.max()))


def _derivatives(camera: Camera, free: NDArray[np.bool_], points: Array) -> tuple[Array, Array]:
    """Of pixels by the free parameters (N, 2, f), and by a small motion of the points' frame (N, 2, 6)."""
    by_camera, by_point = camera.project_jacobian(points)
    moved = np.concatenate([-cross_matrix(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
    return by_camera[:, :, free], by_point @ moved

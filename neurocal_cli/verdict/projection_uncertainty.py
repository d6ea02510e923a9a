"""How far the pixel of a point in space would move if the calibration were done again with other noise.

A point is held in the frames of the target's views, as in mrcal: what the camera sees at a pixel and
a depth is taken through every view's pose to the target and, with the perturbed poses, back; the mean
of that is where the perturbed camera sees it. So a change of the camera that its poses follow costs
nothing, as it costs nothing to who uses the camera.

To first order the mean over views of the perturbed poses is a motion (omega, T) of the camera's frame,
p -> p + omega x p + T, and all follows from the normal matrices: with the shared parameters' covariance
S^-1 and each view's pose, given them, B^-1, the motion is G d + e with the means G of -M B^-1 C^T and
cov(e) of M B^-1 M^T, M turning a view's pose steps into motions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState, camera_columns
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.camera import Camera
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array, cross_matrix
from neurocal_cli.least_squares.leave_out import inverse_or_nan

_ACROSS = 21  # points across the image
# A wide lens may show this times the angle of the farthest point, and this angle in any case [rad].
_BEYOND, _LEAST = 1.1, 1.2


@frozen_dataclass(eq=False)
class ProjectionUncertainty:
    """Standard deviation of projected pixels over the image.

    Attributes
    ----------
    pixels : (G, 2) array [px]
        Places in the image; those that the camera cannot see are nan below.
    depths : (D,) array
        Distances along the optical axis [world unit].
    std : (D, G) array [px]
        Of the pixel's length of error, ``sqrt(var u + var v)``.
    """

    pixels: Array
    depths: Array
    std: Array

    @property
    def worst(self) -> float:
        """Largest one at the points' middle distance [px]; nan where the camera sees nothing of the image."""
        seen = self.std[1][np.isfinite(self.std[1])]
        return float(seen.max()) if seen.size else float("nan")


def image_grid(size: tuple[int, int]) -> Array:
    """Places all over an image, its corners among them; (G, 2)."""
    width, height = size
    down = max(2, round(_ACROSS * height / width))
    u, v = np.meshgrid(np.linspace(0, width - 1, _ACROSS), np.linspace(0, height - 1, down))
    return np.column_stack([u.ravel(), v.ravel()])


def projection_uncertainty(
    views: Views,
    state: CameraState,
    camera: Camera,
    normal: Array,
    free: NDArray[np.bool_],
    free_poses: bool,
    variance: float,
    pixels: Array,
    depths: Array,
    shared: Array,
    farthest: float | None = None,
) -> ProjectionUncertainty:
    """Propagate the covariance of a calibration.

    Parameters
    ----------
    views, state, normal
        At the minimum, normalised.
    camera : Camera
        The same in pixels.
    free : (5 + K,) bool array
    free_poses : bool
    variance : float
        Of the residuals, normalised.
    pixels : (G, 2) array [px]
    depths : (D,) array
    shared : (f, f) array
        Covariance of the free entries and coefficients (`view_covariance`).
    farthest : float, optional
        Angle from the axis of the farthest point of a wide lens [rad]. Pixels much farther out lie beyond its
        image circle.
    """
    columns = camera_columns(len(free) - 5)[np.flatnonzero(free)]
    gain, motion = _motions(views, state, normal, columns, free_poses)
    by_camera, by_point, rays = _derivatives(camera, pixels, views.pixel_scale, farthest)
    by_camera = by_camera[:, :, np.flatnonzero(free)]
    std = np.empty((len(depths), len(pixels)))
    for k, depth in enumerate(depths):
        p = depth * rays
        moved = np.concatenate([-cross_matrix(p), np.broadcast_to(np.eye(3), (len(p), 3, 3))], axis=2)
        by_motion = by_point / depth @ moved  # (G, 2, 6)
        J = by_camera + by_motion @ gain
        # The traces of J cov J^T.
        of_camera = (J @ shared * J).sum(axis=(1, 2))
        std[k] = np.sqrt(of_camera + variance * (by_motion @ motion * by_motion).sum(axis=(1, 2)))
    return ProjectionUncertainty(pixels, depths, std)


def _motions(
    views: Views, state: CameraState, normal: Array, shared: NDArray[np.intp], free_poses: bool
) -> tuple[Array, Array]:
    """Gain G (6, f), cov(e) (6, 6); world units, residuals of unit variance."""
    if not free_poses:
        return np.zeros((6, len(shared))), np.zeros((6, 6))
    V = views.n_views
    B_inverse = inverse_or_nan(normal[:, POSE, POSE])
    C = normal[:, shared, POSE]
    M = np.zeros((V, 6, 6))
    M[:, :3, :3] = np.eye(3)
    M[:, 3:, :3] = views.scale[:, None, None] * cross_matrix(state.t)
    M[:, 3:, 3:] = views.scale[:, None, None] * np.eye(3)
    gain = -(M @ B_inverse @ np.swapaxes(C, 1, 2)).mean(axis=0)
    motion = (M @ B_inverse @ np.swapaxes(M, 1, 2)).sum(axis=0) / V**2
    return gain, motion


def _derivatives(
    camera: Camera, pixels: Array, scale: float, farthest: float | None
) -> tuple[Array, Array, Array]:
    """Of the pixels (G, 2) by the normalised camera (5 + K) and by points at depth 1; rays (G, 3)."""
    rays = camera.seen_points(pixels)
    if farthest is not None:
        rays = np.where(rays[:, 2:] < np.cos(min(max(_BEYOND * farthest, _LEAST), np.pi)), np.nan, rays)
    by_camera, by_point = camera.project_jacobian(rays)
    return by_camera * np.array([scale] * 5 + [1.0] * (by_camera.shape[2] - 5)), by_point, rays

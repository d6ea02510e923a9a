"""The measures of a calibration from which its verdict follows: coverage and projection uncertainty.

Projection uncertainty is the std of the pixel of a point in space due to noise in the calibration. As in
mrcal, a point is fixed to the targets of the calibration. The point at a pixel and a depth is transformed to
the target by each view's pose, and back by the perturbed pose; the perturbed camera projects the mean of the
results. So a change of the camera that a common change of its poses compensates counts as no uncertainty,
just as it does not matter to a user.

To first order, the mean of the perturbed poses is a motion (omega, T) of the camera's frame, p -> p + omega x
p + T, and everything follows from the normal matrices. Let S^-1 be the covariance of the shared parameters d,
and B^-1 that of each view's pose given them. Then the motion is G d + e, where G is the mean of -M B^-1 C^T
over the views and cov(e) that of M B^-1 M^T; M converts a view's pose step to a motion.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.cross_validation import Minimum, inverse_or_nan
from neurocal_cli.adjustment.reprojection import POSE, camera_columns
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, by_motion, cross_matrix
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.points import Correspondences

_ACROSS = 21  # points across the image
# The image circle of a wide lens is assumed to reach this times the angle of the farthest point, and at least
# this angle [rad].
_BEYOND, _LEAST = 1.1, 1.2


@frozen_dataclass(eq=False)
class ProjectionUncertainty:
    """Standard deviation of projected pixels over the image."""

    pixels: Array  # (G, 2) [px] positions in the image
    depths: Array  # (D,) distances along the optical axis [world unit]
    std: Array  # (D, G) [px] of both coordinates, ``sqrt(var u + var v)``; nan outside the domain of the lens

    @property
    def worst(self) -> float:
        """Largest std at the median distance of the points [px]; nan if it is nan everywhere."""
        seen = self.std[1][np.isfinite(self.std[1])]
        return float(seen.max()) if seen.size else float("nan")


def image_grid(size: tuple[int, int]) -> Array:
    """Regular grid of pixels over an image, including its corners; (G, 2)."""
    width, height = size
    down = max(2, round(_ACROSS * height / width))
    u, v = np.meshgrid(np.linspace(0, width - 1, _ACROSS), np.linspace(0, height - 1, down))
    return np.column_stack([u.ravel(), v.ravel()])


def projection_uncertainty(
    m: Minimum, camera: Camera, variance: float, pixels: Array, depths: Array, shared: Array,
    farthest: float | None,
) -> ProjectionUncertainty:  # fmt: skip
    """Propagate the covariance of a calibration to projected pixels (G, 2) [px] at depths (D,).

    The minimum is normalised, the camera is the same in pixels, and `variance` is that of the residuals,
    normalised. `shared` (f, f) is the covariance of the free entries and coefficients (`covariance`).
    Pixels of a wide lens that are much farther out than the angle [rad] of the `farthest` point lie beyond
    its image circle.
    """
    rays = camera.seen_points(pixels)
    if farthest is not None:
        rays = np.where(rays[:, 2:] < np.cos(min(max(_BEYOND * farthest, _LEAST), np.pi)), np.nan, rays)
    points = (depths[:, None, None] * rays).reshape(-1, 3)
    variances = np.trace(pixel_covariance(m, camera, variance, points, shared), axis1=1, axis2=2)
    return ProjectionUncertainty(pixels, depths, np.sqrt(variances).reshape(len(depths), -1))


def pixel_covariance(
    m: Minimum, camera: Camera, variance: float, points: Array, shared: Array, view: str | None = None
) -> Array:
    """Covariance (N, 2, 2) [px^2] of the pixels of points (N, 3) in the camera's frame [world unit].

    The points are fixed to the target of a view, or, as above, to the targets of all views. The other
    parameters are those of `projection_uncertainty`.
    """
    gain, motion = _motions(m, None if view is None else m.views.names.index(view))
    by_camera, by_point = _derivatives(m, camera, points)
    moved = by_point @ by_motion(points)
    J = by_camera + moved @ gain
    of_camera = J @ shared @ np.swapaxes(J, 1, 2)
    return np.asarray(of_camera + variance * (moved @ motion @ np.swapaxes(moved, 1, 2)))


def _motions(m: Minimum, view: int | None = None) -> tuple[Array, Array]:
    """Gain G (6, f) and cov(e) (6, 6) of the motion, in world units, for residuals of unit variance.

    The motion is the mean of all views', or that of a single view.
    """
    shared = camera_columns(len(m.free) - 5)[np.flatnonzero(m.free)]
    if not m.free_poses:
        return np.zeros((6, len(shared))), np.zeros((6, 6))
    taken = slice(None) if view is None else slice(view, view + 1)
    scale, normal = m.views.scale[taken, None, None], m.normal[taken]
    V = len(normal)
    B_inverse = inverse_or_nan(normal[:, POSE, POSE])
    C = normal[:, shared, POSE]
    M = np.zeros((V, 6, 6))
    M[:, :3, :3] = np.eye(3)
    M[:, 3:, :3] = scale * cross_matrix(m.state.t[taken])
    M[:, 3:, 3:] = scale * np.eye(3)
    gain = -(M @ B_inverse @ np.swapaxes(C, 1, 2)).mean(axis=0)
    motion = (M @ B_inverse @ np.swapaxes(M, 1, 2)).sum(axis=0) / V**2
    return gain, motion


def _derivatives(m: Minimum, camera: Camera, points: Array) -> tuple[Array, Array]:
    """Derivatives of the pixels of points (N, 3) by the free parameters, normalised, and by the points."""
    by_camera, by_point = camera.project_jacobian(points)
    by_camera = by_camera * np.array([m.views.pixel_scale] * 5 + [1.0] * (by_camera.shape[2] - 5))
    if m.state.square:
        by_camera[:, :, 0] += by_camera[:, :, 2]
    return by_camera[:, :, np.flatnonzero(m.free)], by_point


_CELLS = 6  # across and down
_THIRDS = (
    ("upper left", "upper", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower", "lower right"),
)


@frozen_dataclass
class Coverage:
    """Coverage by the points of a calibration."""

    image: float  # share of the image's 6 x 6 cells that hold a point; nan if the image size is unknown
    empty: str  # the emptiest part of the image, such as "upper left"; "" if all parts are covered
    tilt: float  # largest angle between two views' targets [degrees]; 90 for targets that are not flat
    relief: float  # depth of the deepest target over its distance; nan if all are flat


def cover(points: Correspondences, views: Views, state: CameraState) -> Coverage:
    """Coverage by the points of a calibration."""
    tilt = 90.0
    if views.nearly_flat.all():
        normals = (state.R @ views.basis)[:, :, 2]
        smallest = np.abs(normals @ normals.T).min()
        tilt = float(np.degrees(np.arccos(np.clip(smallest, 0, 1))))
    relief = _relief(points, views, state)
    if points.image_size is None:
        return Coverage(np.nan, "", tilt, relief)
    size = np.array(points.image_size, dtype=float)
    inside = ((points.pixels >= -0.5) & (points.pixels <= size - 0.5)).all(axis=1)
    held = np.zeros((_CELLS, _CELLS))  # whether each cell of the image, row by row, holds a point
    column, row = np.clip(((points.pixels[inside] + 0.5) / size * _CELLS).astype(int), 0, _CELLS - 1).T
    held[row, column] = 1.0
    thirds = held.reshape(3, _CELLS // 3, 3, _CELLS // 3).mean(axis=(1, 3))
    v, u = np.unravel_index(int(np.argmin(thirds)), thirds.shape)
    empty = _THIRDS[v][u] if thirds[v, u] < 0.5 else ""
    return Coverage(float(held.mean()), empty, tilt, relief)


def _relief(points: Correspondences, views: Views, state: CameraState) -> float:
    solid = np.flatnonzero(~views.nearly_flat)
    if not solid.size:
        return np.nan
    away = np.linalg.norm(state.t * views.scale[:, None], axis=1)  # of each view's centroid
    along = [points.world[points.view_index == k] @ views.basis[k][:, 2] for k in solid]
    return max(float(np.ptp(one)) / float(away[k]) for one, k in zip(along, solid, strict=True))

"""Points without the distortion of a lens, with their covariances."""

from __future__ import annotations

from dataclasses import replace
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurocal_cli.camera.camera import Calibrated, Camera, camera_of
from neurocal_cli.camera.geometry import Array, Shape
from neurocal_cli.camera.given_values import real_rows
from neurocal_cli.camera.undistortion import (
    Undistorted,
    distorted_by_undistorted,
    undistort_pixels,
    undistorted_view,
)
from neurocal_cli.errors import InputError
from neurocal_cli.observations.measured_directions import unit
from neurocal_cli.observations.points import Correspondences


@overload
def undistort_points(
    points: Correspondences,
    camera: Camera | Calibrated,
    alpha: float | None = None,
    to: Shape = "plane",
    fov: float | None = None,
) -> Correspondences: ...


@overload
def undistort_points(
    points: ArrayLike,
    camera: Camera | Calibrated,
    alpha: float | None = None,
    to: Shape = "plane",
    fov: float | None = None,
) -> Array: ...


def undistort_points(
    points: Correspondences | ArrayLike,
    camera: Camera | Calibrated,
    alpha: float | None = None,
    to: Shape = "plane",
    fov: float | None = None,
) -> Correspondences | Array:
    """Undistort points.

    Parameters
    ----------
    points : Correspondences, or (..., 2) array of pixels
        Covariances and the image centre of Correspondences, where given, are transformed as well.
    camera : Camera or Calibration
    alpha : float, optional
        See `new_matrix`; None keeps the camera's own matrix. For a plane without `fov`.
    to : {"plane", "cylinder", "equirectangular"}
    fov : float, optional [degrees]
        Field of view from left to right; see `undistorted_view`.

    Returns
    -------
    Correspondences, or (..., 2) array
        Pixels of a camera without distortion. They are pixels, not the normalised coordinates that
        ``cv2.undistortPoints`` returns without ``P``.

    Raises
    ------
    InputError
        A pixel that the distortion does not reach, or that a plane cannot show, named by its file and line.
    """
    camera = camera_of(camera)
    if not isinstance(points, Correspondences):
        pixels = real_rows("pixels", points, 2, stacked=True)
        if not pixels.size:
            return pixels
        flat = pixels.reshape(-1, 2)
        rows = Correspondences(np.zeros((len(flat), 3)), flat, image_size=camera.image_size, source="pixels")
        return undistort_points(rows, camera, alpha, to, fov).pixels.reshape(pixels.shape)
    return map_points(points, camera, undistorted_view(camera, points.image_size, to, fov, alpha=alpha))


def shown(
    points: Correspondences, camera: Camera, new: Undistorted, R: Array | None = None
) -> NDArray[np.bool_]:
    """Which points are not beyond the edge of what a plane can show; those that no camera sees count too."""
    rays = camera.unproject(points.pixels)
    return ~np.isfinite(rays[:, 0]) | new.project(rays if R is None else rays @ R.T)[1]


def map_points(
    points: Correspondences, camera: Camera, new: Undistorted, R: Array | None = None
) -> Correspondences:
    """Convert points to the pixels of another camera with the same centre, without distortion.

    Their covariances and the image centre, where given, are transformed as well. If the camera has
    distortion, `undistorted` of the result names the shape. R (3, 3) is from the camera's frame to that of
    the new one, where it is turned as well. Raises InputError for a pixel that the distortion does not
    reach, or that a plane cannot show, named by its file and line.
    """
    pixels = undistort_pixels(camera, new, points.pixels, R)
    lost = ~np.isfinite(pixels[:, 0])
    if lost.any():
        row = int(np.argmax(lost))
        u, v = points.pixels[row]
        if np.isfinite(camera.unproject(points.pixels[row])).all():
            raise InputError(
                f"{points.place(row)}: the ray of the pixel ({u:g}, {v:g}) is 90 degrees or more from the "
                "axis, which no plane shows; choose a cylinder, or remove the row"
            )
        raise InputError(
            f"{points.place(row)}: the distortion maps nothing to the pixel ({u:g}, {v:g}); correct "
            "or remove the row, and check that the camera belongs to these points"
        )
    size = points.image_size and new.image_size
    undistorted = replace(points, pixels=pixels, image_size=size)
    if not camera.distortion.is_identity:
        undistorted = replace(undistorted, undistorted="plane" if isinstance(new, Camera) else new.shape)
    if points.covariance is not None or points.across is not None:
        inverse = distorted_by_undistorted(camera, new, pixels, R)
        if points.covariance is not None:
            # To first order C' = M C M^T, with the derivative M of the undistorted pixel by the other one.
            M = np.linalg.inv(inverse)
            C = points.covariance[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
            C = (M @ C @ np.swapaxes(M, 1, 2)).reshape(-1, 4)[:, [0, 1, 3]]
            undistorted = replace(undistorted, covariance=C)
        if points.across is not None:
            # Only n . m is measured of a pixel m, and so n^T M^-1 m' of the undistorted pixel m'.
            n = (points.across[:, None, :] @ inverse)[:, 0]
            undistorted = replace(undistorted, across=unit(n))
    if points.image_center is not None:
        u0, v0 = undistort_pixels(camera, new, np.array([points.image_center]), R)[0].tolist()
        undistorted = replace(undistorted, image_center=(u0, v0) if np.isfinite(u0 + v0) else None)
    return undistorted

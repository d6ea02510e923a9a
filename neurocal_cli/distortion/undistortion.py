"""Undistortion: points, and the places from which undistorted images take their pixels.

A pixel m of a camera A with distortion becomes the pixel m' of a camera A' without:

    x = undistort(A^-1 m),   m' = A' x

A' is A itself, skew included, unless alpha says otherwise (`new_matrix`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.measured_directions import unit
from neurocal_cli.calibration import Calibration, camera_of
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.monotonic import monotonic_radius
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.projection import image_points_with_jacobian
from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array
from neurocal_cli.points import Correspondences

__all__ = ["new_matrix", "sources", "undistort_pixels", "undistort_points", "undistorted_camera"]

# With these, no pixel of an image at alpha 0 comes from more than 0.02 px outside
# (tests/test_undistortion.py).
_BORDER = 401  # pixels looked at along each side of the image
_GRID = 41  # and inside, along each axis
_HALF_PIXEL = 0.5
_WIDEST = 5.0  # 79 degrees to a side; a plane picture of more shows next to nothing


def undistorted_camera(
    camera: Camera, alpha: float | None = None, size: tuple[int, int] | None = None
) -> Camera:
    """The camera of undistorted pixels.

    Parameters
    ----------
    camera : Camera
    alpha : float, optional
        See `new_matrix`; None keeps the camera's own matrix.
    size : (width, height), optional [px]
        Of the images, for alpha; else the camera's.

    Raises
    ------
    InputError
        No image size for alpha, or a distortion that leaves no picture.
    """
    size = size or camera.image_size
    intrinsics = camera.intrinsics
    if alpha is not None:
        if size is None:
            raise InputError(
                "alpha needs the size of the images, which neither the camera nor the points have; add "
                "image_size"
            )
        intrinsics = new_matrix(camera, size, alpha)
    return Camera(intrinsics, Distortion(), size, camera.name)


def undistort_pixels(camera: Camera, new: Camera, pixels: Array) -> Array:
    """Undistorted pixels, (N, 2); ``nan`` where the camera cannot have seen any."""
    return np.column_stack(new.image_points(*camera.normalised_points(*pixels.T)))


def sources(camera: Camera, new: Camera, u: Array, v: Array) -> tuple[Array, Array]:
    """Where pixels (u, v) of an undistorted image come from; ``nan`` where the camera sees nothing.

    Parameters
    ----------
    camera, new : Camera
        With and without distortion.
    u, v : arrays of one shape [px]
    """
    x, y = new.normalised_points(u, v)
    with np.errstate(all="ignore"):
        u, v, _, _, (ux, uy, vx, vy), _ = image_points_with_jacobian(
            camera.entries, camera.model, camera.distortion.coefficients, x, y
        )
        seen = (x * x + y * y < monotonic_radius(camera.distortion) ** 2) & (ux * vy > uy * vx)
    return np.where(seen, u, np.nan), np.where(seen, v, np.nan)


def _distorted_by_undistorted(camera: Camera, new: Camera, pixels: Array) -> Array:
    """(N, 2, 2) derivative of the pixels as seen by the undistorted ones (N, 2)."""
    x, y = new.normalised_points(*pixels.T)
    return np.asarray(camera.image_jacobian(x, y) @ np.linalg.inv(new.A[:2, :2]))


def new_matrix(camera: Camera, size: tuple[int, int], alpha: float) -> Intrinsics:
    """Camera matrix for undistorted images of the same size, as OpenCV's getOptimalNewCameraMatrix means it.

    Parameters
    ----------
    camera : Camera
    size : (width, height) [px]
    alpha : float
        0: the largest rectangle of which every pixel was seen fills the image; 1: all pixels that were
        seen are shown, the rest is black; in between, the matrices are mixed.

    Returns
    -------
    intrinsics : Intrinsics
        Without skew. Its two scale factors differ as the rectangle's sides do.

    Raises
    ------
    InputError
        The distortion leaves no rectangle.
    """
    width, height = size
    corner = np.array([width - 1, height - 1], dtype=float)
    if not 0 <= alpha <= 1 or min(size) < 2:
        raise InputError("alpha must be from 0 to 1, and the image must have more than one pixel a side")
    low, high = _inner(camera, corner)
    if not ((low < high).all() and _is_inside(camera, corner, low, high)):
        raise InputError(
            "the undistorted image has no rectangle of valid pixels; check that the camera belongs "
            "to images of this size, or leave out alpha"
        )
    inner = corner / (high - low)
    least, most = _outer(camera, corner)
    least, most = np.fmin(least, low), np.fmax(most, high)
    outer = corner / (most - least)
    (a, b), (u0, v0) = (
        (1 - alpha) * inner + alpha * outer,
        (1 - alpha) * -inner * low + alpha * -outer * least,
    )
    return Intrinsics(a, b, u0, v0)


def _inner(camera: Camera, corner: Array) -> tuple[Array, Array]:
    """Lower and upper corner of the rectangle of undistorted points that are all seen."""
    share, zero = np.linspace(0, 1, _BORDER), np.zeros(_BORDER)
    # What lies beyond the monotonic radius binds nothing, but the rectangle must stay within it.
    most = min(_WIDEST, monotonic_radius(camera.distortion) / np.sqrt(2))
    low, high = np.full(2, -most), np.full(2, most)
    for axis in (0, 1):
        for end in (0.0, 1.0):
            side = [zero + end, share] if axis == 0 else [share, zero + end]
            straight = camera.normalised_points(side[0] * corner[0], side[1] * corner[1])[axis]
            straight = straight[np.isfinite(straight)]
            if end == 0:
                low[axis] = max(low[axis], straight.max(initial=-most))
            else:
                high[axis] = min(high[axis], straight.min(initial=most))
    return low, high


def _is_inside(camera: Camera, corner: Array, low: Array, high: Array) -> bool:
    """Whether the border of a rectangle of undistorted points was seen within the image."""
    x, y = (low + _along_border() * (high - low)).T
    seen = np.column_stack(camera.image_points(x, y))
    return bool((seen > -_HALF_PIXEL).all() and (seen < corner + _HALF_PIXEL).all())


def _along_border() -> Array:
    """Points all around the unit square, (N, 2)."""
    share = np.linspace(0, 1, _BORDER)
    ends = (0 * share, 0 * share + 1)
    return np.concatenate([np.column_stack(p) for end in ends for p in ((end, share), (share, end))])


def _outer(camera: Camera, corner: Array) -> tuple[Array, Array]:
    """Lower and upper corner of the rectangle around all undistorted points that are seen."""
    u, v = np.meshgrid(np.linspace(0, 1, _GRID), np.linspace(0, 1, _GRID))
    pixels = np.concatenate([np.column_stack([u.ravel(), v.ravel()]), _along_border()]) * corner
    straight = np.column_stack(camera.normalised_points(*pixels.T))
    straight = straight[np.isfinite(straight[:, 0])].clip(-_WIDEST, _WIDEST)
    return straight.min(axis=0, initial=np.inf), straight.max(axis=0, initial=-np.inf)


def undistort_points(
    points: Correspondences, camera: Camera | Calibration, alpha: float | None = None
) -> Correspondences:
    """Points as a camera without distortion would have seen them.

    Parameters
    ----------
    points : Correspondences
        Covariances, and the image centre if there is one, are carried over.
    camera : Camera or Calibration
    alpha : float, optional
        See `new_matrix`; None keeps the camera's own matrix.

    Raises
    ------
    InputError
        A pixel that the lens cannot have seen, named by its place.
    """
    camera = camera_of(camera)
    new = undistorted_camera(camera, alpha, points.image_size)
    pixels = undistort_pixels(camera, new, points.pixels)
    lost = ~np.isfinite(pixels[:, 0])
    if lost.any():
        row = int(np.argmax(lost))
        u, v = points.pixels[row]
        raise InputError(
            f"{points.place(row)}: the distortion maps nothing to the pixel ({u:g}, {v:g}); correct "
            "or remove the row, and check that the camera belongs to these points"
        )
    undistorted = replace(points, pixels=pixels)
    if points.covariance is not None:
        # To first order C' = M C M^T, with M the derivative of the undistorted pixel by the seen one.
        M = np.linalg.inv(_distorted_by_undistorted(camera, new, pixels))
        C = points.covariance[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        C = (M @ C @ np.swapaxes(M, 1, 2)).reshape(-1, 4)[:, [0, 1, 3]]
        undistorted = replace(undistorted, covariance=C)
    if points.across is not None:
        # What is known of a pixel m is n . m, and so of the undistorted one n^T M^-1 m'.
        n = (points.across[:, None, :] @ _distorted_by_undistorted(camera, new, pixels))[:, 0]
        undistorted = replace(undistorted, across=unit(n))
    if points.image_center is not None:
        u0, v0 = undistort_pixels(camera, new, np.array([points.image_center]))[0].tolist()
        undistorted = replace(undistorted, image_center=(u0, v0) if np.isfinite(u0 + v0) else None)
    return undistorted

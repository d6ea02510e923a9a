"""Undistorted pixels, and the source pixels of undistorted images.

A pixel m of a camera with distortion becomes the pixel m' of its ray on a plane, a cylinder or a sphere
(`undistorted_view`). On a plane, with A' without distortion, that is

    x = undistort(A^-1 m),   m' = A' x

A' is A itself, skew included, unless alpha is given (`new_matrix`) or the lens is wide (`undistorted_view`).
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.monotonic import largest_angle, monotonic_radius
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.projection import image_points_with_jacobian, project_points
from neurocal_cli.camera.undistorted_view import Undistorted, plane_like, undistorted_view
from neurocal_cli.errors import InputError

# With these, no pixel at alpha 0 comes from more than 0.02 px outside; tests/test_undistortion.py repeats it.
_BORDER = 401  # samples along each side of the image
_GRID = 41  # samples along each axis inside it
_HALF_PIXEL = 0.5
_WIDEST = 5.0  # tangent of 79 degrees: the widest angle from the axis in an undistorted image


def undistorted_camera(
    camera: Camera, alpha: float | None = None, size: tuple[int, int] | None = None
) -> Camera:
    """The camera of undistorted pixels.

    alpha is that of `new_matrix`; None keeps the camera's own matrix, of a wide lens its scale in the middle.
    The size of the images is needed for alpha, and is by default the camera's. Raises InputError if there is
    none, or if the distortion leaves no picture.
    """
    size = size or camera.image_size
    intrinsics = plane_like(camera)
    if alpha is not None:
        intrinsics = new_matrix(camera, _known("alpha", size), alpha)
    return Camera(intrinsics, Distortion(), size, camera.name)


def _known(what: str, size: tuple[int, int] | None) -> tuple[int, int]:
    if size is None:
        raise InputError(
            f"{what} needs the size of the images, which neither the camera nor the points have; add "
            "image_size"
        )
    return size


def undistort_pixels(camera: Camera, new: Undistorted, pixels: Array, R: Array | None = None) -> Array:
    """Undistorted pixels, (N, 2); ``nan`` where there are none.

    R (3, 3) is from the camera's frame to that of the new one, where it is turned as well.
    """
    rays = camera.unproject(pixels)
    return new.project(rays if R is None else rays @ R.T)[0]


def sources(
    camera: Camera, new: Undistorted, u: Array, v: Array, R: Array | None = None
) -> tuple[Array, Array]:
    """Source pixels of pixels u, v, arrays of one shape, of an undistorted image; ``nan`` where none is.

    R (3, 3) is from the camera's frame to that of the new one, where it is turned as well.
    """
    X, Y, Z = _directions(new, u, v)
    if R is not None:
        X, Y, Z = np.tensordot(R.T, np.stack([X, Y, Z]), axes=1)
    with np.errstate(all="ignore"):
        if camera.distortion.wide:
            u, v, seen = project_points(camera.entries, camera.model, camera.distortion.coefficients, X, Y, Z)
            valid = seen & (np.arctan2(np.hypot(X, Y), Z) < largest_angle(camera.distortion))
        else:
            x, y = X / Z, Y / Z
            u, v, _, _, (ux, uy, vx, vy), _ = image_points_with_jacobian(
                camera.entries, camera.model, camera.distortion.coefficients, x, y
            )
            valid = (x * x + y * y < monotonic_radius(camera.distortion) ** 2) & (ux * vy > uy * vx) & (Z > 0)
    return np.where(valid, u, np.nan), np.where(valid, v, np.nan)


def _directions(new: Undistorted, u: Array, v: Array) -> tuple[Array, Array, Array]:
    if not isinstance(new, Camera):
        return new.directions(u, v)
    x, y = new.normalised_points(u, v)
    return x, y, np.ones_like(x)


def distorted_by_undistorted(camera: Camera, new: Undistorted, pixels: Array, R: Array | None) -> Array:
    """(N, 2, 2) derivative of the distorted pixels by the undistorted ones (N, 2)."""
    u, v = pixels.T
    rays = np.column_stack(_directions(new, u, v))
    if isinstance(new, Camera):
        slopes = np.vstack([np.linalg.inv(new.A[:2, :2]), np.zeros(2)])
    else:
        slopes = new.slopes(u, v)
    if R is not None:
        rays, slopes = rays @ R, R.T @ slopes
    return np.asarray(camera.project_jacobian(rays)[1] @ slopes)


def new_matrix(camera: Camera, size: tuple[int, int], alpha: float) -> Intrinsics:
    """Camera matrix for undistorted images of the same size, as in OpenCV's getOptimalNewCameraMatrix.

    With alpha = 0 the largest rectangle of valid pixels fills the image. With 1 the image shows all pixels of
    the distorted one, and the rest is black. Values in between interpolate the two matrices. The result has
    no skew, and the ratio of its scale factors is that of the rectangle's sides. Raises InputError if the
    distortion leaves no rectangle.
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
    scale = (1 - alpha) * inner + alpha * outer
    centre = (1 - alpha) * -inner * low + alpha * -outer * least
    return Intrinsics(*scale, *centre)


def _inner(camera: Camera, corner: Array) -> tuple[Array, Array]:
    """Lower and upper corner of the largest rectangle of valid undistorted points."""
    share, zero = np.linspace(0, 1, _BORDER), np.zeros(_BORDER)
    # Borders beyond the monotonic radius set no limit, but the rectangle must stay within this radius.
    most = min(_WIDEST, monotonic_radius(camera.distortion) / np.sqrt(2))
    low, high = np.full(2, -most), np.full(2, most)
    for axis in (0, 1):
        for end in (0.0, 1.0):
            side = [zero + end, share] if axis == 0 else [share, zero + end]
            border = camera.normalised_points(side[0] * corner[0], side[1] * corner[1])[axis]
            border = border[np.isfinite(border)]
            if end == 0:
                low[axis] = max(low[axis], border.max(initial=-most))
            else:
                high[axis] = min(high[axis], border.min(initial=most))
    return low, high


def _is_inside(camera: Camera, corner: Array, low: Array, high: Array) -> bool:
    """Whether the border of a rectangle of undistorted points is inside the distorted image."""
    x, y = (low + _along_border() * (high - low)).T
    pixels = np.column_stack(camera.image_points(x, y))
    return bool((pixels > -_HALF_PIXEL).all() and (pixels < corner + _HALF_PIXEL).all())


def _along_border() -> Array:
    """Points all around the unit square, (N, 2)."""
    share = np.linspace(0, 1, _BORDER)
    ends = (0 * share, 0 * share + 1)
    return np.concatenate([np.column_stack(p) for end in ends for p in ((end, share), (share, end))])


def _outer(camera: Camera, corner: Array) -> tuple[Array, Array]:
    """Lower and upper corner of the bounding rectangle of all undistorted points."""
    u, v = np.meshgrid(np.linspace(0, 1, _GRID), np.linspace(0, 1, _GRID))
    pixels = np.concatenate([np.column_stack([u.ravel(), v.ravel()]), _along_border()]) * corner
    points = np.column_stack(camera.normalised_points(*pixels.T))
    points = points[np.isfinite(points[:, 0])].clip(-_WIDEST, _WIDEST)
    return points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)


def chosen_view(
    camera: Camera,
    alpha: float | None,
    to: str,
    fov: float | None,
    size: tuple[int, int] | None,
    new_size: tuple[int, int] | None = None,
) -> Undistorted:
    """The camera of undistorted pixels, by alpha, or by shape, field of view and size.

    Raises InputError for both of them, and if there is no image size where one is needed.
    """
    if to == "plane" and fov is None and new_size is None:
        return undistorted_camera(camera, alpha, size)
    if alpha is not None:
        raise InputError("alpha is of a plane whose field of view and size are not given; leave it out")
    size = _known("a field of view", size or camera.image_size)
    return undistorted_view(camera, size, to, fov, new_size)

"""The projection of undistorted images, their pixels, and the source pixels of these.

A pixel m of a camera with distortion becomes the pixel m' of its ray on a plane, a cylinder or a sphere. On a
plane, with A' without distortion, that is

    x = undistort(A^-1 m),   m' = A' x

A' is A itself, skew included, unless alpha is given (`new_matrix`) or the lens is wide (`plane_like`).
A plane shows less than 180 degrees, and its scale grows outwards with 1 / cos^2 of the angle. On a panorama,
a ray (X, Y, Z) has the longitude lambda = atan2(X, Z) and the latitude phi = atan2(Y, hypot(X, Z)):

    cylinder          u = f lambda + u0,  v = f tan(phi) + v0
    equirectangular   u = f lambda + u0,  v = f phi + v0

and back, with lambda = (u - u0) / f:

    cylinder          (sin lambda, (v - v0) / f, cos lambda)
    equirectangular   (cos phi sin lambda, sin phi, cos phi cos lambda),  phi = (v - v0) / f

On both, lines parallel to the camera's y axis are vertical. f is in pixels a radian. The optical axis keeps
its pixel, scaled if the image size changes. In a panorama with a given field of view it lies in the middle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import UNDISTORTED, Array
from neurocal_cli.camera.monotonic import largest_angle, monotonic_radius
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.projection import image_points_with_jacobian, project_points
from neurocal_cli.errors import InputError

PANORAMAS = UNDISTORTED[1:]

_ALONG = 1001  # pixels along a row and a column
_WIDEST_PLANE = 170.0  # degrees
_NARROW = 1e-3  # rad
# With these, no pixel at alpha 0 comes from more than 0.02 px outside; test_undistortion.py repeats it.
_BORDER = 401  # samples along each side of the image
_GRID = 41  # samples along each axis inside it
_HALF_PIXEL = 0.5
_WIDEST = 5.0  # tangent of 79 degrees: the widest angle from the axis in an undistorted image


@frozen_dataclass
class Panorama:
    """An image on a cylinder or a sphere around the camera.

    Raises InputError for another shape, or a scale that is not positive.
    """

    shape: str  # one of `PANORAMAS`
    f: float  # px/rad
    u0: float  # px; with v0 the pixel of the z axis
    v0: float
    image_size: tuple[int, int]  # (width, height) [px]
    name: str = "camera"

    def __post_init__(self) -> None:
        if self.shape not in PANORAMAS:
            raise InputError(f"a panorama is one of {', '.join(PANORAMAS)}, not {self.shape[:40]!r}")
        if not (np.isfinite([self.f, self.u0, self.v0]).all() and self.f > 0):
            raise InputError(f"a panorama needs a positive scale, found {self.f:g} px per radian")

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels of points (..., 3) of the camera's frame, and whether they exist: not at the poles."""
        X, Y, Z = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
        across = np.hypot(X, Z)
        shown = np.asarray(across > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            height = Y / across if self.shape == "cylinder" else np.arctan2(Y, across)
            pixels = np.stack([self.f * np.arctan2(X, Z) + self.u0, self.f * height + self.v0], axis=-1)
        return np.where(shown[..., None], pixels, np.nan), shown

    def unproject(self, pixels: Array) -> Array:
        """Unit rays (..., 3) of pixels (..., 2); ``nan`` beyond half a turn, and beyond a pole."""
        u, v = np.moveaxis(np.asarray(pixels, dtype=float), -1, 0)
        rays = np.stack(self.directions(u, v), axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def directions(self, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """The same as three arrays, which on a cylinder are not of unit length."""
        longitude, height = (u - self.u0) / self.f, (v - self.v0) / self.f
        longitude = np.where(np.abs(longitude) <= np.pi, longitude, np.nan)
        if self.shape == "cylinder":
            return np.sin(longitude), height + 0 * longitude, np.cos(longitude)
        latitude = np.where(np.abs(height) <= np.pi / 2, height, np.nan)
        across = np.cos(latitude)
        return across * np.sin(longitude), np.sin(latitude) + 0 * longitude, across * np.cos(longitude)

    def slopes(self, u: Array, v: Array) -> Array:
        """(N, 3, 2) derivatives of `directions` by the pixels (N,)."""
        X, Y, Z = self.directions(u, v)
        by_u = np.stack([Z, 0 * Y, -X], axis=-1)
        if self.shape == "cylinder":
            by_v = np.stack([0 * Y, 1 + 0 * Y, 0 * Y], axis=-1)
        else:
            longitude = (u - self.u0) / self.f
            by_v = np.stack([-Y * np.sin(longitude), np.hypot(X, Z), -Y * np.cos(longitude)], axis=-1)
        return np.asarray(np.stack([by_u, by_v], axis=-1) / self.f)


Undistorted = Camera | Panorama


class Field(NamedTuple):
    """Field of view of an image along the row and the column of its optical axis, as angles from it [rad].

    Those to the left and the top are negative.
    """

    left: float
    right: float
    top: float
    bottom: float

    @property
    def degrees(self) -> tuple[float, float]:
        """From left to right, and from top to bottom."""
        across, down = np.degrees([self.right - self.left, self.bottom - self.top]).tolist()
        return across, down

    def common(self, other: Field) -> Field:
        """The intersection of both fields of view."""
        return Field(
            max(self.left, other.left), min(self.right, other.right),
            max(self.top, other.top), min(self.bottom, other.bottom),
        )  # fmt: skip


def undistorted_view(
    camera: Camera,
    size: tuple[int, int] | None = None,
    shape: str = "plane",
    fov: float | None = None,
    new_size: tuple[int, int] | None = None,
    alpha: float | None = None,
) -> Undistorted:
    """Choose the projection of undistorted images, one of `UNDISTORTED`, for images of some size [px].

    A plane keeps the camera's matrix, of a wide lens its scale in the middle, unless alpha of `new_matrix` or
    the field of view from left to right [degrees] is given; by default the other shapes show the whole field
    of view. The size of the images is by default the camera's; the undistorted ones have the same, unless a
    new one is given. Raises InputError if the shape does not exist, or cannot show that field of view, if
    alpha is not all that is given, and if the size is needed and not known.
    """
    size = size or camera.image_size
    own = shape == "plane" and fov is None and new_size in (None, size)
    if alpha is not None and not own:
        raise InputError("alpha is of a plane whose field of view and size are not given; leave it out")
    if own and alpha is None:
        return Camera(plane_like(camera), Distortion(), size, camera.name)
    if size is None:
        raise InputError(
            f"{'a field of view' if alpha is None else 'alpha'} needs the size of the images, which neither "
            "the camera nor the points have; add image_size"
        )
    if alpha is not None:
        return Camera(new_matrix(camera, size, alpha), Distortion(), size, camera.name)
    if shape not in UNDISTORTED:
        raise InputError(f"the shape must be one of {', '.join(UNDISTORTED)}, not {shape[:40]!r}")
    most = _WIDEST_PLANE if shape == "plane" else 360.0
    if fov is not None and not 0 < fov <= most:
        raise InputError(
            f"a {shape} shows at most {most:g} degrees, not {fov:g}"
            + ("; use a cylinder" if shape == "plane" and 0 < fov <= 360 else "")
        )
    new_size = new_size or size
    factors = np.array(new_size) / size
    u0, v0 = (_axis(camera, size) + 0.5) * factors - 0.5
    left, right = float(u0 + 0.5), float(new_size[0] - 0.5 - u0)  # of the axis
    if shape == "plane":
        if fov is None:
            plain = Camera(plane_like(camera), Distortion(), size, camera.name)
            return plain.rescaled((float(factors[0]), float(factors[1])))
        # atan(left / f) + atan(right / f) = fov: with the tangent of the sum, a quadratic equation.
        half = 0.5 * (left + right) / np.tan(np.radians(fov))
        f = float(half + np.sqrt(half * half + left * right))
        return Camera(Intrinsics(f, f, float(u0), float(v0)), Distortion(), new_size, camera.name)
    if fov is None:
        field = field_of_view(camera, size)
        f = min(left / max(-field.left, _NARROW), right / max(field.right, _NARROW))
    else:
        f = new_size[0] / np.radians(fov)
        u0, v0 = 0.5 * (np.array(new_size) - 1.0)
    return Panorama(shape, float(f), float(u0), float(v0), new_size, camera.name)


def field_of_view(camera: Undistorted, size: tuple[int, int]) -> Field:
    """The field of view of images of some size; an InputError if that row or column has no rays."""
    ends = []
    for axis in (0, 1):  # the row, then the column
        line = np.tile(_axis(camera, size), (_ALONG, 1))
        line[:, axis] = np.linspace(0, 1, _ALONG) * size[axis] - 0.5
        rays = camera.unproject(line)
        angle = np.arctan2(rays[:, axis], rays[:, 2])
        angle = angle[np.isfinite(angle)]
        if not len(angle):
            raise InputError("the camera sees nothing in the middle of its image; correct the camera")
        ends += [float(angle.min()), float(angle.max())]
    return Field(*ends)


def _axis(camera: Undistorted, size: tuple[int, int]) -> Array:
    """Pixel of the optical axis, or the nearest one in the image."""
    pixel = camera.project(np.array([0.0, 0.0, 1.0]))[0]
    return np.asarray(np.clip(pixel, 0, np.array(size) - 1.0))


def plane_like(camera: Camera) -> Intrinsics:
    """Camera matrix of a plane with the scale of the image centre; the camera's own unless it is wide."""
    if not camera.distortion.wide:
        return camera.intrinsics
    A = camera.A.copy()
    A[:2, :2] = camera.project_jacobian(np.array([[0.0, 0.0, 1.0]]))[1][0, :, :2]
    A[1, 0] = 0.0  # up to rounding
    return Intrinsics.from_matrix(A)


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

"""The projection of undistorted images: plane, cylinder or sphere, and field of view.

The optical axis keeps its pixel, scaled if the image size changes. In a panorama with a given field of view
it lies in the middle. A plane shows less than 180 degrees, and its scale grows outwards with 1 / cos^2 of the
angle. On a panorama, a ray (X, Y, Z) has the longitude lambda = atan2(X, Z) and the latitude
phi = atan2(Y, hypot(X, Z)):

    cylinder          u = f lambda + u0,  v = f tan(phi) + v0
    equirectangular   u = f lambda + u0,  v = f phi + v0

and back, with lambda = (u - u0) / f:

    cylinder          (sin lambda, (v - v0) / f, cos lambda)
    equirectangular   (cos phi sin lambda, sin phi, cos phi cos lambda),  phi = (v - v0) / f

On both, lines parallel to the camera's y axis are vertical. f is in pixels a radian.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import UNDISTORTED, Array
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.errors import InputError

SHAPES = UNDISTORTED
PANORAMAS = SHAPES[1:]

_ALONG = 1001  # pixels along a row and a column
_WIDEST_PLANE = 170.0  # degrees
_NARROW = 1e-3  # rad


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


def undistorted_view(
    camera: Camera,
    size: tuple[int, int],
    shape: str = "plane",
    fov: float | None = None,
    new_size: tuple[int, int] | None = None,
) -> Undistorted:
    """Choose the projection of undistorted images, one of `SHAPES`, for images of some size [px].

    The field of view is from left to right [degrees]. By default a plane keeps the scale of the image centre;
    the other shapes show the whole field of view. The undistorted images have the same size, unless a new one
    is given. Raises InputError if the shape does not exist, or cannot show that field of view.
    """
    if shape not in SHAPES:
        raise InputError(f"the shape must be one of {', '.join(SHAPES)}, not {shape[:40]!r}")
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
            return plain.rescaled((float(factors[0]), float(factors[1]))) if new_size != size else plain
        f = _scale_of_plane(left, right, np.radians(fov))
        return Camera(Intrinsics(f, f, float(u0), float(v0)), Distortion(), new_size, camera.name)
    if fov is None:
        field = field_of_view(camera, size)
        f = min(left / max(-field.left, _NARROW), right / max(field.right, _NARROW))
    else:
        f = new_size[0] / np.radians(fov)
        u0, v0 = 0.5 * (np.array(new_size) - 1.0)
    return Panorama(shape, float(f), float(u0), float(v0), new_size, camera.name)


def _scale_of_plane(left: float, right: float, fov: float) -> float:
    """Find f with atan(left / f) + atan(right / f) = fov: the tangent of the sum, a quadratic equation."""
    half = 0.5 * (left + right) / np.tan(fov)
    return float(half + np.sqrt(half * half + left * right))

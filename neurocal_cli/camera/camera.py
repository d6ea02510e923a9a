"""A camera: its matrix A, its distortion and the size of its images.

Pixels: the centre of the top-left pixel is (0, 0), so that an image of width w covers u from -1/2 to w - 1/2.
Points are in the camera's own frame, x right, y down, z forward; a `Pose` takes them there from the world.
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera import projection
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.given_values import checked_size, real_array, real_rows
from neurocal_cli.camera.monotonic import is_monotonic, largest_angle, undistort, unproject_directions
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.camera.resizing import Resizing
from neurocal_cli.errors import InputError, UsageError


@frozen_dataclass
class Camera:
    """A camera without a pose.

    Parameters
    ----------
    intrinsics : Intrinsics
        alpha_u, alpha_v, u0, v0 [px] and theta; `Intrinsics.from_matrix` reads them off A.
    distortion : Distortion
        It is applied to normalised image points, before A (skew included).
    image_size : (width, height), optional [px]
    name : str
        Name of the camera in files.

    Raises
    ------
    InputError
        Intrinsics or a distortion of another type, or sides of the image that are not whole numbers from 1
        to a million.

    Examples
    --------
    >>> camera = Camera(Intrinsics(800, 800, 319.5, 239.5), Distortion("k1", [-0.2]), (640, 480))
    >>> pixels, in_front = camera.project(np.array([[0.1, 0.2, 1.0]]))
    >>> pixels.round(2)
    array([[398.7, 397.9]])
    >>> ray = camera.unproject(pixels)
    >>> np.round(ray / ray[:, 2:], 9)
    array([[0.1, 0.2, 1. ]])
    """

    intrinsics: Intrinsics
    distortion: Distortion = field(default_factory=Distortion)
    image_size: tuple[int, int] | None = None
    name: str = "camera"

    def __post_init__(self) -> None:
        if self.image_size is not None:
            object.__setattr__(self, "image_size", checked_size(self.image_size))

    @cached_property
    def A(self) -> Array:
        """(3, 3) camera matrix, skew included."""
        A = self.intrinsics.A
        A.setflags(write=False)
        return A

    @cached_property
    def entries(self) -> tuple[float, float, float, float, float]:
        """A11, A12, A22, A13, A23 [px] as plain numbers."""
        a, s, b, u0, v0 = self.A[projection.ENTRIES].tolist()
        return a, s, b, u0, v0

    @cached_property
    def model(self) -> str:
        """Name of its distortion model; "none" if the distortion is the identity."""
        return "none" if self.distortion.is_identity else self.distortion.model

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Project points, paper eq. (1).

        Parameters
        ----------
        points : (..., 3) array
            In the camera's frame, in any unit.

        Returns
        -------
        pixels : (..., 2) array [px]
            ``nan`` for points that are not in front of the camera, or outside the domain of a wide lens.
        in_front : (...) bool array
            Whether the point has a pixel.

        Raises
        ------
        InputError
            An array of another shape.
        """
        X, Y, Z = _coordinates("points", points, 3)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v, seen = projection.project_points(
                self.entries, self.model, self.distortion.coefficients, X, Y, Z
            )
            pixels = np.stack([u, v], axis=-1)
        return np.where(seen[..., None], pixels, np.nan), seen

    def sees(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 3) lie in front of the camera, where its distortion is monotonic."""
        X, Y, Z = _coordinates("points", points, 3)
        if self.distortion.wide:
            within = np.arctan2(np.hypot(X, Y), Z) < largest_angle(self.distortion)
            return np.asarray(within & self.project(points)[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((Z > 0) & is_monotonic(self.distortion, X / Z, Y / Z))

    def shows(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 3) are in the image, as far as its size is known; see `sees`."""
        seen = self.sees(points)
        if self.image_size is None:
            return seen
        pixels = self.project(points)[0]
        return seen & ((pixels >= -0.5) & (pixels <= np.array(self.image_size) - 0.5)).all(axis=-1)

    def project_jacobian(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of the pixels of points (N, 3).

        Returns
        -------
        by_camera : (N, 2, 5 + K) array
            By A11, A12, A22, A13, A23 and the coefficients of the distortion.
        by_point : (N, 2, 3) array
        """
        points = real_rows("points", points, 3)
        k = self.distortion.coefficients
        J = np.zeros((8 + len(k), 2, len(points)))
        with np.errstate(divide="ignore", invalid="ignore"):
            projection.project_with_jacobian(
                self.entries, self.distortion.model, k, list(points.T), J[:5], J[5:8], J[8:]
            )
        by_camera = np.concatenate([J[:5], J[8:]])
        return by_camera.transpose(2, 1, 0), J[5:8].transpose(2, 1, 0)

    def unproject(self, pixels: Array) -> Array:
        """Viewing directions of pixels.

        They are unit vectors, not points at depth 1, because only unit vectors can represent directions of 90
        degrees and more from the axis. `project` accepts them unchanged.

        Parameters
        ----------
        pixels : (..., 2) array [px]

        Returns
        -------
        rays : (..., 3) array
            Of unit length, in the camera's frame; ``nan`` for pixels that the camera cannot produce.

        Raises
        ------
        InputError
            An array of another shape.
        """
        u, v = _coordinates("pixels", pixels, 2)
        if self.distortion.wide:
            x, y = projection.normalised_points(self.entries, u, v)
            return np.stack(unproject_directions(self.distortion, x, y), axis=-1)
        x, y = self.normalised_points(u, v)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def seen_points(self, pixels: Array) -> Array:
        """Points on the rays of pixels (..., 2), at depth 1; for a wide lens, at distance 1.

        ``nan`` for pixels that the camera cannot produce.
        """
        rays = self.unproject(pixels)
        return rays if self.distortion.wide else np.asarray(rays / rays[..., 2:])

    def rescaled(self, scale: float | tuple[float, float]) -> Camera:
        """The camera of resized images: ``u' = (u + 1/2) s - 1/2``.

        Parameters
        ----------
        scale : float, or one for u and one for v
            New width over old width, new height over old height. The new image size is rounded.

        Raises
        ------
        InputError
            A scale is not positive.
        """
        factors = np.ones(2) * real_array("scale", scale)
        if factors.shape != (2,) or not (np.isfinite(factors) & (factors > 0)).all():
            raise InputError(f"the scale of an image must be positive, one or two numbers, found {scale}")
        a, b = factors.tolist()
        size = self.image_size
        if size is not None:
            size = max(1, round(size[0] * a)), max(1, round(size[1] * b))
        return replace(self, intrinsics=Resizing((a, b)).intrinsics(self.intrinsics), image_size=size)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of cropped images.

        Parameters
        ----------
        left, top : int [px]
            The pixel of the image that becomes (0, 0).
        width, height : int [px]
            Size of the cropped image.
        """
        intrinsics = Resizing(corner=(left, top)).intrinsics(self.intrinsics)
        return replace(self, intrinsics=intrinsics, image_size=(width, height))

    def image_points(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Pixels u, v of normalised image points x, y."""
        return projection.image_points(self.entries, self.model, self.distortion.coefficients, x, y)

    def normalised_points(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Undistorted normalised image points x, y of pixels u, v; nan where there are none."""
        return undistort(self.distortion, *projection.normalised_points(self.entries, u, v))

    def rays(self, u: Array, v: Array, near: tuple[Array, Array] | None = None) -> projection.Rays:
        """Rays of pixels u, v with derivatives; see `projection.rays_of`."""
        return projection.rays_of(self.entries, self.distortion, u, v, near)


def _coordinates(name: str, values: Array, count: int) -> Array:
    """Coordinates, (count, ...), of points or pixels (..., count)."""
    return np.moveaxis(real_rows(name, values, count, stacked=True), -1, 0)


class Calibrated(Protocol):
    """What has a camera, such as a `Calibration`."""

    @property
    def camera(self) -> Camera:
        """The camera without poses."""


def camera_of(given: Camera | Calibrated | Intrinsics | Array) -> Camera:
    """Convert any of the accepted types to a `Camera`; a matrix has no distortion.

    Raises UsageError for another type, and InputError for a matrix that is no camera matrix.
    """
    if isinstance(given, Camera):
        return given
    if isinstance(given, Intrinsics):
        return Camera(given)
    if isinstance(given, (np.ndarray, list, tuple)):
        return Camera(Intrinsics.from_matrix(np.asarray(given)))
    if isinstance(camera := getattr(given, "camera", None), Camera):
        return camera
    raise UsageError("the camera must be a Camera, a Calibration, an Intrinsics or a 3 x 3 matrix")

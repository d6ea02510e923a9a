"""Undistorted images on a cylinder or a sphere, for fields of view that no plane can show.

A ray (X, Y, Z) has the longitude lambda = atan2(X, Z) and the latitude phi = atan2(Y, hypot(X, Z)):

    cylinder          u = f lambda + u0,  v = f tan(phi) + v0
    equirectangular   u = f lambda + u0,  v = f phi + v0

and back, with lambda = (u - u0) / f:

    cylinder          (sin lambda, (v - v0) / f, cos lambda)
    equirectangular   (cos phi sin lambda, sin phi, cos phi cos lambda),  phi = (v - v0) / f

On both, lines parallel to the camera's y axis are vertical. f is in pixels a radian.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.errors import InputError
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

PANORAMAS = ("cylinder", "equirectangular")


@frozen_dataclass
class Panorama:
    """An image on a cylinder or a sphere around the camera.

    Raises InputError for another shape, or a scale that is not positive.

    Examples
    --------
    >>> panorama = Panorama("cylinder", 200.0, 319.5, 239.5, (640, 480))
    >>> pixels, shown = panorama.project(np.array([[1.0, 0.5, 0.0]]))  # 90 degrees to the right
    >>> pixels.round(2)
    array([[633.66, 339.5 ]])
    >>> panorama.unproject(pixels).round(4)
    array([[0.8944, 0.4472, 0.    ]])
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

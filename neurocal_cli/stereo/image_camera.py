"""One camera for arrays of points: pixels to rays and back, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurocal_cli.bundle_adjustment.problem import KnownCamera
from neurocal_cli.bundle_adjustment.reprojection import ENTRIES
from neurocal_cli.camera.distortion_models import bend
from neurocal_cli.camera.monotonic import undistort
from neurocal_cli.geometry import Array

__all__ = ["ImageCamera"]

_SMALL_STEP = 0.02  # of Newton's in the image plane: the next one would be a thousandth


@dataclass(frozen=True, eq=False)
class ImageCamera:
    """A camera as many points at a time see it: plain numbers for A, and the lens.

    Attributes
    ----------
    entries : tuple of float
        A11, A12, A22, A13, A23 [px].
    model : str
        Of the lens, "none" where it does not bend.
    k : (K,) array
    """

    entries: tuple[float, float, float, float, float]
    model: str
    k: Array

    @classmethod
    def of(cls, camera: KnownCamera) -> ImageCamera:
        """Take a calibration, or a camera from a file."""
        a, s, b, u0, v0 = camera.intrinsics.A[ENTRIES].tolist()
        bends = camera.distortion_model == "fisheye" or bool(np.any(camera.distortion))
        model = camera.distortion_model if bends else "none"
        return cls((a, s, b, u0, v0), model, np.asarray(camera.distortion, dtype=float))

    def straight(self, pixels: Array) -> tuple[Array, Array]:
        """Normalised image points without the lens; nan where there are none."""
        x, y = self._normalised(pixels)
        return (x, y) if self.model == "none" else undistort(self.model, self.k, x, y)

    def nearly_straight(self, pixels: Array) -> tuple[Array, Array]:
        """The same to a thousandth or so, in two of Newton's steps, wherever these do."""
        x, y = self._normalised(pixels)
        if self.model == "none":
            return x, y
        near_x, near_y = x, y
        for _ in range(2):
            (bent_x, bent_y), (xx, xy, yx, yy), _ = bend(self.model, self.k, near_x, near_y)
            det = xx * yy - xy * yx
            step_x = (yy * (x - bent_x) - xy * (y - bent_y)) / det
            step_y = (xx * (y - bent_y) - yx * (x - bent_x)) / det
            near_x, near_y = near_x + step_x, near_y + step_y
        far = ~((det > 0) & (step_x * step_x + step_y * step_y < _SMALL_STEP**2))
        if far.any():
            near_x[far], near_y[far] = undistort(self.model, self.k, x[far], y[far])
        return near_x, near_y

    def _normalised(self, pixels: Array) -> tuple[Array, Array]:
        a, s, b, u0, v0 = self.entries
        y = (pixels[1] - v0) / b
        return (pixels[0] - u0 - s * y) / a, y

    def seen(self, x: Array, y: Array) -> tuple[Array, Array, tuple[Array | float, ...]]:
        """Pixels of normalised points and their derivatives du/dx, du/dy, dv/dx, dv/dy."""
        a, s, b, u0, v0 = self.entries
        if self.model == "none":
            return a * x + s * y + u0, b * y + v0, (a, s, 0.0, b)
        (x, y), (xx, xy, yx, yy), _ = bend(self.model, self.k, x, y)
        return a * x + s * y + u0, b * y + v0, (a * xx + s * yx, a * xy + s * yy, b * yx, b * yy)

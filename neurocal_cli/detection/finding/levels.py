"""An image pyramid, with the second derivatives that `saddles` uses.

Pixel (u, v) of a level is pixel (2 u, 2 v) of the next finer one, because `cv2.pyrDown` keeps even pixels.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

Image = NDArray[np.float32]

# _SMOOTHING, _SMALLEST and _LEAST_NOISE are insensitive; the others bound memory.
_SMOOTHING = 1.0  # px; reduces noise and aliasing
_SMALLEST = 100  # px; shorter side of the smallest level
_LARGE = 30_000_000  # pixels; in larger images the noise is measured only in bands, to save memory ...
_BANDS, _BAND = 24, 64  # ... number of bands, and rows of a band
_ROWS = 32000  # rows per call of cv2.remap, which counts them in 16 bits
_LEAST_NOISE = 0.12  # DN/px^2; caused by rounding to 8 bits


@frozen_dataclass(eq=False)
class Level:
    """A level of the pyramid."""

    image: Image  # (height, width), in grey levels of an 8-bit image
    scale: int  # size of a pixel in pixels of the original

    @cached_property
    def smooth(self) -> Image:
        """The image after Gaussian smoothing."""
        return np.asarray(cv2.GaussianBlur(self.image, (0, 0), _SMOOTHING), dtype=np.float32)

    @cached_property
    def curvature(self) -> tuple[Image, Image, Image]:
        """Second derivatives uu, uv and vv of `smooth` [DN/px^2]."""
        uu, uv, vv = (
            np.asarray(cv2.Sobel(self.smooth, cv2.CV_32F, *order, ksize=3, scale=0.25), dtype=np.float32)
            for order in ((2, 0), (1, 1), (0, 2))
        )
        return uu, uv, vv

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the second derivatives due to noise [DN/px^2], from their median."""
        if self.image.size <= _LARGE:
            sparse = self.curvature[1][::4, ::4]
        else:
            first = np.linspace(0, len(self.image) - _BAND, _BANDS).astype(int)
            bands = [Level(self.image[v : v + _BAND], self.scale).curvature[1] for v in first]
            sparse = np.concatenate([band[4:-4:4, ::4] for band in bands])
        return max(float(np.median(np.abs(sparse))) / 0.6745, _LEAST_NOISE)


def levels_of(image: NDArray[np.generic]) -> list[Level]:
    """Halve an image (height, width) of 8 or 16 bits, or of real numbers of any range, repeatedly.

    The original is first; there are no levels if it is too small for a board.
    """
    return pyramid(_grey(image))


def pyramid(image: Image) -> list[Level]:
    """Halve an image with the grey levels of 8 bits repeatedly; see `levels_of`."""
    levels = []
    current, scale = image, 1
    while min(current.shape) >= (16 if scale == 1 else _SMALLEST):
        levels.append(Level(current, scale))
        current, scale = np.asarray(cv2.pyrDown(current), dtype=np.float32), 2 * scale
    return levels


def _grey(image: NDArray[np.generic]) -> Image:
    """Convert the image to float32 and the grey levels of 8 bits."""
    if image.dtype == np.uint8:
        return image.astype(np.float32)
    if image.dtype == np.uint16:
        return np.asarray(image.astype(np.float32) * np.float32(1 / 257))
    real = image.astype(float)
    finite = np.isfinite(real)
    if not finite.any():
        return np.zeros(image.shape, dtype=np.float32)
    low, high = float(real[finite].min()), float(real[finite].max())
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (np.where(finite, real, low) - low) * (255 / (high - low)) if high > low else 0 * real
    return np.asarray(np.nan_to_num(scaled), dtype=np.float32)


def interpolate(image: Image, points: NDArray[np.floating]) -> Array:
    """Interpolate an image linearly at points (..., 2) [px], repeating the border outside."""
    flat = points.reshape(-1, points.shape[-2], 2) if points.ndim > 2 else points.reshape(-1, 1, 2)
    maps = flat.astype(np.float32, copy=False)
    parts = [
        cv2.remap(image, maps[k : k + _ROWS], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        for k in range(0, len(maps), _ROWS)
    ]
    values = parts[0] if len(parts) == 1 else np.concatenate([np.zeros((0, maps.shape[1])), *parts])
    return values.astype(float).reshape(points.shape[:-1])

"""Point spread function: a Gaussian convolved with the pixel's box, integrated exactly.

Most pixels are uniform, or linear under a gradient of light; they are convolved as a whole. Pixels with edges
are divided into cells. Their means are convolved with the rest, and the differences of the cells from the
mean are added pixel by pixel.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

_TAIL = 5.7  # standard deviations at which the Gaussian is cut off; 1e-8 of the light is beyond
_STRIP = 16  # rows processed at a time
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


@frozen_dataclass
class Blur:
    """Kernels of a blur."""

    sigma: float  # [px] of the Gaussian
    parts: int  # cells along a pixel's side

    @property
    def radius(self) -> int:
        """Reach of a pixel's light to each side, in pixels."""
        return math.ceil(_TAIL * self.sigma + 0.5)

    @cached_property
    def whole(self) -> Array:
        """(2 radius + 1,) array: light of a uniform pixel at the pixel at offset j."""
        return _spread(np.arange(-self.radius, self.radius + 1.0), 0.5, self.sigma)

    @cached_property
    def slope(self) -> Array:
        """(2 radius + 1,) array: light of a pixel's slope at the pixel that has it at offset j."""
        offsets = np.arange(-self.radius, self.radius + 1.0)
        t = 0.5 * _NODES
        return np.asarray((_response(offsets[:, None] + t, self.sigma) * t) @ (0.5 * _WEIGHTS))

    @cached_property
    def cell(self) -> Array:
        """(2 radius + 1, parts) array: light of each cell at the pixel at offset j.

        The mean of a cell blurs an edge in it by a box as wide as the cell; the variance of the Gaussian is
        reduced by that of the box.
        """
        sigma = math.sqrt(max(self.sigma**2 - 1 / (12 * self.parts**2), 0.0))
        centres = (np.arange(self.parts) + 0.5) / self.parts - 0.5
        offsets = np.arange(-self.radius, self.radius + 1.0)
        return _spread(offsets[:, None] - centres, 0.5 / self.parts, sigma)

    def convolve(self, level: Array, slope_u: Array | None, slope_v: Array | None) -> Array:
        """Blur an image (H, W) whose pixels are uniform, or linear inside with slopes (H, W) [1/px].

        Returns (H - 2 radius, W - 2 radius).
        """
        image = _along_v(_along_u(level, self.whole), self.whole)
        if slope_u is not None:
            image += _along_v(_along_u(slope_u, self.slope), self.whole)
        if slope_v is not None:
            image += _along_v(_along_u(slope_v, self.whole), self.slope)
        return image

    def scatter(self, image: Array, row: NDArray[np.intp], column: NDArray[np.intp], cells: Array) -> None:
        """Add the light of the cells of pixels to an image, in place.

        The image has a border of `radius` around the part that is kept, and the N pixels are different, and
        at least `radius` from it. `cells` (N, parts, parts) are the differences from the pixel's mean,
        ``[pixel, v, u]``.
        """
        spread = self.cell @ cells @ self.cell.T
        flat, width = image.reshape(-1), image.shape[1]
        start = row * width + column
        for j in range(-self.radius, self.radius + 1):
            for i in range(-self.radius, self.radius + 1):
                flat[start + (j * width + i)] += spread[:, j + self.radius, i + self.radius]


def _along_u(image: Array, kernel: Array) -> Array:
    """``out[y, x] = sum_j kernel[j] image[y, x + j]``, only where the kernel fits into the image."""
    width = image.shape[1] - len(kernel) + 1
    out = np.empty((image.shape[0], width))
    for first in range(0, len(image), _STRIP):  # strips stay in the cache
        strip = image[first : first + _STRIP]
        total = kernel[0] * strip[:, :width]
        for j in range(1, len(kernel)):
            total += kernel[j] * strip[:, j : j + width]
        out[first : first + _STRIP] = total
    return out


def _along_v(image: Array, kernel: Array) -> Array:
    """Like `_along_u`, along the columns."""
    height = len(image) - len(kernel) + 1
    out = np.empty((height, image.shape[1]))
    for first in range(0, height, _STRIP):
        last = min(first + _STRIP, height)
        total = kernel[0] * image[first:last]
        for j in range(1, len(kernel)):
            total += kernel[j] * image[first + j : last + j]
        out[first:last] = total
    return out


def _response(t: Array, sigma: float) -> Array:
    """Light of a point source at t in the pixel at 0: the Gaussian convolved with the pixel's box."""
    if sigma == 0:
        return (np.abs(t) < 0.5).astype(float)
    return _normal_cdf((t + 0.5) / sigma) - _normal_cdf((t - 0.5) / sigma)


def _spread(offset: Array, half: float, sigma: float) -> Array:
    """Integral of `_response` from offset - half to offset + half, in closed form."""
    total = np.zeros_like(offset)
    for sign, shift in ((1, 0.5 + half), (-1, 0.5 - half), (-1, half - 0.5), (1, -0.5 - half)):
        total += sign * _twice_integrated(offset + shift, sigma)
    return total


def _twice_integrated(x: Array, sigma: float) -> Array:
    if sigma == 0:
        return np.maximum(x, 0.0)
    z = x / sigma
    return np.asarray(sigma * (z * _normal_cdf(z) + np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)))


def _normal_cdf(z: Array) -> Array:
    flat = [0.5 * math.erfc(-x / math.sqrt(2)) for x in np.asarray(z, dtype=float).ravel().tolist()]
    return np.array(flat).reshape(np.shape(z))

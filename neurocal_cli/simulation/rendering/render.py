"""Render pictures of boards: light, then noise and rounding.

The light at each pixel comes from layers, illumination and blur. The point spread function is a
Gaussian convolved with the pixel's box, integrated exactly. Most pixels are uniform, or linear under a
gradient of light; they are convolved as a whole. Pixels with edges are divided into cells. Their means are
convolved with the rest, and the differences of the cells from the mean are added pixel by pixel.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.simulation.rendering.layers import Composition
from neurocal_cli.simulation.rendering.scene import Illumination, Scene

_TAIL = 5.7  # standard deviations at which the Gaussian is cut off; 1e-8 of the light is beyond
_ROWS_AT_ONCE = 16  # rows processed at a time
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
# Product of cells along a pixel's side and blur [px] that keeps the error below 0.0005 of full scale.
_PARTS_BY_BLUR = 8.0
_FEWEST_PARTS, _MOST_PARTS = 4, 24
_STRIP = 32768  # pixels processed at a time; they fit into the cache
_CHUNK = 65536  # cells processed at a time


def image_light(scene: Scene, parts: int | None = None) -> Array:
    """Render the light (height, width) at each pixel; 1 is the sensor's full scale.

    Pixels with edges have `parts` cells along a side; the error falls with their square. By default it is
    below 0.0005 of the contrast (0.0001 px for an edge).
    """
    width, height = scene.size
    blur = Blur(scene.psf, parts or enough_parts(scene))
    pad = blur.radius
    composition = Composition.of(scene)
    level = scene.background.image(scene.size, pad)
    residual = np.zeros((height + 4 * pad, width + 4 * pad))
    edged = np.zeros(level.shape, dtype=bool)
    step = max(1, _STRIP // level.shape[1])
    for first in range(0, len(level), step):
        rows = slice(first, min(first + step, len(level)))
        _fill(scene, composition, blur, rows, level, edged, residual)
    image = blur.convolve(*_shaded(scene, level, edged, pad))
    image += residual[2 * pad : height + 2 * pad, 2 * pad : width + 2 * pad]
    return image


def illuminated(light: Illumination, size: tuple[int, int], u: Array, v: Array) -> Array:
    """Factor of the illumination at image points [px]."""
    width, height = size
    gu, gv = light.gradient
    slope = gu * (u - 0.5 * (width - 1)) / width + gv * (v - 0.5 * (height - 1)) / height
    return np.asarray(light.level * (1 + slope))


def enough_parts(scene: Scene) -> int:
    """Default number of cells along a pixel's side in `image_light`."""
    return int(np.clip(np.ceil(_PARTS_BY_BLUR / scene.sigma_t), _FEWEST_PARTS, _MOST_PARTS))


def _fill(
    scene: Scene,
    composition: Composition,
    blur: Blur,
    rows: slice,
    level: Array,
    edged: NDArray[np.bool_],
    residual: Array,
) -> None:
    """Render the layers over the background in some rows.

    ``level`` becomes the mean reflectance of pixels without edges, and the mean light of pixels with edges.
    The differences of the cells of the latter from their mean are blurred and added to ``residual``.
    """
    pad = blur.radius
    grid = np.mgrid[rows, 0 : level.shape[1]].reshape(2, -1)
    v, u = (grid - pad).astype(float)
    behind = level[rows].reshape(-1)
    light, has_edges, rays = composition.pixels(u, v, behind)
    todo = np.flatnonzero(has_edges)
    step = max(1, _CHUNK // blur.parts**2)
    offsets = (np.arange(blur.parts) + 0.5) / blur.parts - 0.5
    for first in range(0, len(todo), step):
        some = todo[first : first + step]
        near = rays.x[some], rays.y[some]
        cells = composition.cells(u[some], v[some], near, behind[some], blur.parts)
        cell_u, cell_v = u[some, None, None] + offsets, v[some, None, None] + offsets[:, None]
        cells *= illuminated(scene.illumination, scene.size, cell_u, cell_v)
        light[some] = cells.mean(axis=(1, 2))
        row, column = grid[0][some] + pad, grid[1][some] + pad
        blur.scatter(residual, row, column, cells - light[some, None, None])
    level[rows] = light.reshape(-1, level.shape[1])
    edged[rows] = has_edges.reshape(-1, level.shape[1])


def _shaded(
    scene: Scene, level: Array, edged: NDArray[np.bool_], pad: int
) -> tuple[Array, Array | None, Array | None]:
    """Light of the pixels, and its gradients within pixels without edges."""
    light = scene.illumination
    width, height = scene.size
    if light.gradient == (0.0, 0.0):
        if light.level != 1:
            level[~edged] *= light.level
        return level, None, None
    v, u = (np.mgrid[0 : level.shape[0], 0 : level.shape[1]] - pad).astype(float)
    slope_u = np.where(edged, 0.0, level * (light.level * light.gradient[0] / width))
    slope_v = np.where(edged, 0.0, level * (light.level * light.gradient[1] / height))
    shade = illuminated(light, scene.size, u, v)
    return np.where(edged, level, level * shade), slope_u, slope_v


def digitised(light: Array, rng: np.random.Generator, noise: float = 2.0) -> NDArray[np.uint8]:
    """Grey values of light (H, W), with Gaussian noise of a standard deviation [grey values]."""
    values = 255 * np.clip(light, 0.0, 1.0) + rng.normal(0.0, noise, light.shape)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


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
    for first in range(0, len(image), _ROWS_AT_ONCE):  # strips stay in the cache
        strip = image[first : first + _ROWS_AT_ONCE]
        total = kernel[0] * strip[:, :width]
        for j in range(1, len(kernel)):
            total += kernel[j] * strip[:, j : j + width]
        out[first : first + _ROWS_AT_ONCE] = total
    return out


def _along_v(image: Array, kernel: Array) -> Array:
    """Like `_along_u`, along the columns."""
    height = len(image) - len(kernel) + 1
    out = np.empty((height, image.shape[1]))
    for first in range(0, height, _ROWS_AT_ONCE):
        last = min(first + _ROWS_AT_ONCE, height)
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

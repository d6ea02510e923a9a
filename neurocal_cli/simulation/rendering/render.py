"""Render pictures of chessboards with known truth: light, then the sensor's response, noise and rounding.

The light at each pixel comes from layers, illumination, blur and vignetting.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.simulation.rendering.blur import Blur
from neurocal_cli.simulation.rendering.layers import Composition
from neurocal_cli.simulation.rendering.scene import Illumination, Scene, Sensor
from neurocal_cli.simulation.rendering.truth import Truth, ground_truth

Image = NDArray[np.uint8] | NDArray[np.uint16]

# Product of cells along a pixel's side and blur [px] that keeps the error below 0.0005 of full scale.
_PARTS_BY_BLUR = 8.0
_FEWEST_PARTS, _MOST_PARTS = 4, 24
_STRIP = 32768  # pixels processed at a time; they fit into the cache
_CHUNK = 65536  # cells processed at a time
_SRGB_LINEAR = 0.0031308


def image_light(scene: Scene, parts: int | None = None) -> Array:
    """Render the light (height, width) at each pixel; 1 is the sensor's full scale at gain 1.

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
    image = image * _vignetting(scene)
    return image if scene.circle is None else scene.circle(image)


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


def _vignetting(scene: Scene) -> Array | float:
    strength = scene.illumination.vignetting
    if strength == 0:
        return 1.0
    width, height = scene.size
    u, v = np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1)
    corner = max(0.25 * ((width - 1) ** 2 + (height - 1) ** 2), 1.0)
    return np.asarray(1 - strength * (u**2 + v[:, None] ** 2) / corner)


@frozen_dataclass(eq=False)
class Rendered:
    """A rendered picture."""

    image: Image  # [DN]
    truth: Truth


def render(scene: Scene, rng: np.random.Generator) -> Rendered:
    """Render a picture of a scene; only the noise comes from the generator."""
    return Rendered(digitised(scene.sensor, image_light(scene), rng), ground_truth(scene))


def signal(sensor: Sensor, light: Array) -> Array:
    """Linear signal of light; 1 is full scale."""
    return sensor.gain * light + sensor.offset


def response(sensor: Sensor, linear: Array) -> Array:
    """Response curve of a linear signal, from [0, 1] to [0, 1]; light beyond full scale is clipped."""
    x = np.clip(linear, 0.0, 1.0)
    if sensor.response == "srgb":
        return np.where(x <= _SRGB_LINEAR, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.asarray(x ** (1 / float(sensor.response))) if sensor.response != 1 else x


def digitised(sensor: Sensor, light: Array, rng: np.random.Generator) -> Image:
    """Convert light (H, W) to pixel values with noise."""
    linear = signal(sensor, light)
    if sensor.full_well is not None:
        linear = rng.poisson(np.clip(linear, 0, None) * sensor.full_well) / sensor.full_well
    values = response(sensor, linear) * sensor.white_dn
    if sensor.read_noise > 0:
        values = values + rng.normal(0.0, sensor.read_noise * sensor.white_dn / 255, values.shape)
    whole = np.clip(np.rint(values), 0, sensor.white_dn)
    return whole.astype(np.uint8) if sensor.bits == 8 else whole.astype(np.uint16)

"""Boards that are lit unevenly or partly out of focus, measured beside the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import cv2
import numpy as np

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.measuring import measure
from support.clutter import Clutter
from support.measured import Points, found, places
from support.occluders import Disc
from support.pictures import Image, Scene, Sensor, digitised, ground_truth, image_light
from support.rendered import Recipe, single

# The board fills the image.
RECIPE = Recipe(square=47, margin=0.3, tilt=25, roll=8, background=Clutter(level=0.3))
Effect = Callable[[Array, Array, np.random.Generator], Array]  # of light (H, W) and vertices (..., 2) [px]


def _pixels(light: Array) -> tuple[Array, Array]:
    v, u = np.mgrid[: light.shape[0], : light.shape[1]].astype(float)
    return u, v


def _along(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
    """Coordinate along a random direction, from 0 at one end of the board to 1 at the other."""
    angle = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    u, v = _pixels(light)
    ends = vertices.reshape(-1, 2) @ direction
    return np.asarray((u * direction[0] + v * direction[1] - ends.min()) / (ends.max() - ends.min()))


def vignetted(ratio: float) -> Effect:
    """The light falls by a ratio towards the corners of the image."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        u, v = _pixels(light)
        height, width = light.shape
        squared = ((u - 0.5 * width) ** 2 + (v - 0.5 * height) ** 2) / (0.25 * (width**2 + height**2))
        return np.asarray(light / (1 + (np.sqrt(ratio) - 1) * squared) ** 2)

    return effect


def beside_a_lamp(ratio: float) -> Effect:
    """The light falls by a ratio over the board, with the squared distance from a lamp."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        along = np.maximum(_along(light, vertices, rng), 0)
        return np.asarray(light / (1 + (np.sqrt(ratio) - 1) * along) ** 2)

    return effect


def half_in_shadow(depth: float, width: float) -> Effect:
    """A shadow covers about half of the board; its border has a width [px]."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        angle = rng.uniform(0, 2 * np.pi)
        u, v = _pixels(light)
        middle = vertices.reshape(-1, 2).mean(axis=0)
        away = (u - middle[0]) * np.cos(angle) + (v - middle[1]) * np.sin(angle)
        return np.asarray(light * (0.5 * (1 + depth) + 0.5 * (1 - depth) * np.tanh(away / width)))

    return effect


def mottled(size: float, strength: float) -> Effect:
    """The paper's reflectance varies, over a size [px]."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        spots = cv2.GaussianBlur(rng.normal(size=light.shape), (0, 0), size)
        return np.asarray(light * (1 + strength / spots.std() * spots))

    return effect


def defocused(most: float) -> Effect:
    """The blur grows over the board, up to a standard deviation [px]."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        variance = (most * np.clip(_along(light, vertices, rng), 0.02, 1.1)) ** 2
        levels = np.linspace(variance.min(), variance.max(), 24)
        blurred = np.stack([cv2.GaussianBlur(light, (0, 0), np.sqrt(level)) for level in levels])
        place = (variance - levels[0]) / (levels[1] - levels[0])
        below = np.clip(place.astype(int), 0, len(levels) - 2)
        share, (row, column) = place - below, np.indices(light.shape)
        return np.asarray((1 - share) * blurred[below, row, column] + share * blurred[below + 1, row, column])

    return effect


def moved(length: float) -> Effect:
    """The camera moves in a random direction during the exposure, by a length [px]."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        angle, reach = rng.uniform(0, np.pi), int(length) + 1
        v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        kernel = np.zeros(u.shape)
        for place in np.linspace(-0.5, 0.5, 101) * length:  # bilinear, so that nothing is shifted
            du, dv = np.abs(u - place * np.cos(angle)), np.abs(v - place * np.sin(angle))
            kernel += np.maximum(1 - du, 0) * np.maximum(1 - dv, 0)
        return np.asarray(cv2.filter2D(light, -1, kernel / kernel.sum()))

    return effect


def hazy(strength: float, size: float) -> Effect:
    """A glossy board reflects a lamp: light is added around a vertex, over a size [px]."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        middle = rng.choice(vertices.reshape(-1, 2))
        u, v = _pixels(light)
        away = ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / size**2
        return np.asarray(light + strength * np.exp(-0.5 * away))

    return effect


def toned(gamma: float) -> Effect:
    """The tone mapping changes over the board, from linear to a gamma."""

    def effect(light: Array, vertices: Array, rng: np.random.Generator) -> Array:
        share = np.clip(_along(light, vertices, rng), 0, 1)
        return np.asarray(np.maximum(light, 0) ** (1 / (1 + (gamma - 1) * share)))

    return effect


@dataclass(frozen=True, eq=False)
class Found:
    """What was measured of a board."""

    kept: float  # share of the visible points
    hidden: int  # number of hidden points that were measured
    error: Array  # (N,) [px] of visible mid-points, across the edge, or of vertices, per axis
    normalised: Array  # (N,) the same in standard deviations

    @property
    def rms(self) -> float:
        """Root mean square of the errors [px]."""
        return float(np.sqrt((self.error**2).mean()))

    @property
    def z(self) -> float:
        """Root mean square of the errors in standard deviations."""
        return float(np.sqrt((self.normalised**2).mean()))


def board(seed: int, hidden: bool = False, response: float = 1.0) -> Scene:
    """A board that fills the image; two discs hide parts of it if wanted."""
    return replace(_placed(seed, hidden), sensor=Sensor(response, read_noise=2.0))


@cache
def _placed(seed: int, hidden: bool) -> Scene:
    scene = single(RECIPE, np.random.default_rng(seed))
    if not hidden:
        return scene
    rng = np.random.default_rng([seed, 5])
    midpoints = ground_truth(scene).planes[0].midpoints
    discs = [
        Disc((float(u), float(v)), float(rng.uniform(15, 30)), float(rng.uniform(0.03, 0.9)))
        for u, v in midpoints[rng.choice(len(midpoints), 2, replace=False)]
    ]
    return replace(scene, occluders=tuple(discs))


@lru_cache(16)
def _light_of(scene: Scene) -> Array:
    return image_light(scene, 4)


def sharpened(image: Image) -> Image:
    """Sharpen an image as phones do, with unsharp masking."""
    values = image.astype(float)
    values += values - cv2.GaussianBlur(values, (0, 0), 1.5)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def measured_under(
    effect: Effect, seed: int, points: Points, scene: Scene, processed: Callable[[Image], Image] | None = None
) -> Found:
    """Measure a board under an effect; its vertices are found to half a pixel."""
    plane = ground_truth(scene).planes[0]
    rng = np.random.default_rng([seed, 11])
    image = digitised(
        scene.sensor, effect(_light_of(replace(scene, sensor=Sensor())), plane.vertices, rng), rng
    )
    if processed is not None:
        image = processed(image)
    grid, mirrored = found(plane, seed, hidden=True)
    measured = measure(image, grid, points)
    row = places(measured, plane, mirrored)
    suu, suv, svv = measured.covariance.T
    if points == "vertices":
        seen = plane.vertices_visible.reshape(-1)
        u, v = (measured.pixels - plane.vertices.reshape(-1, 2)[row]).T
        error = np.hypot(u, v) / np.sqrt(2)
        squared = (svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2)
        normalised = np.sqrt(squared / 2)
    else:
        seen, normal = plane.edges_visible, plane.normals[row]
        error = ((measured.pixels - plane.midpoints[row]) * normal).sum(axis=1)
        n, m = normal.T
        normalised = error / np.sqrt(suu * n * n + 2 * suv * n * m + svv * m * m)
    shown = seen[row]
    return Found(shown.sum() / seen.sum(), int((~shown).sum()), error[shown], normalised[shown])

"""Random lenses that no polynomial describes: each a fisheye as real ones are, and a displacement [px]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from neurocal_cli.camera.geometry import Array

_CENTRE = np.array([505.0, 392.0])
_FARTHEST = 1.4  # rad
_INDICES = 1.0, 1.5, 1.333  # of air, glass and water


@dataclass(frozen=True, eq=False)
class RandomLens:
    """A fisheye with a radial profile [px] over the angle and a field [px] over half the image's height."""

    k: Array
    profile: Callable[[Array], Array] = np.zeros_like
    field: Callable[[Array], Array] = np.zeros_like
    dome: Dome | None = None

    def project(self, points: Array) -> Array:
        """Pixels of points [mm]."""
        rays = points if self.dome is None else self.dome.rays(points)
        rho, Z = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]
        theta = np.arctan2(rho, Z)
        radius = 400 * theta * _growth(self.k, theta) / _growth(self.k, np.array([1.2]))
        pixels = _CENTRE + ((radius + self.profile(theta)) / rho)[:, None] * rays[:, :2]
        return np.asarray(pixels + self.field((pixels - [500, 400]) / 400))


@dataclass(frozen=True, eq=False)
class Dome:
    """A glass dome in water around a camera that is off its centre [mm]."""

    centre: Array
    radius: float
    thickness: float

    def rays(self, points: Array) -> Array:
        """Directions at the camera that lead to points, which are eight times as far from it [mm]."""
        points = 8 * points
        distance = np.linalg.norm(points, axis=1)[:, None]
        seen = points / distance
        for _ in range(30):
            origin, direction = self._outside(seen)
            miss = points + self.centre - origin
            miss = miss - (miss * direction).sum(axis=1, keepdims=True) * direction
            seen = seen + miss / distance
            seen = seen / np.linalg.norm(seen, axis=1)[:, None]
        return seen

    def _outside(self, direction: Array) -> tuple[Array, Array]:
        """Rays behind both surfaces, by Snell's law."""
        origin = np.broadcast_to(self.centre, direction.shape)
        for n, radius in enumerate((self.radius, self.radius + self.thickness)):
            along = (origin * direction).sum(axis=1, keepdims=True)
            square = (origin * origin).sum(axis=1, keepdims=True)
            origin = origin + (np.sqrt(along**2 - square + radius**2) - along) * direction
            normal, ratio = origin / radius, _INDICES[n] / _INDICES[n + 1]
            cosine = (normal * direction).sum(axis=1, keepdims=True)
            bent = np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine
            direction = ratio * direction + bent * normal
        return origin, direction


def random_lens(kind: str, seed: int) -> RandomLens:
    """A lens of one of `KINDS`; another one for each seed."""
    rng = np.random.default_rng([seed, 8])
    return KINDS[kind](_real_fisheye(rng), rng)


def _growth(k: Array, theta: Array, slope: bool = False) -> Array:
    powers = np.arange(2, 10, 2)
    return np.asarray(1 + theta[:, None] ** powers @ (k * (powers + 1 if slope else 1)))


def _real_fisheye(rng: np.random.Generator) -> Array:
    """k1 to k4 as real fisheyes have them, whose image grows."""
    while True:
        k = rng.normal(size=4) * [0.15, 0.05, 0.02, 0.005] / _FARTHEST ** np.arange(2, 10, 2)
        if _growth(k, np.linspace(0, 1.6, 200), slope=True).min() > 0.25:
            return np.asarray(k)


def _mustache(k: Array, rng: np.random.Generator) -> RandomLens:
    wave, bump = rng.choice([-1, 1], 2) * rng.uniform([0.5, 0], [3, 2])
    frequency, middle, width = rng.uniform([3, 0.3, 0.08], [6, 1.1, 0.25])

    def profile(theta: Array) -> Array:
        bumps = [np.exp(-0.5 * ((theta + side * middle) / width) ** 2) for side in (-1, 1)]
        return np.asarray(wave * np.sin(frequency * theta) + bump * (bumps[0] - bumps[1]))

    return RandomLens(k, profile)


def _smooth_profile(rng: np.random.Generator) -> Callable[[Array], Array]:
    """Odd, of 0.5 to 3 px and 0.15 to 0.5 rad long."""
    frequency = rng.normal(0, 1 / rng.uniform(0.15, 0.5), 60)
    size = rng.normal(0, rng.uniform(0.5, 3) * np.sqrt(2 / 60), 60)
    return lambda theta: np.asarray(np.sin(theta[:, None] * frequency) @ size)


def _smooth_field(rng: np.random.Generator, sizes: tuple[float, float]) -> Callable[[Array], Array]:
    """200 to 480 px long."""
    frequency = rng.normal(0, 1 / rng.uniform(0.5, 1.2), (200, 2))
    phase = rng.uniform(0, 2 * np.pi, 200)
    size = rng.normal(0, rng.uniform(*sizes) * np.sqrt(2 / 200), (200, 2))
    return lambda place: np.asarray(np.cos(place @ frequency.T + phase) @ size)


def _dome(k: Array, rng: np.random.Generator) -> RandomLens:
    off = rng.normal(size=3)
    off *= rng.uniform(1, 5) / np.linalg.norm(off)
    return RandomLens(k, dome=Dome(off, rng.uniform(40, 80), rng.uniform(3, 8)))


KINDS: dict[str, Callable[[Array, np.random.Generator], RandomLens]] = {
    "mustache": _mustache,
    "profile": lambda k, rng: RandomLens(k, _smooth_profile(rng)),
    "field": lambda k, rng: RandomLens(k, field=_smooth_field(rng, (1.0, 4.0))),
    "both": lambda k, rng: RandomLens(k, _smooth_profile(rng), _smooth_field(rng, (0.5, 2.0))),
    "dome": _dome,
}

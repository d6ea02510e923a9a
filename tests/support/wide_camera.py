"""Cameras that see more than a half-space, for pictures: a ray is a direction, not a slope.

The angle t between a ray and the axis decides the radius in the image,

    radius = focal * g(t),   g(t) = t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9   (Kannala and Brandt 2006)

or one of the classic laws: 2 sin(t / 2) keeps areas, 2 tan(t / 2) keeps shapes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import Rays
from neurocal_cli.errors import InputError

Law = Literal["equidistant", "equisolid", "stereographic"]

_STEPS = 12  # of Newton's method for the angle, from the table
_TABLE = 512


@dataclass(frozen=True)
class WideCamera:
    """A camera with a fisheye lens.

    Parameters
    ----------
    focal : float [px]
    centre : (u, v) [px]
    image_size : (width, height) [px]
    k : tuple of up to four floats
        Of the equidistant law only.
    law : {"equidistant", "equisolid", "stereographic"}
    widest : float [rad]
        Angle from the axis beyond which the lens sees nothing.
    """

    focal: float
    centre: tuple[float, float]
    image_size: tuple[int, int]
    k: tuple[float, ...] = ()
    law: Law = "equidistant"
    widest: float = np.pi

    def __post_init__(self) -> None:
        if not 0 < self.widest <= np.pi:
            raise InputError("a lens sees to an angle between 0 and pi from its axis")
        angles = np.linspace(0, self._widest, _TABLE)
        if not (np.diff(self._law(angles)[0]) > 0).all():
            raise InputError("the radius must grow with the angle; choose other coefficients")

    @property
    def radius(self) -> float:
        """Of the image circle [px]."""
        return self.focal * float(self._law(np.array(self._widest))[0])

    def moved(self, du: float, dv: float) -> WideCamera:
        """The camera with its centre moved [px]."""
        return replace(self, centre=(self.centre[0] + du, self.centre[1] + dv))

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (..., 2) of points (..., 3) in the camera's frame, and which of them are seen."""
        across = np.hypot(points[..., 0], points[..., 1])
        angle = np.arctan2(across, points[..., 2])
        radius = self.focal * self._law(angle)[0]
        share = np.where(across > 0, radius / np.where(across > 0, across, 1.0), 0.0)
        return np.array(self.centre) + share[..., None] * points[..., :2], self.sees(points)

    def sees(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 3) are within the lens's field of view."""
        across = np.hypot(points[..., 0], points[..., 1])
        return np.asarray(np.arctan2(across, points[..., 2]) <= self._widest)

    def rays(self, u: Array, v: Array, near: tuple[Array, Array] | None = None) -> Rays:
        """Directions of pixels with derivatives; nan outside the image circle. `near` is not needed."""
        away_u, away_v = (np.asarray(x, dtype=float) - c for x, c in zip((u, v), self.centre, strict=True))
        radius = np.maximum(np.hypot(away_u, away_v), 1e-9)
        angle = self._angle(radius / self.focal)
        slope = 1 / (self.focal * self._law(angle)[1])  # of the angle by the radius
        cos_a, sin_a = away_u / radius, away_v / radius
        sine, cosine = np.sin(angle), np.cos(angle)
        along, around = cosine * slope, sine / radius
        return Rays(
            u, v, sine * cos_a, sine * sin_a,
            along * cos_a**2 + around * sin_a**2,
            (along - around) * cos_a * sin_a,
            (along - around) * cos_a * sin_a,
            along * sin_a**2 + around * cos_a**2,
            cosine,
            -sine * slope * cos_a,
            -sine * slope * sin_a,
        )  # fmt: skip

    @property
    def _widest(self) -> float:
        return min(self.widest, np.pi - 1e-3) if self.law == "stereographic" else self.widest

    def _law(self, angle: Array) -> tuple[Array, Array]:
        """G and its derivative."""
        if self.law == "equisolid":
            return 2 * np.sin(0.5 * angle), np.maximum(np.cos(0.5 * angle), 1e-9)
        if self.law == "stereographic":
            tangent = np.tan(0.5 * np.minimum(angle, np.pi - 1e-3))
            return 2 * tangent, 1 + tangent**2
        square = angle**2
        g, slope, power = np.ones_like(angle), np.ones_like(angle), np.ones_like(angle)
        for n, k in enumerate(self.k, start=1):
            power = power * square
            g, slope = g + k * power, slope + (2 * n + 1) * k * power
        return angle * g, slope

    def _angle(self, radius: Array) -> Array:
        """Angle of a radius in focal lengths, nan outside the image circle."""
        table = np.linspace(0, self._widest, _TABLE)
        radii = self._law(table)[0]
        angle = np.interp(radius, radii, table)
        for _ in range(_STEPS):
            value, slope = self._law(angle)
            step = (radius - value) / slope
            angle = np.clip(angle + step, 0, self._widest)
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        return np.where(radius <= radii[-1], angle, np.nan)


@dataclass(frozen=True)
class ImageCircle:
    """The round image of a fisheye that does not fill the picture; it is dark outside.

    Parameters
    ----------
    centre : (u, v) [px]
    radius : float [px]
    soft : float [px]
        Width over which the light fades at the rim.
    vignetting : float
        Share of the light that is lost at the rim.
    ring : float
        Light of a bright ring at the rim, as some lenses have, 1 being full scale.
    """

    centre: tuple[float, float]
    radius: float
    soft: float = 3.0
    vignetting: float = 0.0
    ring: float = 0.0

    def __post_init__(self) -> None:
        if self.radius <= 0 or self.soft <= 0 or not 0 <= self.vignetting <= 1:
            raise InputError("an image circle needs a radius, a soft rim, and vignetting from 0 to 1")

    def __call__(self, image: Array) -> Array:
        """What it leaves of the light of an image; (height, width) array."""
        height, width = image.shape
        u, v = np.arange(width) - self.centre[0], np.arange(height)[:, None] - self.centre[1]
        radius = np.hypot(u, v)
        away = (radius - self.radius) / self.soft
        share = 1 / (1 + np.exp(np.clip(4 * away, -50, 50)))
        fading = 1 - self.vignetting * np.minimum(radius / self.radius, 1) ** 4
        return np.asarray(image * share * fading + self.ring * np.exp(-0.5 * away**2))

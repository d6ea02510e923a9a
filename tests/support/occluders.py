"""Things in front of rendered boards: something rectangular, something round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import Rays
from neurocal_cli.simulation.rendering.layers import half_plane
from neurocal_cli.simulation.rendering.scene import Cover


@dataclass(frozen=True)
class Rectangle:
    """Something rectangular in front of everything, in image coordinates.

    Parameters
    ----------
    centre : (u, v) [px]
    size : (width, height) [px]
    angle : float [rad]
        From u towards v.
    level : float
        Reflectance.
    """

    centre: tuple[float, float]
    size: tuple[float, float]
    angle: float = 0.0
    level: float = 0.35

    def cover(self, rays: Rays, cell: float, slack: float = 0.0) -> Cover:
        """See `Occluder`."""
        du, dv = rays.u - self.centre[0], rays.v - self.centre[1]
        c, s = np.cos(self.angle), np.sin(self.angle)
        alpha, edges = np.ones_like(du), np.zeros(len(du), dtype=np.int8)
        for length, nu, nv in ((self.size[0], c, s), (self.size[1], -s, c)):
            inward = 0.5 * length - np.abs(nu * du + nv * dv)
            share, touched = half_plane(inward, np.full_like(du, nu), np.full_like(du, nv), cell, slack)
            alpha *= share
            edges += touched
        return _in_front(alpha, self.level, edges)


@dataclass(frozen=True)
class Disc:
    """Something round in front of everything, in image coordinates [px]."""

    centre: tuple[float, float]
    radius: float
    level: float = 0.35

    def cover(self, rays: Rays, cell: float, slack: float = 0.0) -> Cover:
        """See `Occluder`."""
        du, dv = rays.u - self.centre[0], rays.v - self.centre[1]
        radius = np.maximum(np.hypot(du, dv), 1e-9)
        alpha, touched = half_plane(self.radius - radius, du / radius, dv / radius, cell, slack)
        return _in_front(alpha, self.level, touched.astype(np.int8))


def _in_front(alpha: Array, level: float, edges: NDArray[np.int8]) -> Cover:
    return Cover(alpha, level * alpha, np.where(alpha > 0, 0.0, np.inf), edges)

"""Bends of single views: a flat board that leaves its plane by a different quadratic surface in each view.

A thin sheet bends into cylinders. A shallow cylinder whose axis has the angle phi has the height

    a (x cos phi + y sin phi)^2 = a/2 (x^2 + y^2) + a/2 cos 2 phi (x^2 - y^2) + a/2 sin 2 phi (2 x y).

Averaged over all angles, the three shapes on the right have variances in the ratio 2 : 1 : 1. The
best-fitting plane is subtracted from each shape, because the pose absorbs planes.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array

N_SHAPES = 3


@frozen_dataclass(eq=False)
class Bends:
    """The bend of the board in each of the named views."""

    size: float  # [world unit] prior std of each coefficient, the expected rms height of a bend
    names: tuple[str, ...]
    coefficients: Array  # (V, 3) [world unit] of the three shapes in each view

    def of_views(self, names: tuple[str, ...]) -> Array:
        """(V, 3) coefficients of the named views; 0 for unknown views."""
        known = dict(zip(self.names, self.coefficients, strict=True))
        return np.array([known.get(name, np.zeros(N_SHAPES)) for name in names]).reshape(-1, N_SHAPES)

    def determined(self, coefficients: Array) -> float:
        """Effective number of coefficients (V, 3) that the data determine, at the most probable size.

        It follows from the fixed point of MacKay's update: gamma = |w|^2 / size^2 for the coefficients w.
        """
        return float(min((coefficients**2).sum() / self.size**2, coefficients.size))


@frozen_dataclass(eq=False)
class Surface:
    """The three shapes of a bend over the plane of a board."""

    centre: Array  # (3,) [world unit]
    axes: Array  # (3, 3) columns: two in the plane, and the normal
    half: float  # [world unit] half of the board's longer side
    # (3,) factors of the shapes, with which coefficients of variance 1 give heights of mean square 1.
    times: Array
    # (3, 3) the plane subtracted from each shape (columns), as coefficients of 1, x and y (rows).
    planes: Array

    def offsets(self, world: Array) -> Array:
        """(N, 3, 3) offsets of points (N, 3) in world axes, for unit coefficients of the shapes (last)."""
        places = (world - self.centre) @ self.axes[:, :2] / self.half
        heights = _shapes(places) * self.times - _linear(places) @ self.planes
        return np.asarray(self.axes[:, 2, None] * heights[:, None])


def surface_of(given: Array) -> Surface:
    """The shapes for a flat board with the points (n, 3)."""
    centre = given.mean(axis=0)
    normal = np.linalg.svd(given - centre, full_matrices=False)[2][2]
    normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
    x = np.eye(3)[np.argmin(np.abs(normal))]  # not principal axes: a square board has none
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    axes = np.column_stack([x, np.cross(normal, x), normal])
    places = (given - centre) @ axes[:, :2]
    half = 0.5 * float(np.ptp(places, axis=0).max())
    places = places / half
    times = np.sqrt([2.0, 1.0, 1.0])
    shapes = _shapes(places) * times
    planes = np.linalg.lstsq(_linear(places), shapes, rcond=None)[0]
    mean_square = ((shapes - _linear(places) @ planes) ** 2).mean(axis=0).sum()
    return Surface(centre, axes, half, times / np.sqrt(mean_square), planes / np.sqrt(mean_square))


def _shapes(places: Array) -> Array:
    x, y = places.T
    return np.column_stack([x * x + y * y, x * x - y * y, 2 * x * y])


def _linear(places: Array) -> Array:
    return np.column_stack([np.ones(len(places)), places])

"""Distortion of normalised image points, and its derivatives.

A point (x, y) = (X, Y) / Z of the camera's frame goes to (x', y') and then through A. The models and the
order of their coefficients are OpenCV's:

    k1, k1k2, k1k2p1p2, plumb_bob, rational
        x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y,
        R = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6);
        coefficients k1, k2, p1, p2, k3, k4, k5, k6, of which the simpler models have the first
        1, 2, 4, 5 and 8                                          (Brown 1971; Heikkila 2000)
    fisheye
        (x', y') = (x, y) theta (1 + k1 theta^2 + ... + k4 theta^8) / r,  theta = atan(r)
                                                                  (Kannala and Brandt 2006)

The inverse is `neurocal_cli.camera.monotonic.undistort`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neurocal_cli.errors import InputError
from neurocal_cli.geometry import Array

__all__ = [
    "MODELS",
    "Coefficients",
    "Distortion",
    "coefficient_names",
    "distort",
    "distort_with_jacobian",
    "pinhole_coefficients",
]

MODELS = {
    "none": (),
    "k1": ("k1",),
    "k1k2": ("k1", "k2"),
    "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}

_TINY = 1e-12  # squared radius below which a fisheye is its own tangent


def coefficient_names(model: str) -> tuple[str, ...]:
    """Names of a model's coefficients, in order.

    Raises
    ------
    InputError
        There is no such model.
    """
    if model not in MODELS:
        raise InputError(f"distortion model {model[:40]!r} is unknown; use one of {', '.join(MODELS)}")
    return MODELS[model]


@dataclass(frozen=True, eq=False)
class Distortion:
    """A distortion model with its coefficients; without arguments, none.

    Parameters
    ----------
    model : str
        One of `MODELS`.
    coefficients : sequence of float
        As many as the model has; missing ones are 0.

    Raises
    ------
    InputError
        An unknown model, too many coefficients, or one that is not finite.
    """

    model: str = "none"
    coefficients: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        names = coefficient_names(self.model)
        values = np.array(self.coefficients, dtype=float).ravel()
        if values[len(names) :].any() or not np.isfinite(values).all():
            raise InputError(
                f"the distortion model {self.model} needs {len(names)} finite coefficients; correct them"
            )
        padded = np.zeros(len(names))
        padded[: len(values)] = values[: len(names)]
        padded.setflags(write=False)
        object.__setattr__(self, "coefficients", padded)

    @property
    def is_identity(self) -> bool:
        """Whether it moves no point; a fisheye always moves some."""
        return self.model != "fisheye" and not self.coefficients.any()


# A number, or an array that broadcasts against the points.
Coefficients = Sequence[Any] | Array

# (x', y'); dx'/dx, dx'/dy, dy'/dx, dy'/dy; and dx', dy' by each coefficient.
Distorted = tuple[tuple[Array, Array], tuple[Array, Array, Array, Array], list[tuple[Array, Array]]]


def pinhole_coefficients(model: str) -> Array:
    """Coefficients with which a model moves no point.

    For a fisheye to the ninth order, where tan(theta) = theta (1 + theta^2 / 3 + ...).
    """
    if model == "fisheye":
        return np.array([1 / 3, 2 / 15, 17 / 315, 62 / 2835])
    return np.zeros(len(coefficient_names(model)))


def distort(model: str, k: Coefficients, x: Array, y: Array) -> tuple[Array, Array]:
    """Distort normalised image points.

    Parameters
    ----------
    model : str
    k : sequence of coefficients
        Each a number or an array that broadcasts against x.
    x, y : arrays of one shape

    Returns
    -------
    x', y' : arrays of that shape
    """
    if model == "fisheye":
        return _fisheye(k, x, y)[0]
    r2 = x * x + y * y
    R, _ = _radial(k, r2)
    return (x * R, y * R) if len(k) <= 2 else _tangential(k, x, y, r2, R)[1]


def distort_with_jacobian(model: str, k: Coefficients, x: Array, y: Array) -> Distorted:
    """Distort normalised image points, with derivatives.

    Returns
    -------
    point : (x', y')
    by_point : four arrays
        dx'/dx, dx'/dy, dy'/dx, dy'/dy.
    by_coefficient : list of pairs of arrays
        dx', dy' by each coefficient.
    """
    if model == "fisheye":
        return _fisheye(k, x, y)
    return _polynomial(k, x, y)


def _radial(k: Coefficients, r2: Array) -> tuple[Array, Any]:
    """R, and one over its denominator."""
    k1, k2, _, _, k3, k4, k5, k6 = _all(k)
    R = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if len(k) <= 5:
        return R, 1.0
    inverse = 1.0 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return R * inverse, inverse


def _tangential(
    k: Coefficients, x: Array, y: Array, r2: Array, R: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Q = R + 2 (p1 y + p2 x), and the distorted point (x Q + p2 r^2, y Q + p1 r^2)."""
    p1, p2 = k[2], k[3]
    Q = R + (2 * p1) * y + (2 * p2) * x
    return Q, (x * Q + p2 * r2, y * Q + p1 * r2)


def _polynomial(k: Coefficients, x: Array, y: Array) -> Distorted:
    count = len(k)
    k1, k2, p1, p2, k3, k4, k5, k6 = _all(k)
    x2, y2 = x * x, y * y
    r2 = x2 + y2
    r4 = r2 * r2
    R, inverse = _radial(k, r2)
    slope = k1 + r2 * (2 * k2 + r2 * (3 * k3))  # dR / d(r^2)
    powers = (r2, r4, r4 * r2) if count > 4 else (r2, r4)[:count]
    by_radial = [(x * power, y * power) for power in powers]
    if count > 5:
        slope = (slope - R * (k4 + r2 * (2 * k5 + r2 * (3 * k6)))) * inverse
        by_radial = [(dx * inverse, dy * inverse) for dx, dy in by_radial]
    twice = 2 * slope
    xy = x * y
    cross = xy * twice
    if count <= 2:
        return (x * R, y * R), (R + x2 * twice, cross, cross, R + y2 * twice), by_radial
    Q, distorted = _tangential(k, x, y, r2, R)
    cross = cross + (2 * p1) * x + (2 * p2) * y
    xx, yy = Q + x2 * twice + (4 * p2) * x, Q + y2 * twice + (4 * p1) * y
    xy2 = 2 * xy
    by = [*by_radial[:2], (xy2, r2 + 2 * y2), (r2 + 2 * x2, xy2), *by_radial[2:]]
    if count > 5:
        by += [(-R * dx, -R * dy) for dx, dy in by_radial]
    return distorted, (xx, cross, cross, yy), by


def _all(k: Coefficients) -> list[Any]:
    """All eight coefficients, 0 where a model has none."""
    return [*k, *[0.0] * (8 - len(k))]


def _fisheye(k: Coefficients, x: Array, y: Array) -> Distorted:
    k1, k2, k3, k4 = k
    r2 = np.maximum(x * x + y * y, _TINY)
    r = np.sqrt(r2)
    theta = np.arctan(r)
    t2 = theta * theta
    radius = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    growth = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    scale = radius / r
    slope = (growth / (1 + r2) - scale) / r2  # d(scale) / dr / r
    by = []
    power = theta * t2 / r
    for _ in range(4):
        by.append((x * power, y * power))
        power = power * t2
    cross = x * y * slope
    return (x * scale, y * scale), (scale + x * x * slope, cross, cross, scale + y * y * slope), by

"""Directions from distorted points: the inverse of `project_directions` on the monotonic domain."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.directions import project_directions
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.geometry import Array

# Checked by tests/test_directions.py: random lenses of all models are inverted to 1e-9 up to 99 % of their
# largest angle.
_TABLE = 4096  # angles
_NEWTON_STEPS = 30
_STEP = 1e-9  # rad; last Newton step: the next one would be its square, which is rounding
_ACCURACY = 1e-11  # largest error of the point when projected again
_HALVINGS = 40
_SMALLEST = 1e-30  # smaller coefficients count as 0: their roots overflow or lie outside any image
_REAL = 1e-6  # imaginary over real part of a double root that rounding can cause


def largest_angle(distortion: Distortion) -> float:
    """Angle from the axis [rad] up to which the image radius of a wide lens grows, at most pi.

    Tangential terms are ignored, because they are small within any image.
    """
    if distortion.model in ("fisheye", "rich"):  # the displacement of a rich lens is small
        slope = np.array([1.0, *(distortion.coefficients[:4] * [3, 5, 7, 9])])
        return float(min(np.sqrt(first_root(slope)), np.pi))
    theta = np.linspace(0.0, np.pi, _TABLE)
    seen = _along_radius(distortion, theta)[1]
    if seen.all():
        return float(np.pi)
    beyond = int(np.argmin(seen))
    low, high = theta[max(beyond - 1, 0)], theta[beyond]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _along_radius(distortion, np.array([middle]))[1][0] else (low, middle)
    return float(low)


def first_root(coefficients: Array) -> float:
    """Smallest positive real root of a polynomial, infinity if there is none; lowest order first."""
    roots = np.roots(np.where(np.abs(coefficients) > _SMALLEST, coefficients, 0.0)[::-1])
    real = roots.real[(np.abs(roots.imag) <= _REAL * np.abs(roots.real)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def _along_radius(distortion: Distortion, theta: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Distorted radii of angles, without tangential terms or a field, and whether they grow there."""
    names = coefficient_names(distortion.model)
    k = [
        0.0 if name in ("p1", "p2") or name[0] == "f" else value
        for name, value in zip(names, distortion.coefficients, strict=True)
    ]
    with np.errstate(all="ignore"):
        ray = np.sin(theta), np.zeros_like(theta), np.cos(theta)
        out = project_directions(distortion.model, k, *ray, by_coefficients=False)
    return out.x, out.seen


def unproject_directions(distortion: Distortion, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Unit vectors X, Y, Z that a wide lens maps to distorted points x, y of one shape; else ``nan``.

    Newton's method on the unit sphere starts from the inverse of the model without tangential terms.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    k, limit = distortion.coefficients, largest_angle(distortion)
    # Equal steps up to the limit, which is excluded.
    angles = np.linspace(0.0, limit, _TABLE, endpoint=False)
    radii = _along_radius(distortion, angles)[0]
    radius = np.hypot(x, y)
    with np.errstate(all="ignore"):
        theta = np.interp(radius, radii, angles)
        share = np.where(radius > 0, np.sin(theta) / radius, 0.0)
        X, Y, Z = x * share, y * share, np.cos(theta)
        for _ in range(_NEWTON_STEPS):
            seen = project_directions(distortion.model, k, X, Y, Z, by_coefficients=False)
            X, Y, Z, step = _moved((X, Y, Z), seen.by_x, seen.by_y, x - seen.x, y - seen.y)
            if not np.fmax.reduce(step, axis=None, initial=0.0) > _STEP:
                break
        seen = project_directions(distortion.model, k, X, Y, Z, by_coefficients=False)
        good = np.hypot(seen.x - x, seen.y - y) < _ACCURACY * (1 + radius)
        good &= seen.seen & (np.cos(limit) < Z)
    return np.where(good, X, np.nan), np.where(good, Y, np.nan), np.where(good, Z, np.nan)


_Three = tuple[Array, Array, Array]


def _moved(
    ray: _Three, by_x: _Three, by_y: _Three, dx: Array, dy: Array
) -> tuple[Array, Array, Array, Array]:
    """Unit rays after a Newton step perpendicular to them, and the length of the step."""
    X, Y, Z = ray
    # Two directions perpendicular to the ray: away from the axis, and around it.
    rho = np.hypot(X, Y)
    cosine = np.where(rho > 0, X / rho, 1.0)
    sine = np.where(rho > 0, Y / rho, 0.0)
    outwards, around = (Z * cosine, Z * sine, -rho), (-sine, cosine, np.zeros_like(X))
    xo, yo, xa, ya = (
        sum(d * e for d, e in zip(by, across, strict=True))
        for across in (outwards, around)
        for by in (by_x, by_y)
    )
    det = xo * ya - xa * yo
    a, b = (ya * dx - xa * dy) / det, (xo * dy - yo * dx) / det
    X, Y, Z = (r + a * o + b * c for r, o, c in zip(ray, outwards, around, strict=True))
    length = np.sqrt(X * X + Y * Y + Z * Z)
    return X / length, Y / length, Z / length, np.hypot(a, b)

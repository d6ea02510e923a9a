"""The distortion of ordinary lenses: polynomials of the slopes (x, y) = (X, Y) / Z, and their derivatives.

    x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y,
    R = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)       (Brown 1971; Heikkila 2000)

with the coefficients k1, k2, p1, p2, k3, k4, k5, k6, of which simpler models have the first 1, 2, 4, 5 or 8.
A thin prism (Weng, Cohen and Herniou 1992) adds s1 r^2 + s2 r^4 to x' and s3 r^2 + s4 r^4 to y' (OpenCV's 12
coefficients). A tilted sensor (Scheimpflug; Louhichi 2007) is applied last, with tauX and tauY (OpenCV's 14
coefficients). It turns a distorted point (x, y, 1) by R = Ry(tauY) Rx(tauX) and projects it back along the
optical axis. With the cosines and sines of tauX and tauY, that is

    x' = cX x / w,  y' = (cY y - sX sY x) / w,  w = sY x - cY sX y + cY cX
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neurocal_cli.camera.geometry import Array

# A number, or an array that broadcasts against the points.
Coefficients = Sequence[Any] | Array

# (x', y'); dx'/dx, dx'/dy, dy'/dx, dy'/dy; and dx', dy' by each coefficient.
Distorted = tuple[tuple[Array, Array], tuple[Array, Array, Array, Array], list[tuple[Array, Array]]]


def distorted(k: Coefficients, x: Array, y: Array) -> tuple[Array, Array]:
    """Distorted points x', y' of undistorted ones x, y, in normalised coordinates; arrays of one shape."""
    r2 = x * x + y * y
    R, _ = _radial(k, r2)
    if len(k) <= 2:
        return x * R, y * R
    _, point = _tangential(k, x, y, r2, R)
    if len(k) > 8:
        point = _behind_prism(k, point, r2)
    return tilted(k[12], k[13], *point) if len(k) > 12 else point


def _radial(k: Coefficients, r2: Array) -> tuple[Array, Any]:
    """R, and one over its denominator."""
    k1, k2, _, _, k3, k4, k5, k6 = first_eight(k)
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


def _behind_prism(k: Coefficients, point: tuple[Array, Array], r2: Array) -> tuple[Array, Array]:
    s1, s2, s3, s4 = k[8:12]
    return point[0] + r2 * (s1 + s2 * r2), point[1] + r2 * (s3 + s4 * r2)


def distorted_with_jacobian(k: Coefficients, x: Array, y: Array) -> Distorted:
    """Distorted points, their derivatives by the points, and by each coefficient."""
    count = len(k)
    k1, k2, p1, p2, k3, k4, k5, k6 = first_eight(k)
    x2, y2 = x * x, y * y
    r2 = x2 + y2
    r4 = r2 * r2
    R, inverse = _radial(k, r2)
    slope = k1 + r2 * (2 * k2 + r2 * (3 * k3))  # dR / d(r^2)
    powers = [r2, r4, r4 * r2] if count > 4 else [r2, r4][:count]
    if count > 5:
        slope = (slope - R * (k4 + r2 * (2 * k5 + r2 * (3 * k6)))) * inverse
        powers = [power * inverse for power in powers]
    by_radial = [(x * power, y * power) for power in powers]
    twice = 2 * slope
    xy = x * y
    cross = xy * twice
    if count <= 2:
        return (x * R, y * R), (R + x2 * twice, cross, cross, R + y2 * twice), by_radial
    Q, point = _tangential(k, x, y, r2, R)
    cross = cross + (2 * p1) * x + (2 * p2) * y
    xx, yy = Q + x2 * twice + (4 * p2) * x, Q + y2 * twice + (4 * p1) * y
    xy2 = 2 * xy
    by = [*by_radial[:2], (xy2, r2 + 2 * y2), (r2 + 2 * x2, xy2), *by_radial[2:]]
    if count > 5:
        lower = -R
        by += [(lower * dx, lower * dy) for dx, dy in by_radial]
    if count <= 8:
        return point, (xx, cross, cross, yy), by
    s1, s2, s3, s4 = k[8:12]
    along, across = 2 * s1 + (4 * s2) * r2, 2 * s3 + (4 * s4) * r2
    by_point = xx + along * x, cross + along * y, cross + across * x, yy + across * y
    none = np.zeros_like(r2)
    by += [(r2, none), (r4, none), (none, r2), (none, r4)]
    point = _behind_prism(k, point, r2)
    if count <= 12:
        return point, by_point, by
    xx, xy, yx, yy = by_point
    point, (a, b, c, d), by_tau = _tilted_with_jacobian(k[12], k[13], *point)
    by_point = a * xx + b * yx, a * xy + b * yy, c * xx + d * yx, c * xy + d * yy
    return point, by_point, [*((a * dx + b * dy, c * dx + d * dy) for dx, dy in by), *by_tau]


def first_eight(k: Coefficients) -> list[Any]:
    """The first eight coefficients; 0 for those that the model lacks."""
    return [*k[:8], *[0.0] * (8 - len(k))]


def sensor_rotation(tau_x: float, tau_y: float) -> Array:
    """(3, 3) R of a tilted sensor."""
    cX, sX, cY, sY = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    return np.array([[cY, sX * sY, -cX * sY], [0.0, cX, sX], [sY, -sX * cY, cX * cY]])


def tilted(tau_x: Any, tau_y: Any, x: Array, y: Array) -> tuple[Array, Array]:
    """Points x', y' on the tilted sensor of distorted points x, y; normalised, arrays of one shape."""
    cX, sX, cY, sY = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    w = sY * x - cY * sX * y + cY * cX
    return cX * x / w, (cY * y - sX * sY * x) / w


def untilted(tau_x: float, tau_y: float, x: Array, y: Array) -> tuple[Array, Array]:
    """The inverse of `tilted`."""
    cX, sX, cY, sY = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    w = cY * cX / (1 + sX * y - sY * cX * x)
    straight = x * w / cX
    return straight, (y * w + sX * sY * straight) / cY


def _tilted_with_jacobian(tau_x: Any, tau_y: Any, x: Array, y: Array) -> Distorted:
    """As `tilted`, with the derivatives by the points and by tauX and tauY."""
    cX, sX, cY, sY = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    inverse = 1.0 / (sY * x - cY * sX * y + cY * cX)
    u, v = cX * x * inverse, (cY * y - sX * sY * x) * inverse
    by_point = (
        (cX - u * sY) * inverse, u * cY * sX * inverse,
        -(sX * sY + v * sY) * inverse, (cY + v * cY * sX) * inverse,
    )  # fmt: skip
    w_x, w_y = -cY * (cX * y + sX), cY * x + sY * (sX * y - cX)
    by_tau = [
        ((-sX * x - u * w_x) * inverse, (-cX * sY * x - v * w_x) * inverse),
        (-u * w_y * inverse, (-sY * y - sX * cY * x - v * w_y) * inverse),
    ]
    return (u, v), by_point, by_tau

"""A tilted image sensor: the last two of OpenCV's coefficients, tauX and tauY (Scheimpflug; Louhichi 2007).

A distorted point (x, y, 1) is turned by R = Ry(tauY) Rx(tauX) and projected back along the optical axis:

    x' = cX x / w,  y' = (cY y - sX sY x) / w,  w = sY x - cY sX y + cY cX

with the cosines and sines of tauX and tauY.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neurocal_cli.geometry import Array

# Derivatives of x' by x and y, of y' by x and y.
_ByPoint = tuple[Array, Array, Array, Array]


def sensor_rotation(tau_x: float, tau_y: float) -> Array:
    """(3, 3) R."""
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


def tilted_with_jacobian(
    tau_x: Any, tau_y: Any, x: Array, y: Array
) -> tuple[tuple[Array, Array], _ByPoint, list[tuple[Array, Array]]]:
    """The same with the derivatives by the points and by tauX and tauY."""
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

"""Wide lenses: models that project directions, including those of 90 degrees and more from the axis.

A point (X, Y, Z) of the camera's frame, of which only the direction matters, is mapped to (x', y'). Then A
is applied. With rho = hypot(X, Y), d = |(X, Y, Z)| and theta = atan2(rho, Z):

    fisheye        (x', y') = (X, Y) theta (1 + k1 theta^2 + ... + k4 theta^8) / rho
                                                                  (Kannala and Brandt 2006)
    omnidir        (x, y) = (X, Y) / (Z + xi d), then k1, k2, p1, p2 of `polynomial`
                                                                  (Mei and Rives 2007)
    double_sphere  (x', y') = (X, Y) / (alpha d2 + (1 - alpha) z1),  z1 = Z + xi d,  d2 = hypot(rho, z1)
                                                                  (Usenko, Demmel and Cremers 2018)
    eucm           (x', y') = (X, Y) / (alpha hypot(sqrt(beta) rho, Z) + (1 - alpha) Z)
                                                                  (Khomutenko, Garcia and Martinet 2016)
    rich           (x', y') = fisheye plus a smooth displacement: `rich_lens`
    decentred      (x', y') = fisheye, then p1, p2 of `polynomial`

omnidir (before its polynomial), double_sphere and eucm have the form (X, Y) / w. Their radius grows with
theta where w > 0 and dw/dZ > 0, because w is homogeneous of degree one. Beyond that the model is not a valid
image.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera import rich_lens
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.polynomial import Coefficients, distorted_with_jacobian

WIDE = {
    "fisheye": ("k1", "k2", "k3", "k4"),
    "omnidir": ("xi", "k1", "k2", "p1", "p2"),
    "double_sphere": ("xi", "alpha"),
    "eucm": ("alpha", "beta"),
    "rich": ("k1", "k2", "k3", "k4", *rich_lens.NAMES),
}
DECENTRED = {model: f"decentred {model}" for model in ("fisheye", "double_sphere", "eucm")}
"""These lenses with p1 and p2. They are no choice of users: they tell what these lenses leave open."""
_CENTRED = {decentred: model for model, decentred in DECENTRED.items()}
BY_DIRECTION = {**WIDE, **{decentred: (*WIDE[model], "p1", "p2") for decentred, model in _CENTRED.items()}}
"""Coefficients of all models of this module."""
# Models whose first coefficient is xi; the scale in the image centre is alpha_u / (1 + xi).
WITH_XI = ("omnidir", "double_sphere")

_FLAT = 1e-3  # an xi whose square is negligible in any image
_TINY = 1e-24  # squared sine below which a direction is on the axis


class Direction(NamedTuple):
    """Image points (x', y') of directions, before A, with derivatives."""

    x: Array
    y: Array
    by_x: tuple[Array, Array, Array]  # of x' by X, Y, Z
    by_y: tuple[Array, Array, Array]
    by_coefficient: list[tuple[Array, Array]]  # of x', y' by each coefficient
    seen: NDArray[np.bool_]  # whether the image radius still grows with theta


def project_directions(
    model: str, k: Coefficients, X: Array, Y: Array, Z: Array, by_coefficients: bool = True
) -> Direction:
    """Project directions (X, Y, Z), arrays of one shape in any unit, with a wide lens, with derivatives.

    Each coefficient is a number or an array that broadcasts against X; a rich lens, which has hundreds, takes
    numbers only. Without `by_coefficients` it leaves out the derivatives by them.
    """
    q = X * X + Y * Y
    if model == "fisheye":
        return _fisheye(k, X, Y, Z, q)
    if model == "omnidir":
        return _distorted(_by_divisor(X, Y, *_unified(k[0], q, Z)), k[1:])
    if model in _CENTRED:
        centred = project_directions(_CENTRED[model], k[:-2], X, Y, Z)
        found = _distorted(centred, (0.0, 0.0, *k[-2:]))
        return found._replace(by_coefficient=[*found.by_coefficient[:-4], *found.by_coefficient[-2:]])
    if model == "rich":
        return _rich(k, X, Y, Z, q, by_coefficients)
    sphere = _double_sphere if model == "double_sphere" else _eucm
    return _by_divisor(X, Y, *sphere(k, q, Z))


def xi_is_flat(model: str, k: Coefficients) -> bool:
    """Whether alpha and alpha_u compensate xi to first order, as in a double sphere near xi = 0."""
    return model == "double_sphere" and bool(abs(k[0]) < _FLAT)


def _fisheye(k: Coefficients, X: Array, Y: Array, Z: Array, q: Array) -> Direction:
    k1, k2, k3, k4 = k
    n = q + Z * Z
    q = np.maximum(q, _TINY * n)
    rho = np.sqrt(q)
    theta = np.arctan2(rho, Z)
    t2 = theta * theta
    growth = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    power = theta / rho
    scale = power * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    along = -growth / n  # d(scale) / dZ
    slope = -(along * Z + scale) / q  # d(scale) / d(rho) / rho
    by = []
    for _ in range(4):
        power = power * t2
        by.append((X * power, Y * power))
    seen = np.asarray((growth > 0) & (scale > 0))
    return _radial(X, Y, scale, slope, along, by, seen)


def _radial(
    X: Array, Y: Array, scale: Array, slope: Array, along: Array,
    by: list[tuple[Array, Array]], seen: NDArray[np.bool_],
) -> Direction:  # fmt: skip
    """(X, Y) times a scale, whose derivatives are rho `slope` by rho and `along` by Z."""
    cross = X * Y * slope
    by_x = scale + X * X * slope, cross, X * along
    by_y = cross, scale + Y * Y * slope, Y * along
    return Direction(X * scale, Y * scale, by_x, by_y, by, seen)


# A divisor w, its derivatives by rho (divided by rho) and by Z, and by each coefficient.
_Divisor = tuple[Array, Array, Array, list[Array]]


def _by_divisor(X: Array, Y: Array, w: Array, w_rho: Array, w_Z: Array, by_k: list[Array]) -> Direction:
    scale = 1.0 / w
    square = -scale * scale
    by = [(X * change, Y * change) for change in (square * w_k for w_k in by_k)]
    return _radial(X, Y, scale, square * w_rho, square * w_Z, by, np.asarray((w > 0) & (w_Z > 0)))


def _unified(xi: Any, q: Array, Z: Array) -> _Divisor:
    d = np.sqrt(q + Z * Z)
    return Z + xi * d, xi / d, 1 + xi * Z / d, [d]


def _double_sphere(k: Coefficients, q: Array, Z: Array) -> _Divisor:
    xi, alpha = k
    z1, z1_rho, z1_Z, (d1,) = _unified(xi, q, Z)
    d2 = np.sqrt(q + z1 * z1)
    by_z1 = alpha * z1 / d2 + (1 - alpha)
    w = alpha * d2 + (1 - alpha) * z1
    return w, alpha / d2 + by_z1 * z1_rho, by_z1 * z1_Z, [by_z1 * d1, d2 - z1]


def _eucm(k: Coefficients, q: Array, Z: Array) -> _Divisor:
    alpha, beta = k
    d = np.sqrt(beta * q + Z * Z)
    w = alpha * d + (1 - alpha) * Z
    return w, alpha * beta / d, alpha * Z / d + (1 - alpha), [d - Z, alpha * q / (2 * d)]


def _distorted(m: Direction, k: Coefficients) -> Direction:
    """Image points to which the distortion `polynomial` with the coefficients k is applied."""
    (x, y), (xx, xy, yx, yy), by_k = distorted_with_jacobian(k, m.x, m.y)

    def after(dx: Array, dy: Array) -> tuple[Array, Array]:
        return xx * dx + xy * dy, yx * dx + yy * dy

    by = [after(dx, dy) for dx, dy in zip(m.by_x, m.by_y, strict=True)]
    seen = m.seen & np.asarray((xx * yy > xy * yx) & (xx + yy > 0))
    return Direction(
        x, y, (by[0][0], by[1][0], by[2][0]), (by[0][1], by[1][1], by[2][1]),
        [*(after(*one) for one in m.by_coefficient), *by_k], seen,
    )  # fmt: skip


def _rich(k: Coefficients, X: Array, Y: Array, Z: Array, q: Array, by_coefficients: bool) -> Direction:
    m = _fisheye(k[:4], X, Y, Z, q)
    more = rich_lens.displacement(np.asarray(k[4:]), X, Y, Z, by_coefficients)
    by_x, by_y = (
        (a[0] + b[0], a[1] + b[1], a[2] + b[2]) for a, b in ((m.by_x, more.by_x), (m.by_y, more.by_y))
    )
    # The image is not folded where the mapping from directions to the image keeps its orientation.
    cross = (
        X * (by_x[1] * by_y[2] - by_x[2] * by_y[1])
        + Y * (by_x[2] * by_y[0] - by_x[0] * by_y[2])
        + Z * (by_x[0] * by_y[1] - by_x[1] * by_y[0])
    )
    return Direction(
        m.x + more.x, m.y + more.y, by_x, by_y, [*m.by_coefficient, *more.by_coefficient],
        m.seen & np.asarray(cross > 0),
    )  # fmt: skip

"""Where a lens model means something: up to the radius at which it folds the image back.

A polynomial goes on beyond the largest angle that its lens sees: with barrel distortion the image turns
back inwards from some radius on, and a pixel then has a second, false straight point far outside. The
true one lies within the first fold.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.distortion_models import Coefficients, Lens, bend, coefficient_names, distort
from neurocal_cli.geometry import Array

__all__ = ["first_fold", "is_seen", "radial_slope", "straight_pixels", "straightened", "undistort"]

_FARTHEST = 1e3  # radius of straight points that no image reaches
_TABLE = 4096
_NEWTON_STEPS = 30
_STEP = 1e-15
_ACCURACY = 1e-11
_REAL = 1e-6  # imaginary part of a double root, over its real part, that rounding makes


def first_fold(lens: Lens) -> float:
    """Radius of straight normalised points from which on the lens maps inwards; infinity if it never does.

    The first zero of the slope of the radius, or of the rational model's denominator; tangential terms,
    small within any image, are left out.
    """
    if lens.model == "fisheye":
        slope = np.array([1.0, *(lens.coefficients * [3, 5, 7, 9])])
        theta = np.sqrt(_first_root(slope))
        return float(np.tan(theta)) if theta < np.pi / 2 else np.inf
    k1, k2, _, _, k3, k4, k5, k6 = np.r_[lens.coefficients, np.zeros(8 - len(lens.coefficients))]
    top, bottom = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    # With s = r^2: d/dr (r top / bottom) is 0 where (top + 2 s top') bottom = 2 s top bottom'.
    slope = np.convolve(top + _twice_s_slope(top), bottom) - np.convolve(top, _twice_s_slope(bottom))
    return float(np.sqrt(min(_first_root(slope), _first_root(bottom))))


def radial_slope(model: str, k: Array, r: Array) -> tuple[Array, Array]:
    """How fast the bent radius grows with the straight one, or a fisheye's with the angle.

    Parameters
    ----------
    model : str
    k : (K,) array
    r : (m,) array
        Straight radii, or a fisheye's angles.

    Returns
    -------
    slope : (m,) array
        Without the tangential terms; not positive from the first fold on.
    by_k : (m, K) array
    """
    s = r[:, None] ** 2
    if model == "fisheye":
        n = np.arange(1, 5)
        by_k = (2 * n + 1) * s**n
        return 1.0 + by_k @ k, by_k
    k1, k2, _, _, k3, k4, k5, k6 = np.r_[k, np.zeros(8 - len(k))]
    n = np.arange(1, 4)
    powers, growths = s**n, 2 * n * s**n  # and 2 s d/ds of them
    top, top_growth = 1.0 + powers @ [k1, k2, k3], growths @ [k1, k2, k3]
    bottom, bottom_growth = 1.0 + powers @ [k4, k5, k6], growths @ [k4, k5, k6]
    slope = (top + top_growth) / bottom - top * bottom_growth / bottom**2
    u, up, v, vp = (values[:, None] for values in (top, top_growth, bottom, bottom_growth))
    by_top = (powers + growths) / v - powers * vp / v**2
    by_bottom = -((u + up) * powers + u * growths) / v**2 + 2 * u * vp * powers / v**3
    none = np.zeros((len(r), 2))
    return slope, np.column_stack([by_top[:, :2], none, by_top[:, 2:], by_bottom])[:, : len(k)]


def _twice_s_slope(p: Array) -> Array:
    return 2.0 * np.arange(len(p)) * p


def _first_root(coefficients: Array) -> float:
    """Smallest positive real root of a polynomial, infinity if there is none; lowest order first."""
    roots = np.roots(coefficients[::-1])
    real = roots.real[(np.abs(roots.imag) <= _REAL * np.abs(roots.real)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def is_seen(lens: Lens, x: Array, y: Array) -> NDArray[np.bool_]:
    """Whether straight normalised points lie where the lens does not fold."""
    with np.errstate(all="ignore"):
        _, (xx, xy, yx, yy), _ = bend(lens.model, lens.coefficients, x, y)
        return np.asarray((np.hypot(x, y) < first_fold(lens)) & (xx * yy - xy * yx > 0))


def undistort(model: str, k: Coefficients, x: Array, y: Array) -> tuple[Array, Array]:
    """Straighten bent points, the inverse of `distort` within the lens's first fold.

    Parameters
    ----------
    model : str
    k : sequence of float
    x, y : arrays of one shape
        Bent normalised points.

    Returns
    -------
    x, y : arrays of that shape
        ``nan`` where no straight point bends to the given one.
    """
    return straightened(Lens(model, np.asarray(k, dtype=float)), x, y)


def straightened(lens: Lens, x: Array, y: Array) -> tuple[Array, Array]:
    """Take a lens off normalised points, within its first fold.

    Newton's method from where the lens without its tangential terms has the point, so that no point
    beyond the fold is found, nor one before it lost.

    Parameters
    ----------
    lens : Lens
    x, y : arrays of one shape

    Returns
    -------
    x, y : arrays of that shape
        ``nan`` where the lens cannot have seen any.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if not lens.bends:
        return x, y
    sx, sy = _radially(lens, x, y)
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            (bx, by), (xx, xy, yx, yy), _ = bend(lens.model, lens.coefficients, sx, sy)
            dx, dy, det = x - bx, y - by, xx * yy - xy * yx
            step = (yy * dx - xy * dy) / det, (xx * dy - yx * dx) / det
            sx, sy = sx + step[0], sy + step[1]
            if not np.nanmax(np.hypot(*step) / (1 + np.hypot(sx, sy)), initial=0.0) > _STEP:
                break
        bx, by = distort(lens.model, lens.coefficients, sx, sy)
        good = np.hypot(bx - x, by - y) < _ACCURACY * (1 + np.hypot(x, y))
    good &= is_seen(lens, sx, sy)
    return np.where(good, sx, np.nan), np.where(good, sy, np.nan)


def _radially(lens: Lens, x: Array, y: Array) -> tuple[Array, Array]:
    """Straight points without the tangential terms, nearly: by a table of radii."""
    names = coefficient_names(lens.model)
    radial = [0.0 if name in ("p1", "p2") else k for name, k in zip(names, lens.coefficients, strict=True)]
    # Even steps of the angle reach any radius.
    last = min(np.arctan(first_fold(lens)), np.arctan(_FARTHEST))
    r = np.tan(np.linspace(0, last, _TABLE, endpoint=False))  # at a pole there is no image
    with np.errstate(all="ignore"):
        bent, _ = distort(lens.model, radial, r, np.zeros(_TABLE))
        seen = np.hypot(x, y)
        straight = np.interp(seen, bent, r)
        stretch = np.where(seen > 0, straight / seen, 1.0)
    return x * stretch, y * stretch


def straight_pixels(lens: Lens, A: Array, pixels: Array) -> Array:
    """Pixels without the lens, (N, 2); nan where the lens cannot have seen any."""
    a, s, b, u0, v0 = A[0, 0], A[0, 1], A[1, 1], A[0, 2], A[1, 2]
    y = (pixels[:, 1] - v0) / b
    x = (pixels[:, 0] - u0 - s * y) / a
    x, y = straightened(lens, x, y)
    return np.column_stack([a * x + s * y + u0, b * y + v0])

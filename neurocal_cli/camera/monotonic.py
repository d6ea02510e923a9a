"""The domain in which a distortion model is monotonic, and its inverse there.

Beyond the field of view a polynomial no longer describes the lens: with barrel distortion the distorted
radius decreases again from some radius on, so a pixel has a second, spurious point far outside. The true
point is the one where the model is monotonic. Wide lenses are inverted to directions, the inverse of
`project_directions`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.directions import project_directions
from neurocal_cli.camera.distortion import (
    Distortion,
    coefficient_names,
    distort,
    distort_with_jacobian,
    radial_part,
)
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.polynomial import first_eight, untilted

# Start and end of Newton's method. Random models of test_monotonic.py are inverted to 1e-8 up to 95 %
# of the radius at which they cease to be monotonic, random wide lenses of test_directions.py to 1e-9 up
# to 99 % of their largest angle.
_FARTHEST = 1e3  # undistorted radius that no image reaches
_TABLE = 4096  # radii, or angles of a wide lens
_NEWTON_STEPS = 30
_STEP = 1e-9  # last Newton step: the next one would be its square, which is rounding
_ACCURACY = 1e-11  # largest error of the point when distorted again
_HALVINGS = 40
_SMALLEST = 1e-30  # smaller coefficients count as 0: their roots overflow or lie outside any image
_REAL = 1e-6  # imaginary over real part of a double root that rounding can cause
_SMALL_STEP = 0.02  # Newton step in the image plane after which the next one would be a thousandth

_Three = tuple[Array, Array, Array]


def monotonic_radius(distortion: Distortion) -> float:
    """Undistorted normalised radius up to which the distorted radius grows; infinity if it always does.

    It is the first zero of the slope or of the rational model's denominator. Tangential terms are ignored,
    because they are small within any image.
    """
    if distortion.wide:
        theta = largest_angle(distortion)
        return float(np.tan(theta)) if theta < np.pi / 2 else np.inf
    k = distortion.coefficients
    k1, k2, _, _, k3, k4, k5, k6 = first_eight(k)
    top, bottom = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    # With s = r^2: d/dr (r top / bottom) is 0 where (top + 2 s top') bottom = 2 s top bottom'.
    twice = 2.0 * np.arange(4)  # 2 s d/ds of a power of s
    slope = np.convolve(top + twice * top, bottom) - np.convolve(top, twice * bottom)
    return float(np.sqrt(min(_first_root(slope), _first_root(bottom))))


def largest_angle(distortion: Distortion) -> float:
    """Angle from the axis [rad] up to which the image radius of a wide lens grows, at most pi.

    Tangential terms are ignored, because they are small within any image.
    """
    if distortion.model in ("fisheye", "rich"):  # the displacement of a rich lens is small
        slope = np.array([1.0, *(distortion.coefficients[:4] * [3, 5, 7, 9])])
        return float(min(np.sqrt(_first_root(slope)), np.pi))
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


def _first_root(coefficients: Array) -> float:
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


def radial_slope(model: str, k: Array, r: Array) -> tuple[Array, Array]:
    """Derivative (m,) of the distorted radius by the undistorted one r (m,); for a fisheye, by the angle r.

    Tangential terms are ignored; its first zero is at `monotonic_radius`. The second result are its
    derivatives (m, K) by the coefficients.
    """
    s = r[:, None] ** 2
    if model == "fisheye":
        n = np.arange(1, 5)
        by_k = (2 * n + 1) * s**n
        return 1.0 + by_k @ k, by_k
    k1, k2, _, _, k3, k4, k5, k6 = first_eight(k)
    n = np.arange(1, 4)
    powers, growths = s**n, 2 * n * s**n  # and 2 s d/ds of them
    top, top_growth = 1.0 + powers @ [k1, k2, k3], growths @ [k1, k2, k3]
    bottom, bottom_growth = 1.0 + powers @ [k4, k5, k6], growths @ [k4, k5, k6]
    slope = (top + top_growth) / bottom - top * bottom_growth / bottom**2
    u, up, v, vp = (values[:, None] for values in (top, top_growth, bottom, bottom_growth))
    by_top = (powers + growths) / v - powers * vp / v**2
    by_bottom = -((u + up) * powers + u * growths) / v**2 + 2 * u * vp * powers / v**3
    none = np.zeros((len(r), 6))
    return slope, np.column_stack([by_top[:, :2], none[:, :2], by_top[:, 2:], by_bottom, none])[:, : len(k)]


def is_monotonic(distortion: Distortion, x: Array, y: Array) -> NDArray[np.bool_]:
    """Whether undistorted normalised points lie where the model is monotonic."""
    with np.errstate(all="ignore"):
        _, (xx, xy, yx, yy), _ = distort_with_jacobian(distortion.model, distortion.coefficients, x, y)
        return np.asarray((x * x + y * y < monotonic_radius(distortion) ** 2) & (xx * yy - xy * yx > 0))


def undistort(
    distortion: Distortion, x: Array, y: Array, near: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """Undistort normalised image points: the inverse of `distort` where the model is monotonic, else ``nan``.

    Newton's method starts from the inverse of the model without tangential terms, so that it finds no
    spurious point and misses no true one; or from undistorted points nearby, if they are given.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if distortion.is_identity:
        return x, y
    if distortion.wide:
        X, Y, Z = unproject_directions(distortion, x, y)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(Z > 0, X / Z, np.nan), np.where(Z > 0, Y / Z, np.nan)
    if distortion.model == "tilted":
        k = distortion.coefficients
        x, y = untilted(float(k[12]), float(k[13]), x, y)
        distortion = Distortion("thin_prism", k[:12])
    radius = monotonic_radius(distortion)
    if near is None:
        sx, sy, good = _newton(distortion, radius, x, y, *_radially(distortion, radius, x, y))
        return np.where(good, sx, np.nan), np.where(good, sy, np.nan)
    sx, sy, good = _newton(distortion, radius, x, y, *near)
    if not good.all():
        sx[~good], sy[~good] = undistort(distortion, x[~good], y[~good])
    return sx, sy


def _newton(
    distortion: Distortion, radius: float, x: Array, y: Array, sx: Array, sy: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Undistort by Newton's method from (sx, sy); also which points converged within `radius`."""
    model, k = distortion.model, distortion.coefficients
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            step_x, step_y, _ = _newton_step(distortion, x, y, sx, sy)
            sx, sy = sx + step_x, sy + step_y
            length = np.hypot(step_x, step_y) / (1 + np.hypot(sx, sy))
            if not np.fmax.reduce(length, axis=None, initial=0.0) > _STEP:
                break
        (bx, by), (xx, xy, yx, yy), _ = distort_with_jacobian(model, k, sx, sy)
        good = np.hypot(bx - x, by - y) < _ACCURACY * (1 + np.hypot(x, y))
        good &= (sx * sx + sy * sy < radius**2) & (xx * yy - xy * yx > 0)
    return sx, sy, good


def _newton_step(
    distortion: Distortion, x: Array, y: Array, sx: Array, sy: Array
) -> tuple[Array, Array, Array]:
    """Step from undistorted points (sx, sy) towards those of (x, y), and the determinant of the Jacobian."""
    model, k = distortion.model, distortion.coefficients
    (bx, by), (xx, xy, yx, yy), _ = distort_with_jacobian(model, k, sx, sy)
    dx, dy, det = x - bx, y - by, xx * yy - xy * yx
    return (yy * dx - xy * dy) / det, (xx * dy - yx * dx) / det, det


def _radially(distortion: Distortion, radius: float, x: Array, y: Array) -> tuple[Array, Array]:
    """Undistort approximately without tangential terms, by a table of radii up to `radius`."""
    radial = radial_part(distortion.model, distortion.coefficients)
    # Even steps of the angle reach any radius.
    last = np.arctan(min(radius, _FARTHEST))
    r = np.tan(np.linspace(0, last, _TABLE, endpoint=False))  # excludes a pole at the end
    with np.errstate(all="ignore"):
        distorted, _ = distort(distortion.model, radial, r, np.zeros(_TABLE))
        seen = np.hypot(x, y)
        stretch = np.where(seen > 0, np.interp(seen, distorted, r) / seen, 1.0)
    return x * stretch, y * stretch


def nearly_undistorted(distortion: Distortion, x: Array, y: Array) -> tuple[Array, Array]:
    """Undistort to about a thousandth: by two Newton steps, or by `undistort` where they do not suffice."""
    if distortion.is_identity:
        return x, y
    sx, sy = x, y
    for _ in range(2):
        step_x, step_y, det = _newton_step(distortion, x, y, sx, sy)
        sx, sy = sx + step_x, sy + step_y
    far = ~((det > 0) & (step_x * step_x + step_y * step_y < _SMALL_STEP**2))
    if far.any():
        sx[far], sy[far] = undistort(distortion, x[far], y[far])
    return sx, sy


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

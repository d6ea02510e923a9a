"""Edge spread function, from -1 on the dark side to +1 on the light side.

With z the distance from the edge in units of sigma_t, ``sigma_t^2 = psf^2 + 1/12``,

    E(z) = erf(z / sqrt 2) + phi(z) (a_3 He_3(z) + a_5 He_5(z))

where phi is the normal density and He_k are Hermite polynomials (Gram-Charlier series). The coefficients
describe the tails of the blur, the pixel's box (see `box_kurtosis`) and sharpening. Then a nonlinear
response, due to gamma or clipping, maps the light x between the levels -1 and +1 to

    F(x) = x + (1 - x^2) (b_0 + b_1 x + b_2 x^2 + ...)

Both are the same along all edges of an image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array

Real = NDArray[np.floating]

RESPONSE_TERMS = 6

# erf(x) = 1 - exp(-x^2) sum_k C_k t^k, t = 1 / (1 + p x): the form of Hastings (Abramowitz and Stegun 7.1.26)
# with seven minimax coefficients, found by Lawson's method. The error is at most 7.3e-10
# (tests/test_fit_models.py). For the pixels of 93 edges, error function and density take 0.13 ms;
# scipy.special.erf takes 1.0 ms, and 0.1 s to import.
_P = 0.34
_C = (
    0.180147914252,
    0.305059451581,
    -0.286036550365,
    1.21118655267,
    -1.25098544733,
    1.08761070411,
    -0.246982625629,
)
_ROOT_HALF = float(np.sqrt(0.5))
_PEAK = float(1 / np.sqrt(2 * np.pi))


def erf_and_density(z: Real) -> tuple[Real, Real]:
    """Error function ``erf(z / sqrt 2)`` and normal density ``exp(-z^2 / 2) / sqrt(2 pi)``.

    Parameters
    ----------
    z : array
        float32 or float64; the results have the same type.
    """
    bell = z * z
    bell *= -0.5
    np.exp(bell, out=bell)
    t = np.abs(z)
    t *= _P * _ROOT_HALF
    t += 1
    np.reciprocal(t, out=t)
    series = t * _C[-1]
    for coefficient in _C[-2::-1]:
        series += coefficient
        series *= t
    series *= bell
    bell *= _PEAK
    np.subtract(1, series, out=series)
    return with_sign(series, z), bell


def with_sign(size: Real, of: Real) -> Real:
    """Give a positive array the sign of another, in place, by the sign bit; faster than `numpy.copysign`."""
    kind, sign = _SIGN_BITS[of.dtype.itemsize]
    bits = size.view(kind)
    bits |= of.view(kind) & sign
    return size


_SIGN_BITS = {4: (np.int32, np.int32(-(2**31))), 8: (np.int64, np.int64(-(2**63)))}


def profile(z: Real, tails: Real) -> tuple[Real, Real, Real]:
    """E(z), its derivative, and the normal density.

    Parameters
    ----------
    z : (E, N) array
    tails : (E, 2) array
        Coefficients a_3 and a_5.
    """
    value, density = erf_and_density(z)
    slope = 2 * density
    if tails.any():
        more, steeper = tails_of(z, density, tails)
        value += more
        slope += steeper
    return value, slope, density


def tails_of(z: Real, density: Real, tails: Real) -> tuple[Real, Real]:
    """Contribution of the tails (E, 2) to the profile at z (E, N), and its derivative."""
    square = z * z
    # Polynomials in z^2; d/dz phi He_k = -phi He_{k+1}.
    value, slope = ((tails @ powers).astype(z.dtype) for powers in (_ODD_POWERS, _EVEN_POWERS))
    more, steeper = _polynomial(square, value), _polynomial(square, slope)
    more *= z
    more *= density
    steeper *= density
    return more, steeper


# Coefficients of He_3 / z and He_5 / z, and of -He_4 and -He_6, as polynomials in z^2.
_ODD_POWERS = np.array([[-3.0, 1.0, 0.0], [15.0, -10.0, 1.0]])
_EVEN_POWERS = np.array([[-3.0, 6.0, -1.0, 0.0], [15.0, -45.0, 15.0, -1.0]])


def _polynomial(x: Real, coefficients: Real) -> Real:
    """Polynomials of x (E, N) with coefficients (E, K), the constant first."""
    value = x * coefficients[:, -1:]
    for k in range(coefficients.shape[1] - 2, 0, -1):
        value += coefficients[:, k, None]
        value *= x
    value += coefficients[:, :1]
    return value


def tail_terms(z: Real, density: Real, out: Real) -> None:
    """Write ``phi He_3`` and ``phi He_5`` of z (E, N) to `out` (E, 2, N)."""
    square = z * z
    odd = density * z
    np.multiply(odd, square - 3, out=out[:, 0])
    np.multiply(odd, square * (square - 10) + 15, out=out[:, 1])


def response(x: Real, coefficients: Array) -> tuple[Real, Real]:
    """F(x) and its derivative, for coefficients b_0, b_1, ..."""
    last, *others = (x.dtype.type(coefficient) for coefficient in coefficients[::-1])
    rest, steep = np.full_like(x, last), np.zeros_like(x)
    for coefficient in others:
        steep *= x
        steep += rest
        rest *= x
        rest += coefficient
    room = 1 - x * x
    steep *= room
    room *= rest
    room += x
    rest *= x
    rest *= 2
    steep -= rest
    steep += 1
    return room, steep


def response_terms(x: Real, scale: Real, out: Real) -> None:
    """Write ``scale (1 - x^2) x^k`` of x (E, N) to `out` (E, RESPONSE_TERMS, N)."""
    np.multiply(scale, 1 - x * x, out=out[:, 0])
    for k in range(1, RESPONSE_TERMS):
        np.multiply(out[:, k - 1], x, out=out[:, k])


def box_kurtosis(normal: Array, sigma: Array) -> Array:
    """Coefficient a_3 of the pixel's box, ``(n_u^4 + n_v^4) / (1440 sigma_t^4)``.

    It follows by Edgeworth's series from the box's fourth cumulant along the normal, -(n_u^4 + n_v^4)/120.

    Parameters
    ----------
    normal : (E, 2) array
        Unit normals.
    sigma : (E,) array [px]
        sigma_t.
    """
    return np.asarray((normal**4).sum(axis=-1) / (1440 * sigma**4))

"""Exact edge spread function for edges so sharp that the pixel's box dominates the blur.

With psf the blur's standard deviation [px], x the distance from the edge [px], e = erf(x / (psf sqrt 2)) and
p the normal density of x / psf, the light of a step and its integrals are

    e,    G = x e + 2 psf p,    H = (x^2 + psf^2) e / 2 + psf x p.

Along the edge's normal, the pixel is the convolution of two boxes with half widths a = |n_u| / 2 and
b = |n_v| / 2. Therefore E is the second difference of H over 4 a b, and its slope is that of G. Because
dH/dpsf = psf e, the derivative of E by psf is the second difference of psf e. The profile without blur, a
ramp with rounded ends, is computed separately to avoid cancellation in these differences.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.fitting.edge_profile import Real, erf_and_density, profile, tails_of, with_sign
from neurocal_cli.geometry import Array

PIXEL = 1 / 12  # px^2, variance of the pixel's box along any direction
# Limits that avoid division by 0, below what can be measured; insensitive.
_LEAST_PSF = 0.02  # px
_LEAST_HALF = 5e-3  # px


def half_widths(normal: Array) -> Array:
    """Half widths (E, 2) of the two boxes [px] of a pixel along unit normals (E, 2); the wider one first."""
    return np.asarray(np.maximum(np.sort(0.5 * np.abs(normal), axis=1)[:, ::-1], _LEAST_HALF))


def box_profile(d: Real, sigma: Real, half: Array) -> tuple[Real, Real, Real]:
    """Edge spread function from -1 to +1, and its derivatives.

    Parameters
    ----------
    d : (E, N) array [px]
        Distance from the edge.
    sigma : (E, 1) array [px]
        ``sigma^2 = psf^2 + 1/12``.
    half : (E, 2) array [px]

    Returns
    -------
    value : (E, N) array
    slope, widening : (E, N) arrays [1/px]
        Derivatives by d and by sigma.
    """
    kind = d.dtype
    a, b = (half[:, k, None].astype(kind) for k in (0, 1))
    psf = np.sqrt(np.maximum(sigma * sigma - kind.type(PIXEL), kind.type(_LEAST_PSF**2)))
    share = 1 / (4 * a * b)
    # Without blur, the profile is a ramp, rounded off within 2 b of its ends.
    size = np.abs(d)
    ramp = np.minimum(size, a - b) / a
    beyond = np.clip(size - (a - b), 0, 2 * b)
    value = with_sign(ramp + beyond * (4 * b - beyond) * share, d)
    slope = np.where(size < a + b, (2 * b - beyond) * (2 * share), 0)
    widening = np.zeros_like(d)
    for x, sign in ((d + (a + b), 1), (d + (a - b), -1), (d - (a - b), -1), (d - (a + b), 1)):
        z = x / psf
        e, p = erf_and_density(z)
        rest = e - with_sign(np.ones_like(x), x)
        weight = sign * share
        p *= psf
        value += weight * (0.5 * (x * x * rest + psf * psf * e) + x * p)
        slope += weight * (x * rest + 2 * p)
        widening += weight * e
    widening *= sigma
    return value, slope, widening


def sharp_profile(
    z: Real, sigma: Real, tails: Real, half: Array | None
) -> tuple[Real, Real, Real | None, Real]:
    """E(z), its derivative by z, the extra derivative by log sigma, and the normal density.

    If the profile only scaled with sigma, the derivative of E(d / sigma) by log sigma would be -z times that
    by z. The pixel's box does not grow with the blur, which adds the third result.

    Parameters
    ----------
    z : (E, N) array
    sigma : (E, 1) array [px]
    tails : (E, 2) array
        As in `profile`.
    half : (E, 2) array or None [px]
        None for `profile` itself.
    """
    if half is None:
        value, slope, density = profile(z, tails)
        return value, slope, None, density
    value, slope, widening = box_profile(z * sigma, sigma, half)
    slope *= sigma
    widening *= sigma
    widening += z * slope
    density = erf_and_density(z)[1]
    if tails.any():
        more, steeper = tails_of(z, density, tails)
        value += more
        slope += steeper
    return value, slope, widening, density

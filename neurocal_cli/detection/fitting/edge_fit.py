"""Model of edges of known curvature, for maximum-likelihood fits to all their pixels.

With (s, d) the coordinates of `Lines` and z = (d - offset - tilt s / (half length)) / sigma, the intensity
around an edge is

    I = A(u, v) + B(u, v) F(x),   x = E(z) Q + phi(z) R

A and B are mean level and half contrast, with fixed gradients. E and F are `edge_profile.profile` and
`response`. Q and R, from `edge_pixels`, are the effect of other lines.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.detection.fitting.batched_newton import BLUR, Linearised, ProfileShape, Single, rows_for
from neurocal_cli.detection.fitting.edge_pixels import EdgePixels
from neurocal_cli.detection.fitting.edge_profile import erf_and_density, response
from neurocal_cli.detection.fitting.pixel_box import sharp_profile
from neurocal_cli.detection.fitting.strips import Strips
from neurocal_cli.geometry import Array

OFFSET, TILT = 0, 1  # the first two values of an edge's fit
_BLUR_LOSS = float(4 / np.sqrt(np.pi))  # integral of 1 - erf(z / sqrt 2)^2


def moments(strips: Strips, half_width: Array, mean: Array, contrast: Array) -> tuple[Array, Array, Array]:
    """Estimate offset, slope and blur of edges in closed form, for an edge anywhere in its strip.

    With e = (I - A) / B, the mean of e over a strip is -offset / half_width, and that of 1 - e^2 is
    4 sigma / sqrt(pi) over the width. The estimate is inaccurate, but needs no initial value.

    Parameters
    ----------
    strips : Strips
    half_width : (E,) array [px]
    mean, contrast : (E,) arrays [DN]

    Returns
    -------
    offset : (E,) array [px]
    slope : (E,) array
    sigma : (E,) array [px]
    """
    inside = strips.inside.astype(np.float32)
    one = np.float32(1.0)
    e = (strips.value - mean.astype(np.float32)[:, None]) / contrast.astype(np.float32)[:, None]
    np.clip(e, -2 * one, 2 * one, out=e)
    e *= inside
    count = np.maximum(inside.sum(axis=1), 1)
    square = np.einsum("en,en,en->e", strips.s, strips.s, inside)
    slope = -half_width * np.einsum("en,en->e", e, strips.s) / np.maximum(square, 1)
    offset = -half_width * e.sum(axis=1) / count
    sigma = 2 * half_width / _BLUR_LOSS * (1 - np.einsum("en,en->e", e, e) / count)
    return offset.astype(float), slope.astype(float), sigma.astype(float)


def light_at(data: EdgePixels, values: Array) -> Single:
    """Approximate the light x (E, N) between the levels, for the weights, which vary slowly with it."""
    offset, sigma = (values[:, k, None].astype(np.float32) for k in (OFFSET, BLUR))
    return np.asarray(erf_and_density((data.d - offset) / sigma)[0] * data.Q, dtype=np.float32)


def edge_model(data: EdgePixels, values: Array, shape: ProfileShape) -> Linearised:
    """Intensity around edges with given values, and its derivatives."""
    offset, tilt, mean, contrast, sigma = np.ascontiguousarray(values.T, data.value.dtype)[:, :, None]
    z = data.d - offset
    z -= tilt * data.lever
    z /= sigma
    x, slope, spread, density = sharp_profile(z, sigma, shape.tails, shape.half)
    # x = E Q + phi R, and its derivative by z.
    density *= data.R
    x *= data.Q
    x += density
    density *= z
    slope *= data.Q
    slope -= density
    gain = data.gain * data.root
    rows = rows_for(len(z), 5, z.shape[1], x.dtype)
    residual, by_offset, by_tilt, by_mean, by_contrast, by_blur = rows.swapaxes(0, 1)[:6]
    factor = gain * (-contrast / sigma)
    if shape.nonlinearity.any():
        F, steep = response(x, shape.nonlinearity)
        factor *= steep
    else:
        F = x
    np.multiply(slope, factor, out=by_offset)
    np.multiply(by_offset, data.lever, out=by_tilt)
    by_mean[...] = data.root
    np.multiply(F, gain, out=by_contrast)
    np.multiply(by_offset, z, out=by_blur)
    if spread is not None:
        spread *= data.Q
        spread *= factor
        by_blur -= spread
    np.subtract(data.value, mean, out=residual)
    residual *= data.root
    residual -= contrast * by_contrast
    return Linearised(rows, z, x)

"""Model of edges of known curvature, for maximum-likelihood fits to all their pixels.

With (s, d) the coordinates of `Lines` and z = (d - offset - tilt s / (half length)) / sigma, the intensity
around an edge is

    I = A(u, v) + B(u, v) F(x),   x = E(z) Q + phi(z) R + ink

A and B are mean level and half contrast, with fixed gradients. E and F are `edge_profile.profile` and
`response`. Q and R are the effect of other lines. Q is a product of erf(t). The t are the distances in sigma
from the lines that cross the edge at both ends and from its two parallel neighbours. R corrects Q for the
crossing angle: blurring sign(z) sign(t) gives erf erf + 4 rho phi phi + ..., with rho the cosine of the angle
between the normals. The ink of markers beside the edge is known; see `markers.ink`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import (
    BLUR,
    FitPixels,
    Linearised,
    ProfileShape,
    rows_for,
)
from neurocal_cli.detection.fitting.edge_profile import erf_and_density, response, sharp_profile
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.strips import GridImage, Lines, Single, Strips, strip_pixels
from neurocal_cli.detection.medians import upper_median

# Half of REACH raises errors by 16 %; doubled, it lowers them by 2 %, with twice the pixels. Half of SHARP
# raises the errors of edges sharper than a pixel up to 9 times. The others are insensitive.
REACH = 4.0  # sigma on both sides of an edge; farther pixels hold no information on its position
SHARP = 0.45  # px; below this blur the box of the pixel is modelled exactly
ALONE = 9.0  # sigma; a parallel line at this distance has no effect
_NEAREST = 0.5  # sigma; least distance of pixels from the crossing lines
_NEAREST_FIRST, _ENDS = 2.0, 0.12  # the same before the last fit: sigma, at most this share of the length
_NEAREST_SHARP = 0.75  # px; the same for sharp edges: the crossing lines cut only nearer pixels
_RIM, _RIM_BLUR = 0.1, 3.0  # share of the length, and sigma, left out at the board's end, which may be cut
_COLUMNS = 40  # columns of pixels along an edge before the last fit
_PLATEAU = 0.67  # of a strip's half width; farther pixels have the levels of the squares
# Relative to the expected contrast: the least contrast that is an edge; the least ratio, or its inverse, and
# the greatest difference of the means that are no other light.
_VISIBLE, _LEAST_RATIO, _MEAN_OFF = 0.1, 0.7, 0.15
OFFSET, TILT = 0, 1  # the first two values of an edge's fit
_BLUR_LOSS = float(4 / np.sqrt(np.pi))  # integral of 1 - erf(z / sqrt 2)^2


@frozen_dataclass(eq=False)
class EdgePixels(FitPixels):
    """Pixels of edges for the fits, (E, N) float32 arrays."""

    lever: Single  # tangential coordinate over half the edge's length
    d: Single  # [px] distance from the edge's line
    R: Single  # see the module


def edge_pixels(
    grid_image: GridImage,
    lines: Lines,
    sigma: Array,
    shading: Shading,
    reach: Array,
    stride: int,
    crossed: NDArray[np.bool_] | None = None,
) -> EdgePixels:
    """Gather the pixels around edges of blur `sigma` (E,) [px], all with weight 1.

    `reach` (E,) [px] is the half width of the strips. Only every `stride`-th column is used; 1 is for the
    last fit, when the crossing lines are well known. `crossed` (E, 2) tells whether another line crosses the
    edge at each end, by default at all. At other ends the board may end, and a part of the edge is left out.
    """
    crossed = np.ones((len(sigma), 2), dtype=np.bool_) if crossed is None else crossed
    trim = (_RIM * lines.length + _RIM_BLUR * sigma)[:, None] * ~crossed
    half = np.minimum(reach, 0.5 * lines.width)
    strips = strip_pixels(grid_image.image, lines, half, trim, stride, grid_image.ink)
    nearest = np.where(sigma < SHARP, _NEAREST_SHARP / sigma, _NEAREST)
    if stride > 1:
        nearest = np.maximum(nearest, np.minimum(_NEAREST_FIRST, _ENDS * lines.length / sigma))
    Q = np.ones_like(strips.s)
    R = np.zeros_like(strips.s)
    used = strips.inside.copy()
    per_sigma = (1 / sigma).astype(np.float32)[:, None]
    for k in (0, 1):
        crossing = lines.crossing[:, k].astype(np.float32)
        end = lines.ends[:, k, None]
        start = end * lines.tangent + 0.5 * lines.curvature[:, None] * end**2 * lines.normal
        shift = (start * lines.crossing[:, k]).sum(axis=1).astype(np.float32)
        t = (strips.u * crossing[:, :1] + strips.v * crossing[:, 1:] - shift[:, None]) * per_sigma
        t[~crossed[:, k]] = ALONE
        used &= t > nearest.astype(np.float32)[:, None]
        fade, density = erf_and_density(t)
        Q *= fade
        rho = (lines.crossing[:, k] * lines.normal).sum(axis=1).astype(np.float32)
        density *= 4 * rho[:, None]
        R += density
    for k, side in ((0, 1), (1, -1)):
        close = lines.apart[:, k] < ALONE * sigma
        if close.any():
            t = (lines.apart[close, k, None].astype(np.float32) + side * strips.d[close]) * per_sigma[close]
            Q[close] *= erf_and_density(t)[0]
    lever = strips.s / (0.5 * lines.length).astype(np.float32)[:, None]
    value, gain = shading.off(lines.middle, strips.u, strips.v, strips.value)
    root = used.astype(np.float32)
    return EdgePixels(value, gain, Q, root, lever, strips.d, R, ink=strips.ink)


def usual_stride(lines: Lines) -> int:
    """Stride of columns before the last fit, chosen for speed."""
    return max(2, int(upper_median(lines.length) / _COLUMNS))


def levels_beside(strips: Strips, half_width: Array, mean: Array, contrast: Array) -> tuple[Array, Array]:
    """Mean level and half contrast of edges: the expected ones (E,), or those of the pixels on both sides.

    The expected levels are wrong where the light changes within a square or two, as at a shadow's border.
    Then the outer pixels of the strips, of half widths (E,) [px], show the levels. In small or blurred
    squares they show them less well, so they are used only if they clearly differ. Where they show no edge,
    something hides the board.
    """
    far = (_PLATEAU * half_width).astype(np.float32)[:, None]
    sides = [(strips.inside & (sign * strips.d > far)).astype(np.float32) for sign in (-1, 1)]
    counts = [side.sum(axis=1) for side in sides]
    dark, light = (
        np.einsum("en,en->e", strips.value, side).astype(float) / np.maximum(count, 1)
        for side, count in zip(sides, counts, strict=True)
    )
    own_mean, own_contrast = 0.5 * (light + dark), 0.5 * (light - dark)
    ratio = own_contrast / contrast
    other = (
        (np.abs(own_mean - mean) > _MEAN_OFF * contrast) | (ratio < _LEAST_RATIO) | (ratio > 1 / _LEAST_RATIO)
    )
    other &= (ratio > _VISIBLE) & (counts[0] > 0) & (counts[1] > 0)
    return np.where(other, own_mean, mean), np.where(other, own_contrast, contrast)


def moments(strips: Strips, half_width: Array, mean: Array, contrast: Array) -> tuple[Array, Array]:
    """Estimate offset [px] and blur [px] (E,) of edges anywhere in strips of half widths (E,) [px].

    With e = (I - A) / B, the mean of e over a strip is -offset / half_width, and the mean of 1 - e^2 is 4
    sigma / sqrt(pi) over the width. The estimate is inaccurate, but needs no initial value.
    """
    inside = strips.inside.astype(np.float32)
    one = np.float32(1.0)
    e = (strips.value - mean.astype(np.float32)[:, None]) / contrast.astype(np.float32)[:, None]
    np.clip(e, -2 * one, 2 * one, out=e)
    e *= inside
    count = np.maximum(inside.sum(axis=1), 1)
    offset = -half_width * e.sum(axis=1) / count
    sigma = 2 * half_width / _BLUR_LOSS * (1 - np.einsum("en,en->e", e, e) / count)
    return offset.astype(float), sigma.astype(float)


def light_at(data: EdgePixels, values: Array) -> Single:
    """Approximate the light x (E, N) between the levels, for the weights, which vary slowly with it."""
    offset, sigma = (values[:, k, None].astype(np.float32) for k in (OFFSET, BLUR))
    x = erf_and_density((data.d - offset) / sigma)[0] * data.Q
    return np.asarray(x if data.ink is None else x + data.ink, dtype=np.float32)


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
    if data.ink is not None:
        x += data.ink
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

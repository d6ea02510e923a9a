"""Maximum-likelihood fits of edges, straight or of known curvature, to all the pixels around them.

In: lines, strips of pixels, levels. Out: `BatchFit` with offset, tilt, levels and blur of each edge. With
(s, d) the coordinates of `Lines` and z = (d - offset - tilt s) / sigma, the light around an edge is

    I = A(u, v) + B(u, v) F(x),   x = E(z) Q + phi(z) R

A and B are mean level and half contrast, with fixed slopes; E and F are `edge_profile.profile` and
`response`. Q is the effect of other lines: a product of erf(t), with t the distances from the lines that
cross the edge at both ends and from its two parallel neighbours. R corrects Q for the crossing angle:
blurring sign(z) sign(t) gives erf erf + 4 rho phi phi + ... with rho the cosine between the normals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fitting.batched_newton import (
    BLUR,
    MORE_STEPS,
    BatchFit,
    LevelPrior,
    Linearised,
    Part,
    ProfileShape,
    fit_batch,
    rows_for,
)
from neurocal_cli.detection.fitting.edge_profile import erf_and_density, response
from neurocal_cli.detection.fitting.pixel_box import sharp_profile
from neurocal_cli.detection.fitting.strips import Lines, Strips
from neurocal_cli.frozen_dataclass import frozen_dataclass
from neurocal_cli.geometry import Array

Single = NDArray[np.float32]

OFFSET, TILT = 0, 1  # the first two values of an edge's fit
# Insensitive.
_ALONE = 9.0  # sigma; a parallel line at this distance has no effect
_BLUR_LOSS = float(4 / np.sqrt(np.pi))  # integral of 1 - erf(z / sqrt 2)^2


@frozen_dataclass(eq=False)
class EdgeData:
    """The pixels as the fits need them, (E, N) float32 arrays.

    Attributes
    ----------
    s, d : arrays [px]
    value : array [DN]
        Minus the slope of A.
    gain : array
        B(u, v) relative to the edge's own.
    Q, R : arrays
    root : array [1/DN]
        Inverse standard deviation of the noise; 0 for pixels that are not used.
    beyond : (E,) array
        Share of the strip's pixels that lie outside the image.
    """

    s: Single
    d: Single
    value: Single
    gain: Single
    Q: Single
    R: Single
    root: Single
    beyond: Array

    @property
    def count(self) -> NDArray[np.int64]:
        """(E,) number of pixels used."""
        return np.count_nonzero(self.root, axis=1)

    def part(self, which: Part) -> EdgeData:
        """The pixels of some edges."""
        return EdgeData(*(getattr(self, field.name)[which] for field in fields(self)))


def moments(strips: Strips, half_width: Array, mean: Array, contrast: Array) -> tuple[Array, Array, Array]:
    """Offset, slope and blur of edges in closed form, for an edge anywhere in its strip.

    With e = (I - A) / B, the mean of e over a strip is -offset / half_width, and that of 1 - e^2 is
    4 sigma / sqrt(pi) over the width. Inaccurate, but needs no start.

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


def edge_data(
    strips: Strips,
    lines: Lines,
    sigma: Array,
    slopes: tuple[Array, Array],
    contrast: Array,
    nearest: Array,
    crossed: NDArray[np.bool_],
) -> EdgeData:
    """Prepare pixels for fits.

    Parameters
    ----------
    strips : Strips
    lines : Lines
    sigma : (E,) array [px]
        sigma_t.
    slopes : pair of (E, 2) arrays [DN/px]
        Of A and B.
    contrast : (E,) array [DN]
        B where the slopes hold.
    nearest : (E,) array
        Least distance of a pixel from the crossing lines, in sigma.
    crossed : (E, 2) bool array
        Whether another line crosses the edge at its ends.
    """
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
        t[~crossed[:, k]] = _ALONE
        used &= t > nearest.astype(np.float32)[:, None]
        fade, density = erf_and_density(t)
        Q *= fade
        rho = (lines.crossing[:, k] * lines.normal).sum(axis=1).astype(np.float32)
        density *= 4 * rho[:, None]
        R += density
    slope_a, slope_b = (g.astype(np.float32) for g in slopes)
    value = strips.value - strips.u * slope_a[:, :1] - strips.v * slope_a[:, 1:]
    relative = slope_b / contrast.astype(np.float32)[:, None]
    gain = 1 + strips.u * relative[:, :1] + strips.v * relative[:, 1:]
    for k, side in ((0, 1), (1, -1)):
        close = lines.apart[:, k] < _ALONE * sigma
        if close.any():
            t = (lines.apart[close, k, None].astype(np.float32) + side * strips.d[close]) * per_sigma[close]
            Q[close] *= erf_and_density(t)[0]
    return EdgeData(strips.s, strips.d, value, gain, Q, R, used.astype(np.float32), strips.beyond)


def fit_edges(
    data: EdgeData,
    start: Array,
    prior: LevelPrior,
    half_length: Array,
    shape: ProfileShape,
    steps: int,
    more: int = MORE_STEPS,
) -> BatchFit:
    """Fit all edges at once.

    Parameters
    ----------
    data : EdgeData
    start : (E, 5) array
        Offset [px], tilt [px over the half length], and the values of `BatchFit`.
    prior : LevelPrior
    half_length : (E,) array [px]
    shape : ProfileShape
    steps, more : int
        As in `fit_batch`.
    """
    lever = data.s / half_length.astype(np.float32)[:, None]

    def model_of(part: Part) -> Callable[[Array], Linearised]:
        pixels, levers, part_shape = data.part(part), lever[part], shape.part(part)
        return lambda values: linearised(pixels, levers, values, part_shape)

    return fit_batch(model_of, start, prior, data.count, steps, more)


def light_at(data: EdgeData, values: Array) -> Single:
    """The light x (E, N) between the levels, approximately, for weights that vary slowly with it."""
    offset, sigma = (values[:, k, None].astype(np.float32) for k in (OFFSET, BLUR))
    return np.asarray(erf_and_density((data.d - offset) / sigma)[0] * data.Q, dtype=np.float32)


def linearised(data: EdgeData, lever: Single, values: Array, shape: ProfileShape) -> Linearised:
    """The model and its derivatives; lever is s over the half length."""
    offset, tilt, mean, contrast, sigma = np.ascontiguousarray(values.T, data.value.dtype)[:, :, None]
    z = data.d - offset
    z -= tilt * lever
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
    np.multiply(by_offset, lever, out=by_tilt)
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


def with_weight(data: EdgeData, weight: Single) -> EdgeData:
    """The same pixels with other weights [1/DN^2]; unused ones stay unused."""
    root = np.sqrt(weight)
    root *= data.root > 0
    return replace(data, root=root)

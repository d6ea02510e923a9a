"""Maximum-likelihood fits of straight or evenly curved edges to all the pixels around them.

The light around an edge, with (s, d) the coordinates of `Lines` and z = (d - offset - tilt s) / sigma,

    I = A(u, v) + B(u, v) (E(z) Q(s) + phi(z) R(s))

A and B are mean level and half contrast, with slopes that are fixed; E is `fit_profile.profile`; Q fades
the edge out where others cross it at both ends, ``Q = erf(t1) erf(t2)`` in the distances t1, t2 from
these, and R corrects that for their angle: blurring sign(z) sign(t) gives erf erf + 4 rho phi phi + ...
with rho the cosine between the normals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fit_profile import erf_and_density, profile
from neurocal_cli.detection.fit_strips import Lines, Strips
from neurocal_cli.geometry import Array

__all__ = ["EdgeData", "EdgeFit", "Prior", "edge_data", "fit_edges", "moments"]

Single = NDArray[np.float32]

OFFSET, TILT, MEAN, CONTRAST, BLUR = range(5)
_NOTHING = 1e-9  # information that keeps fits without pixels from dividing by 0
_LEAST_BLUR = 0.3  # px, sigma_t; the box alone has 0.289
_BLUR_LOSS = float(4 / np.sqrt(np.pi))  # integral of 1 - erf(z / sqrt 2)^2


@dataclass(frozen=True, eq=False)
class EdgeData:
    """What the fits need of the pixels, (E, N) float32 arrays.

    Attributes
    ----------
    s, d : arrays [px]
    value : array [DN]
        Less the slopes' share of A.
    gain : array
        B(u, v) relative to the edge's own.
    Q, R : arrays
        Times `gain`.
    weight : array [1/DN^2]
        Inverse variance of the noise; 0 for pixels that are not used.
    """

    s: Single
    d: Single
    value: Single
    Q: Single
    R: Single
    weight: Single


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of level, contrast and blur beforehand.

    Attributes
    ----------
    mean : (E, 3) array [DN, DN, px]
    precision : (E, 3, 3) array
    """

    mean: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Fitted edges.

    Attributes
    ----------
    values : (E, 5) array
        offset [px], tilt [px over the half length], A, B [DN], sigma_t [px].
    information : (E, 5, 5) array
        Fisher's, from the pixels alone.
    prior : Prior
    chi2, count : (E,) arrays
        Weighted squares of the residuals and number of pixels.
    step : (E,) array
        The last step, in standard deviations.
    model : (E, N) float32 array [DN]
    residual : (E, N) float32 array [DN]
    z : (E, N) float32 array
    """

    values: Array
    information: Array
    prior: Prior
    chi2: Array
    count: Array
    step: Array
    residual: Single
    z: Single

    @property
    def covariance(self) -> Array:
        """(E, 5, 5) of the values."""
        total = self.information.copy()
        total[:, MEAN:, MEAN:] += self.prior.precision
        total[:, range(5), range(5)] += _NOTHING
        return np.asarray(np.linalg.inv(total))

    def scaled(self, noise: float) -> EdgeFit:
        """The same fits, the pixels' variance being another by a factor."""
        return replace(self, information=self.information / noise, chi2=self.chi2 / noise)


def moments(strips: Strips, half_width: Array, mean: Array, contrast: Array) -> tuple[Array, Array, Array]:
    """Offset, tilt and blur of edges in closed form, from anywhere in the strip.

    With e = (I - A) / B, the mean of e over a strip is -offset / half_width, and that of 1 - e^2 is
    4 sigma / sqrt(pi) over the width. Crude, but without a start.

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
    strips: Strips, lines: Lines, sigma: Array, slopes: tuple[Array, Array], contrast: Array, nearest: float
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
    nearest : float
        Pixels nearer than so many sigma to the crossing lines are left out.
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
        used &= t > nearest
        near = t < 4.5
        fade, density = erf_and_density(t[near])
        Q[near] *= fade
        rho = (lines.crossing[:, k] * lines.normal).sum(axis=1).astype(np.float32)
        R[near] += np.broadcast_to(4 * rho[:, None], t.shape)[near] * density
    slope_a, slope_b = (g.astype(np.float32) for g in slopes)
    value = strips.value - strips.u * slope_a[:, :1] - strips.v * slope_a[:, 1:]
    relative = slope_b / contrast.astype(np.float32)[:, None]
    gain = 1 + strips.u * relative[:, :1] + strips.v * relative[:, 1:]
    return EdgeData(strips.s, strips.d, value, Q * gain, R * gain, used.astype(np.float32))


def fit_edges(
    data: EdgeData, start: Array, prior: Prior, half_length: Array, shape: Array, steps: int
) -> EdgeFit:
    """Gauss-Newton steps of all edges at once.

    Parameters
    ----------
    data : EdgeData
    start : (E, 5) array
        As `EdgeFit.values`.
    prior : Prior
    half_length : (E,) array [px]
        Unit of the tilt's lever.
    shape : (E, 5) array
        Of the profile.
    steps : int
    """
    values = start.copy()
    lever = data.s / half_length.astype(np.float32)[:, None]
    size = np.zeros(len(values))
    for _ in range(steps):
        jacobian, residual, _ = linearised(data, lever, values, shape)
        information, gradient = _normal(jacobian, residual, data.weight)
        pull = values[:, MEAN:] - prior.mean
        gradient[:, MEAN:] -= (prior.precision @ pull[:, :, None])[:, :, 0]
        information[:, MEAN:, MEAN:] += prior.precision
        information[:, range(5), range(5)] *= 1 + 1e-9
        information[:, range(5), range(5)] += _NOTHING
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        size = np.sqrt(np.maximum((step * gradient).sum(axis=1), 0))
        values = _moved(values, np.asarray(step, dtype=float))
    jacobian, residual, z = linearised(data, lever, values, shape)
    information, _ = _normal(jacobian, residual, data.weight)
    chi2 = np.einsum("en,en,en->e", residual, residual, data.weight).astype(float)
    count = (data.weight > 0).sum(axis=1)
    return EdgeFit(values, information, prior, chi2, count, size, residual, z)


def linearised(data: EdgeData, lever: Single, values: Array, shape: Array) -> tuple[Single, Single, Single]:
    """Derivatives (E, 5, N) of the model by the values, residuals (E, N) and z (E, N)."""
    offset, tilt, mean, contrast, sigma = (x.astype(np.float32)[:, None] for x in values.T)
    z = data.d - offset
    z -= tilt * lever
    z /= sigma
    E, slope, density = profile(z, shape)
    jacobian = np.empty((len(z), 5, z.shape[1]), dtype=np.float32)
    light = jacobian[:, CONTRAST]
    np.multiply(E, data.Q, out=light)
    light += density * data.R
    slope *= data.Q
    slope -= z * density * data.R
    slope *= -contrast / sigma
    jacobian[:, OFFSET] = slope
    np.multiply(slope, lever, out=jacobian[:, TILT])
    jacobian[:, MEAN] = 1
    np.multiply(slope, z, out=jacobian[:, BLUR])
    residual = data.value - mean
    residual -= contrast * light
    return jacobian, residual, z


def _normal(jacobian: Single, residual: Single, weight: Single) -> tuple[Array, Array]:
    weighted = jacobian * weight[:, None, :]
    information = weighted @ jacobian.swapaxes(1, 2)
    gradient = weighted @ residual[:, :, None]
    return information.astype(float), gradient[:, :, 0].astype(float)


def _moved(values: Array, step: Array) -> Array:
    """Values after a step, kept from leaving the range where the model is nearly linear."""
    sigma = values[:, BLUR]
    step = step.copy()
    step[:, OFFSET] = np.clip(step[:, OFFSET], -sigma, sigma)
    step[:, TILT] = np.clip(step[:, TILT], -sigma, sigma)
    values = values + step
    values[:, BLUR] = np.clip(values[:, BLUR], np.maximum(0.6 * sigma, _LEAST_BLUR), 1.6 * sigma)
    return values


def with_weight(data: EdgeData, weight: Single) -> EdgeData:
    """The same pixels with other weights; those not used stay unused."""
    return replace(data, weight=np.where(data.weight > 0, weight, np.float32(0)))

"""What all edges of an image share: the noise of their pixels and the shape of their profile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.detection.fit_edges import BLUR, CONTRAST, MEAN, EdgeData, EdgeFit, Prior
from neurocal_cli.detection.fit_profile import erf_and_density, shape_terms
from neurocal_cli.detection.fit_shading import Shading
from neurocal_cli.geometry import Array

__all__ = ["level_prior", "noise_weight", "profile_shape"]

Single = NDArray[np.float32]

_FLAT = 2.0  # sigma from the edge, where the profile has become level
# Noise that seems smaller than this share of the largest, as that of clipped pixels does, is not believed.
_LEAST_SHARE = 0.3
_BLUR_SPREAD = 0.05  # of single edges' blur around the board's
_LEAST_SPREAD = 0.002  # of levels, in variances of the noise


def noise_weight(data: EdgeData, fit: EdgeFit, floor: float) -> Single:
    """Inverse variance of each pixel's noise, from the residuals on the dark side, the light one, between.

    Parameters
    ----------
    data : EdgeData
    fit : EdgeFit
        Of these data.
    floor : float [DN^2]
        Variance that rounding makes at least.

    Returns
    -------
    weight : (E, N) array [1/DN^2]
        0 for pixels not used.
    """
    used = data.weight > 0
    square = fit.residual**2
    variances = []
    for part in (fit.z < -_FLAT, np.abs(fit.z) <= _FLAT, fit.z > _FLAT):
        mine = part & used
        count = mine.sum(axis=1)
        some = count >= min(8, int(count.max(initial=0)))
        sums = np.einsum("en,en->e", square, mine.astype(np.float32))
        # The median over the edges does not see those that are hidden.
        variances.append(float(np.median(sums[some] / np.maximum(count[some], 1))) if some.any() else 0.0)
    low, middle, high = np.maximum(variances, max(floor, _LEAST_SHARE * max(variances)))
    at = np.clip(fit.z / np.float32(_FLAT), -1, 1)
    variance = middle + np.where(at < 0, middle - low, high - middle) * at
    return np.where(used, 1 / variance, 0).astype(np.float32)


def profile_shape(data: EdgeData, fit: EdgeFit, good: NDArray[np.bool_]) -> Array:
    """Correction of the profile's coefficients from what the fits have left over, by least squares.

    Shift, blur and levels are varied along with them, so that these don't hide what they cannot change.

    Parameters
    ----------
    data : EdgeData
    fit : EdgeFit
    good : (E,) bool array
        Edges to use.

    Returns
    -------
    shape : (5,) array
        To be added to `SHAPE_ORDERS`' coefficients.
    """
    z = fit.z[good]
    value, density = erf_and_density(z)
    scale = fit.values[good, CONTRAST].astype(np.float32)[:, None] * data.Q[good]
    shapes = shape_terms(z, density)
    others = np.stack([density, density * z, value])
    columns = np.concatenate([shapes * scale, others * scale, np.ones_like(z)[None]])
    columns = columns.reshape(len(columns), -1)
    weighted = columns * data.weight[good].reshape(-1)
    normal = (weighted @ columns.T).astype(float)
    right = (weighted @ fit.residual[good].reshape(-1)).astype(float)
    normal[np.diag_indices_from(normal)] *= 1 + 1e-6
    return np.asarray(np.linalg.solve(normal, right)[: len(shapes)])


def level_prior(shading: Shading, place: Array, sigma: Array, noise: float) -> Prior:
    """What the whole board tells about the levels and the blur of single edges.

    Parameters
    ----------
    shading : Shading
    place : (E, 2) array [px]
    sigma : (E,) array [px]
    noise : float [DN^2]
        Variance of a pixel.
    """
    mean, contrast = shading.at(place)
    low, high = 1 / (shading.spread + _LEAST_SPREAD * noise)
    precision = np.zeros((len(place), 3, 3))
    # Of A = (light + dark) / 2 and B = (light - dark) / 2, from those of dark and light.
    a, b = MEAN - MEAN, CONTRAST - MEAN
    precision[:, a, a] = precision[:, b, b] = high + low
    precision[:, a, b] = precision[:, b, a] = high - low
    precision[:, BLUR - MEAN, BLUR - MEAN] = 1 / (_BLUR_SPREAD * sigma) ** 2
    return Prior(np.stack([mean, contrast, sigma], axis=-1), precision)

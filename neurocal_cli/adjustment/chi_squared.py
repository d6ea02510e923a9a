"""Chi-squared statistics and critical values, without SciPy, which takes long to import."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array

_ROUNDING = 1e-15  # of the largest eigenvalue


def chi_squared(difference: Array, covariance: Array) -> float:
    """Squared Mahalanobis length d^T C^-1 d of a difference d (n,) with covariance C (n, n).

    Directions whose variance is zero or negative by rounding are left out; nan if an entry has no variance.
    """
    scale = np.sqrt(np.diagonal(covariance))
    if not (scale > 0).all():
        return float("nan")
    variance, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    known = variance > _ROUNDING * variance[-1]
    along = (difference / scale) @ directions[:, known]
    return float((along**2 / variance[known]).sum())


def exceeded_by_chance(freedom: float | Array, sigmas: float) -> Array:
    """Critical value of chi-squared over its degrees of freedom, in units of the mean, which is 1.

    `sigmas` is a one-sided normal level: 1.64 for one case in 20, 2.33 for one in 100. Wilson and Hilferty
    (1931): the cube root is nearly normal. With three or more degrees of freedom and levels down to one in
    10,000, the error is below 4 %.
    """
    part = 2.0 / (9.0 * np.asarray(freedom, dtype=float))
    return np.asarray((1.0 - part + sigmas * np.sqrt(part)) ** 3)

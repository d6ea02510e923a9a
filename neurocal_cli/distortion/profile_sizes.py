"""Uncertainty of a rich lens that comes from the unknown prior sizes of its radial profile.

Among the points, these determine the profile g. Farther out its prior dominates, whose sizes may be poorly
determined: if a polynomial fits the profile among the points, the most probable sizes are small, but larger
ones are not much less probable. So the covariance is averaged over the sizes. Let w_m be the posterior weight
of the m-th sizes, P_m and g_m the posterior covariance and mean of g for them, g the reported profile, and
T = dc/dg the response of all other unknowns c. Then

    E = sum_m w_m (P_m + (g_m - g) (g_m - g)^T),    cov(c, g) = cov(c, g | g) + [T; 1] E [T; 1]^T

is the result of Bayesian model averaging (Hoeting et al. 1999) around the reported parameters.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import solve_scaled


def averaged_over_sizes(
    covariance: Array, H: Array, right: Array, profile: slice, value: Array, priors: tuple[Array, Array]
) -> Array:
    """Covariance (f, f) of the shared parameters, averaged over the priors of the profile.

    `covariance` is that for one of the priors; H (f, f) and `right` (f,) are the precision, and the gradient
    at the reported values, without the profile's prior; `profile` are the places of the profile among the f
    parameters and `value` (n,) the reported one; `priors` are prior covariances (m, n, n) and the logarithms
    (m,) of their prior probabilities.
    """
    is_profile = np.zeros(len(H), dtype=bool)
    is_profile[profile] = True
    T = -solve_scaled(H[np.ix_(~is_profile, ~is_profile)], H[~is_profile, profile])
    told = H[profile, profile] + H[profile, ~is_profile] @ T
    information = right[profile] + T.T @ right[~is_profile] + told @ value
    follow = np.zeros((len(H), len(value)))
    follow[profile], follow[~is_profile] = np.eye(len(value)), T
    E = _second_moment(told, information, value, *priors)
    return np.asarray(covariance + follow @ (E - covariance[profile, profile]) @ follow.T)


def _second_moment(
    told: Array, information: Array, value: Array, covariances: Array, logarithm: Array
) -> Array:
    """E, from the profile's J^T J and J^T r at 0."""
    root = np.linalg.cholesky(covariances)
    turned = np.swapaxes(root, 1, 2)
    G = np.eye(len(told)) + turned @ told @ root
    P = root @ np.linalg.inv(G) @ turned
    mean = P @ information
    logarithm = logarithm + 0.5 * (mean @ information - np.linalg.slogdet(G)[1])
    weight = np.exp(logarithm - logarithm.max())
    away = mean - value
    second = P + away[:, :, None] * away[:, None, :]
    return np.asarray(np.tensordot(weight / weight.sum(), second, axes=1))

"""Cameras and target estimated again without each part of the views, from the quadratics of the parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.target_shape.information import Information, joined
from neurocal_cli.target_shape.posterior import minimum_of, prior_covariance
from neurocal_cli.target_shape.prior import Prior
from neurocal_cli.target_shape.without_poses import WithoutPoses


def without_each(
    parts: Sequence[Information], prior: Prior, sizes: Mapping[str, float], variance: float
) -> list[tuple[Array, Array]]:
    """Step (f,) of the cameras and offsets (n, 3) from all parts but one, for each part left out.

    Parameters
    ----------
    parts : sequence of Information
        Of different views of the same cameras, in the whole offsets along each point's axes.
    prior : Prior
    sizes : dict of float by name [world unit]
    variance : float [px^2]
        Of the noise.

    Raises
    ------
    numpy.linalg.LinAlgError
        Parts that do not determine the cameras.
    """
    if 3 * len(prior.axes) > sum(part.pose_right.size for part in parts):
        others = (joined([part for part in parts if part is not out]) for out in parts)
        return [minimum_of(some, prior, sizes, variance) for some in others]
    matrices = [WithoutPoses(part).matrix() for part in parts]
    f = len(parts[0].camera)
    precision = np.zeros_like(matrices[0][:-1, :-1])
    precision[f:, f:] = variance * np.linalg.inv(prior_covariance(prior, sizes))
    whole = sum(matrices)
    estimated = []
    for out in matrices:
        M = whole - out
        x = np.asarray(np.linalg.solve(M[:-1, :-1] + precision, M[:-1, -1]))
        estimated.append((x[:f], x[f:].reshape(-1, 3)))
    return estimated

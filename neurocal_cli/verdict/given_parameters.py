"""Test whether the points agree with intrinsic parameters that were given.

The poses absorb a wrong focal length or centre, so the error hardly grows: a board that appears too large is
moved away. Therefore the given parameters are estimated from the points and compared.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.bundle_adjustment.adjust import adjust
from neurocal_cli.bundle_adjustment.covariance import covariance
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.frozen_dataclass import frozen_dataclass

_NAMES = ("alpha_u", "alpha_v", "u0", "v0")
_PLACES = (0, 2, 3, 4)  # indices among A's entries
_THETA = 1  # a given theta stays fixed
_STEPS = 20
_WELL_POSED = 1e-7  # smallest eigenvalue of a normal matrix of unit diagonal


@frozen_dataclass
class Reestimated:
    """A given parameter and its estimate from the points.

    Attributes
    ----------
    name : str
    given, found, std : float [px]
    """

    name: str
    given: float
    found: float
    std: float


def reestimate_given(
    views: Views, state: CameraState, given: frozenset[str], free_poses: bool
) -> tuple[Reestimated, ...]:
    """Estimate the given focal lengths and the given centre from the points.

    Parameters
    ----------
    views : Views
    state : CameraState
        In normalised units, at its minimum.
    given : frozenset of str
        Names of the parameters that were not estimated.
    free_poses : bool

    Returns
    -------
    tuple of Reestimated
        Empty if none is given, or if the points do not determine them.
    """
    if given.isdisjoint(_NAMES):
        return ()
    free = np.arange(5 + state.k.shape[-1]) < 5
    free[_THETA] = "theta" not in given
    adjusted = adjust(views.batches, state, free, free_poses, _STEPS)
    cov = covariance(adjusted.normal, free, free_poses, views.n_equations)
    if not cov.smallest > _WELL_POSED:
        return ()
    std = np.zeros(5)
    std[free[:5]] = np.sqrt(np.diagonal(cov.entries))
    px, centre = views.pixel_scale, np.array([0, 0, 0, *views.pixel_centre])
    before, after = px * state.entries[0] + centre, px * adjusted.state.entries[0] + centre
    return tuple(
        Reestimated(name, float(before[k]), float(after[k]), float(px * std[k]))
        for name, k in zip(_NAMES, _PLACES, strict=True)
        if name in given and np.isfinite(std[k])
    )

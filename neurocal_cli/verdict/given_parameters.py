"""Test whether the points agree with intrinsic parameters that were given.

The poses absorb a wrong focal length or centre, so the error hardly grows: a board that appears too large is
moved away. Therefore the given parameters are estimated from the points and compared. Tangential distortion
and the shape of the target can absorb the rest of a wrong centre. So a given centre is also compared with
that of a simpler camera, without tangential distortion and with the target as given, if it explains the
points as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import adjust
from neurocal_cli.bundle_adjustment.covariance import covariance
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion import coefficient_names
from neurocal_cli.frozen_dataclass import frozen_dataclass

_NAMES = ("alpha_u", "alpha_v", "u0", "v0")
_PLACES = (0, 2, 3, 4)  # indices among A's entries
_THETA = 1  # a given theta stays fixed
_STEPS = 20
_TANGENTIAL = ("p1", "p2")
# Largest variance of the residuals of the simpler camera, over that of the calibration; repeated by
# tests/test_given_parameters.py.
AS_WELL = 1.05
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
    views: Views,
    state: CameraState,
    given: frozenset[str],
    free_poses: bool,
    free_k: NDArray[np.bool_] | None = None,
    variance: float = np.inf,
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
    free_k : (K,) bool array, optional
        Distortion coefficients that are estimated with them. Default: none.
    variance : float, optional
        Largest variance of the residuals, normalised, with which the points count as explained.

    Returns
    -------
    tuple of Reestimated
        Empty if none is given, or if the points do not determine them, or are not explained by them.
    """
    if given.isdisjoint(_NAMES):
        return ()
    n_k = state.k.shape[-1]
    free = np.concatenate([np.ones(5, dtype=bool), np.zeros(n_k, dtype=bool) if free_k is None else free_k])
    free[_THETA] = "theta" not in given
    adjusted = adjust(views.batches, state, free, free_poses, _STEPS)
    spare = views.n_equations - int(free.sum()) - (6 * views.n_views if free_poses else 0)
    cov = covariance(adjusted.normal, free, free_poses, views.n_equations)
    if not cov.smallest > _WELL_POSED or float(adjusted.cost.sum()) > variance * spare:
        return ()
    std = np.zeros(5)
    std[free[:5]] = np.sqrt(np.diagonal(cov.entries))[: int(free[:5].sum())]
    px, centre = views.pixel_scale, np.array([0, 0, 0, *views.pixel_centre])
    before, after = px * state.entries[0] + centre, px * adjusted.state.entries[0] + centre
    return tuple(
        Reestimated(name, float(before[k]), float(after[k]), float(px * std[k]))
        for name, k in zip(_NAMES, _PLACES, strict=True)
        if name in given and np.isfinite(std[k])
    )


def reestimate_centre(
    views: Views,
    state: CameraState,
    given: frozenset[str],
    free_poses: bool,
    variance: float,
) -> tuple[Reestimated, ...]:
    """Estimate a given centre without tangential distortion, on the target as given.

    Parameters
    ----------
    views : Views
        With the points as given.
    state : CameraState
        In normalised units.
    given, free_poses
        As for `reestimate_given`.
    variance : float
        Of the residuals of the calibration, normalised.

    Returns
    -------
    tuple of Reestimated
        Empty if the centre is estimated, or if this simpler camera explains the points less well.
    """
    if not {"u0", "v0"} <= given:
        return ()
    names = coefficient_names(state.model)
    tangential = np.array([name in _TANGENTIAL for name in names], dtype=bool)
    free_k = np.array([name not in given for name in names], dtype=bool) & ~tangential
    simpler = replace(state, k=np.where(tangential, 0.0, state.k))
    return reestimate_given(views, simpler, given, free_poses, free_k, AS_WELL * variance)

"""Whether bends of a board predict points of views that the camera was not found from.

Of each view that is left out, every second point tells the pose and, from what the size of the bends is, the
bend; the other points are predicted. With bends they must be predicted better than without. And no view may
be bent far more than the others, because one odd view is no board that bends; nor all views in the same way.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import solve_scaled
from neurocal_cli.target_shape.information import Information, Sight, of_views, without_points
from neurocal_cli.target_shape.posterior import camera_step_of

_FOLDS = 5
_FAR = 6.0  # times the rms of the other views
_COMMON = 30.0  # times the mean square of what differs: one set in 200 of views that are bent at random


def bends_hold(sight: Sight, bends: Array, precision: float) -> bool:
    """See whether bends explain views that are left out, and all views alike.

    Parameters
    ----------
    sight : Sight
        At the minimum for these bends.
    bends : (V, 3) array [world unit]
    precision : float
        Of the bends a priori, in units of the noise's.
    """
    if not _alike(bends):
        return False
    views = sight.views.index
    rank = np.arange(len(views)) - sight.views.first[views]
    ratio = 0.0  # its logarithm, because a fold that needs a camera of few views would outweigh the others
    n_folds = min(sight.views.n_views, _FOLDS)
    halves = [without_points(sight.of_points(rank % 2 == half)) for half in (0, 1)]
    whole = halves[0] + halves[1]
    for fold in range(n_folds):
        out = np.arange(sight.views.n_views) % n_folds == fold
        rest, own = of_views(sight, whole, ~out), [of_views(sight, half, out) for half in halves]
        ratio += np.log(_lost(rest, own, precision) / _lost(rest, own, None))
    return bool(ratio < 0)


def _alike(bends: Array) -> bool:
    """Whether no view is bent far more than the others, and not all in the same way."""
    V, mean = len(bends), bends.mean(axis=0)
    squares = (bends**2).sum(axis=1)
    of_others = (squares.sum() - squares) / (V - 1)
    spread = ((bends - mean) ** 2).sum() / (V - 1)
    return bool((squares <= _FAR**2 * of_others).all() and V * (mean**2).sum() <= _COMMON * spread)


def _lost(others: Information, halves: list[Information], precision: float | None) -> float:
    """Squared error of each half of the points, its poses and bends being those of the other half."""
    if precision is None:
        others, halves = others.straight(), [half.straight() for half in halves]
        held = others, *halves
    else:
        held = tuple(info.held(precision) for info in (others, *halves))
    camera = camera_step_of(held[0])
    return sum(_error(halves[1 - k], camera, _own(held[1 + k], camera)) for k in (0, 1))


def _own(info: Information, camera: Array) -> Array:
    """(P, p) steps of the poses and their bends for the cameras' steps."""
    right = info.pose_right - info.pose_camera @ camera
    return np.asarray(solve_scaled(info.pose, right[..., None])[..., 0])


def _error(info: Information, camera: Array, own: Array) -> float:
    """Squared error after these steps."""
    by_own = info.pose_camera @ camera + 0.5 * (info.pose @ own[..., None])[..., 0] - info.pose_right
    by_camera = 0.5 * info.camera @ camera - info.camera_right
    return float(info.cost + 2 * (camera @ by_camera + (own * by_own).sum()))

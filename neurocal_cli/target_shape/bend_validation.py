"""Cross-validation of bends: they must predict points of views from which the camera was not estimated.

In each held-out view, half of the points determine the pose and, with the size of the bends as its prior, the
bend; the other half is predicted. The prediction must be better with bends than without. In addition, no view
may bend far more than the others, because a single odd view is no bending board, and the bends must not be
common to all views.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import solve_scaled
from neurocal_cli.target_shape.information import Information, Sight, of_views, without_points
from neurocal_cli.target_shape.posterior import camera_step_of

_FOLDS = 5
_FAR = 6.0  # largest bend of a view over the rms of the other views
_COMMON = 30.0  # largest common part over the mean square of the rest: exceeded in one random set of 200


def bends_are_valid(sight: Sight, bends: Array, precision: float) -> bool:
    """Whether the bends are consistent over the views and improve the prediction of held-out views.

    Parameters
    ----------
    sight : Sight
        At the minimum for these bends.
    bends : (V, 3) array [world unit]
    precision : float
        Prior precision of the bends, in units of the noise precision.
    """
    if not _consistent(bends):
        return False
    views = sight.views.index
    rank = np.arange(len(views)) - sight.views.first[views]
    ratio = 0.0  # log ratio, so that a fold whose camera comes from few views does not outweigh the others
    n_folds = min(sight.views.n_views, _FOLDS)
    halves = [without_points(sight.of_points(rank % 2 == half)) for half in (0, 1)]
    whole = halves[0] + halves[1]
    for fold in range(n_folds):
        out = np.arange(sight.views.n_views) % n_folds == fold
        rest, own = of_views(sight, whole, ~out), [of_views(sight, half, out) for half in halves]
        ratio += np.log(_lost(rest, own, precision) / _lost(rest, own, None))
    return bool(ratio < 0)


def _consistent(bends: Array) -> bool:
    """Whether no view is bent far more than the others, and the bends are not common to all views."""
    V, mean = len(bends), bends.mean(axis=0)
    squares = (bends**2).sum(axis=1)
    of_others = (squares.sum() - squares) / (V - 1)
    spread = ((bends - mean) ** 2).sum() / (V - 1)
    return bool((squares <= _FAR**2 * of_others).all() and V * (mean**2).sum() <= _COMMON * spread)


def _lost(others: Information, halves: list[Information], precision: float | None) -> float:
    """Squared error of both halves of the points, each predicted with poses and bends of the other half."""
    if precision is None:
        others, halves = others.straight(), [half.straight() for half in halves]
        held = others, *halves
    else:
        held = tuple(info.held(precision) for info in (others, *halves))
    camera = camera_step_of(held[0])
    return sum(_error(halves[1 - k], camera, _own(held[1 + k], camera)) for k in (0, 1))


def _own(info: Information, camera: Array) -> Array:
    """(P, p) steps of the poses and bends, given the step of the cameras."""
    right = info.pose_right - info.pose_camera @ camera
    return np.asarray(solve_scaled(info.pose, right[..., None])[..., 0])


def _error(info: Information, camera: Array, own: Array) -> float:
    """Squared error after these steps."""
    by_own = info.pose_camera @ camera + 0.5 * (info.pose @ own[..., None])[..., 0] - info.pose_right
    by_camera = 0.5 * info.camera @ camera - info.camera_right
    return float(info.cost + 2 * (camera @ by_camera + (own * by_own).sum()))

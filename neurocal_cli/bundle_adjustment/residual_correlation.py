"""Whether residuals are noise: neighbours in an image know nothing of each other.

A distortion model that is too simple, a board that is not flat, points that are not where they are said to
be: all leave residuals that are alike in neighbouring points. Noise does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.measured_directions import measured_part, single, unit
from neurocal_cli.bundle_adjustment.reprojection import CameraState, residuals
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.geometry import Array

_SOME_SAY = 0.5  # from which on what points say along their edges counts


def correlation(views: Views, errors: Array) -> float:
    """Correlation of the residuals of points that are neighbours in their view.

    Parameters
    ----------
    views : Views
    errors : (N, 2) array
        Residual of each point, in the order of `views`; what was not measured of it does not count.

    Returns
    -------
    float
        0 for noise, to 1 / sqrt(N); 1 for residuals that vary slowly over the image.
    """
    group, n_groups = views.index, views.n_views
    across = views.across if views.along < _SOME_SAY else None
    if across is not None:
        # Mid-points of edges one way tell nothing of what those of edges the other way say.
        group, n_groups = 2 * group + _other_way(views, across), 2 * n_groups
    # Strips of each view as high as neighbours are apart; along a strip they follow each other.
    low = np.minimum.reduceat(views.pixels, views.first)
    extent = np.maximum.reduceat(views.pixels, views.first) - low
    strips = np.maximum(np.sqrt(np.bincount(group, minlength=n_groups)), 1.0)[group]
    height = np.maximum(extent[:, 1], 1e-300)[views.index] / strips
    strip = np.floor((views.pixels[:, 1] - low[views.index, 1]) / height)
    order = np.lexsort((views.pixels[:, 0], strip, group))
    one, two = order[:-1], order[1:]
    same = (group[one] == group[two]) & (strip[one] == strip[two])
    one, two = one[same], two[same]
    errors = measured_part(errors, across)
    shared = [
        measured_part(errors[k], None if across is None else across[n]) for k, n in ((one, two), (two, one))
    ]
    power = (shared[0] ** 2).sum() + (shared[1] ** 2).sum()
    return float(2 * (errors[one] * errors[two]).sum() / power) if power > 0 else 0.0


def _other_way(views: Views, across: Array) -> NDArray[np.int64]:
    """0 or 1 for each point: the side of its edge among the two ways that a view's edges run."""
    nu, nv = unit(across).T
    # Four times the angle is the same for both ways, so its mean tells how the edges lie.
    angle = 4 * np.arctan2(nv, nu)
    c, s = (np.add.reduceat(f(angle) * single(across), views.first) for f in (np.cos, np.sin))
    lie = (np.arctan2(s, c) / 4)[views.index]
    return np.asarray(np.abs(nu * np.cos(lie) + nv * np.sin(lie)) > np.sqrt(0.5), dtype=np.int64)


def effective_number(n: float, rho: float) -> float:
    """How many independent points n correlated ones are worth, in the plane."""
    rho = min(max(rho, 0.0), 0.99)
    return max(n * ((1 - rho) / (1 + rho)) ** 2, 1.0)


def point_residuals(views: Views, state: CameraState) -> Array:
    """Residuals in normalised pixels in the order of the points; (N, 2)."""
    batches = views.batches
    errors = np.swapaxes(residuals(batches, state), 1, 2).reshape(-1, 2)
    rank = np.arange(len(views.index)) - np.repeat(views.first, views.counts)
    return errors[np.repeat(batches.first * batches.local.shape[2], views.counts) + rank]

"""Spatial correlation of residuals, which tells model errors from noise.

A distortion model that is too simple, a board that is not flat or wrong world coordinates leave similar
residuals in neighbouring points. Noise is uncorrelated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.reprojection import residuals
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.observations.measured_directions import measured_part, single, unit

_SOME_SAY = 0.5  # least weight along edges with which residuals in that direction are used


def correlation(views: Views, errors: Array) -> float:
    """Correlation of the residuals of points that are neighbours in their view.

    It is 0 for noise, to 1 / sqrt(N), and 1 for residuals that vary slowly over the image. `errors` (N, 2)
    are the points' residuals in the order of `views`; directions that were not measured are ignored.
    """
    group, n_groups = views.index, views.n_views
    across = views.across if views.along < _SOME_SAY else None
    if across is not None:
        # Edges of the two orientations measure different directions, so each point is paired within its own.
        group, n_groups = 2 * group + _other_way(views, across), 2 * n_groups
    # Cut each view into strips as high as the spacing of its points; neighbours follow each other in a strip.
    low = np.minimum.reduceat(views.pixels, views.first)
    extent = np.maximum.reduceat(views.pixels, views.first) - low
    strips = np.maximum(np.sqrt(np.bincount(group, minlength=n_groups)), 1.0)[group]
    along, down = ((views.pixels - low[views.index]) / np.maximum(extent, 1e-300)[views.index]).T
    strip = np.floor(down * strips)
    # One number sorts by group, strip and u: three sorts take three times as long.
    order = np.argsort(2 * (group * (strips.max() + 2) + strip) + along, kind="stable")
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
    """0 or 1 for each point: the orientation of its edge, one of the two in which a view's edges run."""
    nu, nv = unit(across).T
    # Four times the angle is the same for both orientations, so its circular mean gives the view's axes.
    angle = 4 * np.arctan2(nv, nu)
    c, s = (np.add.reduceat(f(angle) * single(across), views.first) for f in (np.cos, np.sin))
    lie = (np.arctan2(s, c) / 4)[views.index]
    return np.asarray(np.abs(nu * np.cos(lie) + nv * np.sin(lie)) > np.sqrt(0.5), dtype=np.int64)


def effective_number(n: float, rho: float, side: float = np.inf) -> float:
    """Effective number of independent points among n correlated ones in the plane.

    `side` is the number of points along the sides of independent areas, as views are: however strong the
    correlation, it ends there.
    """
    rho = min(max(rho, 0.0), 0.99)
    mean = (1 + rho) / (1 - rho)  # variance of the mean of a row, times its points
    if np.isfinite(side):
        mean -= 2 * rho * (1 - rho**side) / (side * (1 - rho) ** 2)
    return max(n / mean**2, 1.0)


def independent_residuals(views: Views, state: CameraState, side: float = np.inf) -> float:
    """How many residuals of a camera are independent, by the correlation of neighbours."""
    return effective_number(views.n_equations, correlation(views, point_residuals(views, state)), side)


def point_residuals(views: Views, state: CameraState) -> Array:
    """Residuals in normalised pixels in the order of the points; (N, 2)."""
    batches = views.batches
    errors = np.swapaxes(residuals(batches, state), 1, 2).reshape(-1, 2)
    if len(errors) == len(views.index):  # no batch is padded
        return errors
    return errors[np.repeat(batches.first * batches.local.shape[2], views.counts) + views.rank]

"""Whether residuals are noise: neighbours in an image know nothing of each other.

A lens model that is too simple, a board that is not flat, points that are not where they are said to
be: all leave residuals that are alike in neighbouring points. Noise does not.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.pixel_error import CameraState, residuals
from neurocal_cli.adjustment.views import Views
from neurocal_cli.geometry import Array

__all__ = ["correlation", "effective_number", "of_points"]


def correlation(views: Views, errors: Array) -> float:
    """Correlation of the residuals of points that are neighbours in their view.

    Parameters
    ----------
    views : Views
    errors : (N, 2) array
        Residual of each point, in the order of `views`.

    Returns
    -------
    float
        0 for noise, to 1 / sqrt(N); 1 for residuals that vary slowly over the image.
    """
    # Strips of each view as high as neighbours are apart; along a strip they follow each other.
    low = np.minimum.reduceat(views.pixels, views.first)
    extent = np.maximum.reduceat(views.pixels, views.first) - low
    strips = np.maximum(np.sqrt(views.counts), 1.0)
    height = np.maximum(extent[:, 1], 1e-300) / strips
    strip = np.floor((views.pixels[:, 1] - low[views.index, 1]) / height[views.index])
    order = np.lexsort((views.pixels[:, 0], strip, views.index))
    one, two = order[:-1], order[1:]
    same = (views.index[one] == views.index[two]) & (strip[one] == strip[two])
    one, two = one[same], two[same]
    power = (errors[one] ** 2).sum() + (errors[two] ** 2).sum()
    return float(2 * (errors[one] * errors[two]).sum() / power) if power > 0 else 0.0


def effective_number(n: int, rho: float) -> float:
    """How many independent points n correlated ones are worth, in the plane."""
    rho = min(max(rho, 0.0), 0.99)
    return max(n * ((1 - rho) / (1 + rho)) ** 2, 1.0)


def of_points(views: Views, state: CameraState) -> Array:
    """Residuals in normalised pixels in the order of the points; (N, 2)."""
    tiles = views.tiles
    errors = np.swapaxes(residuals(tiles, state), 1, 2).reshape(-1, 2)
    rank = np.arange(len(views.index)) - np.repeat(views.first, views.counts)
    return errors[np.repeat(tiles.first * tiles.local.shape[2], views.counts) + rank]

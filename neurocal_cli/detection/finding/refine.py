"""Saddle points of the brightness to a fraction of a pixel, by Newton's method on smoothed derivatives."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from neurocal_cli.detection.finding.levels import Image
from neurocal_cli.geometry import Array

__all__ = ["settle"]

_LONGEST_STEP = 1.5  # px


@lru_cache(maxsize=32)
def _derivatives(sigma: float) -> tuple[int, Array]:
    """Half width of a window, and the weights of its pixels for u, v, uu, uv, vv; (pixels, 5)."""
    half = int(np.ceil(2.5 * sigma))
    d = np.arange(-half, half + 1.0)
    g = np.exp(-0.5 * (d / sigma) ** 2)
    g /= g.sum()
    first = d * g
    first /= (first * d).sum()
    second = (d**2 - (d**2 * g).sum()) * g
    second *= 2 / (second * d**2).sum()
    kernels = [np.outer(g, first), np.outer(first, g), np.outer(g, second), np.outer(first, first)]
    kernels.append(np.outer(second, g))
    return half, np.stack([k.ravel() for k in kernels], axis=-1).astype(np.float32)


def settle(image: Image, start: Array, sigma: float, rounds: int = 3) -> Array:
    """Move points to the saddle points next to them.

    Parameters
    ----------
    image : (height, width) float32 array
    start : (N, 2) array [px]
    sigma : float [px]
        Smoothing of the derivatives: about a sixth of the squares' width.
    rounds : int
        Newton steps.

    Returns
    -------
    points : (N, 2) array [px]
        nan where there is no saddle point or the window leaves the image.
    """
    half, kernels = _derivatives(sigma)
    height, width = image.shape
    if min(height, width) < 2 * half + 1:
        return np.full(start.shape, np.nan)
    offset = np.arange(-half, half + 1)
    window = (offset[:, None] * width + offset).ravel()
    low, high = np.full((2, 1), half), np.array([[width], [height]]) - 1 - half
    # Both coordinates in rows: sums over many short rows take longer.
    flat, given = image.ravel(), start.T
    point = np.nan_to_num(given)
    good = np.ones(len(start), dtype=bool)
    for _ in range(rounds):
        centre = np.minimum(np.maximum(np.rint(point), low), high)
        place = (centre[1] * width + centre[0]).astype(np.intp)
        u, v, uu, uv, vv = (flat[place[:, None] + window] @ kernels).T.astype(float)
        determinant = uu * vv - uv * uv
        good = determinant < 0
        step = np.stack([uv * v - vv * u, uv * u - uu * v])
        step /= np.where(good, determinant, -1.0)
        length = np.maximum(np.hypot(step[0], step[1]), 1e-12)
        step *= np.minimum(1.0, _LONGEST_STEP / length)
        point = centre + step
    close, framed = np.abs(point - centre) < 1, (given >= low) & (given <= high)
    good &= close[0] & close[1] & framed[0] & framed[1]
    return np.where(good, point, np.nan).T

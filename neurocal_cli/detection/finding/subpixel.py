"""Refine saddle points to sub-pixel accuracy by Newton's method on smoothed derivatives."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.finding.levels import Image

_LONGEST_STEP = 1.5  # px; insensitive, tests/test_finding.py


@lru_cache(maxsize=32)
def _derivatives(sigma: float) -> tuple[int, Array]:
    """Half width of the window, and weights (pixels, 5) for the derivatives u, v, uu, uv, vv."""
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


@lru_cache(maxsize=64)
def window(half: int, width: int) -> NDArray[np.intp]:
    """Flat index offsets from a pixel to the window around it, in an image of a width."""
    offset = np.arange(-half, half + 1)
    return (offset[:, None] * width + offset).ravel()


def refine_saddles(image: Image, start: Array, sigma: float, rounds: int = 3) -> Array:
    """Move points (N, 2), about a pixel from saddle points [px], to these by some rounds of Newton steps.

    Derivatives are smoothed by `sigma` [px], about a sixth of the squares' width. A point becomes NaN if
    there is no saddle point or the window leaves the image.
    """
    half, _ = _derivatives(sigma)
    height, width = image.shape
    if min(height, width) < 2 * half + 1:
        return np.full(start.shape, np.nan)
    # Coordinates are kept in rows, because sums over many short rows are slower.
    given = start.T
    low, high = half, np.array([[width - 1 - half], [height - 1 - half]])
    padded = (given >= low) & (given <= high)
    good = padded[0] & padded[1]
    centre = np.rint(np.where(good, given, low))
    step, saddle = _newton(image, centre, sigma)
    # Derivatives are taken at the nearest pixel, so only points that moved to another pixel continue.
    for _ in range(rounds - 1):
        ahead = np.minimum(np.maximum(np.rint(centre + step), low), high)
        moved = np.flatnonzero((ahead[0] != centre[0]) | (ahead[1] != centre[1]))
        if not len(moved):
            break
        centre[:, moved] = ahead[:, moved]
        step[:, moved], saddle[moved] = _newton(image, ahead[:, moved], sigma)
    close = np.abs(step) < 1
    good &= saddle & close[0] & close[1]
    return np.where(good, centre + step, np.nan).T


def _newton(image: Image, centre: Array, sigma: float) -> tuple[Array, NDArray[np.bool_]]:
    """Newton steps (2, N) from pixels (2, N) to a zero of the gradient, and whether each is a saddle."""
    width = image.shape[1]
    half, kernels = _derivatives(sigma)
    place = (centre[1] * width + centre[0]).astype(np.intp)
    u, v, uu, uv, vv = (image.ravel().take(place[:, None] + window(half, width)) @ kernels).T.astype(float)
    determinant = uu * vv - uv * uv
    saddle = determinant < 0
    step = np.empty(centre.shape)
    np.subtract(uv * v, vv * u, out=step[0])
    np.subtract(uv * u, uu * v, out=step[1])
    step /= np.where(saddle, determinant, -1.0)
    length = np.hypot(step[0], step[1])
    if length.max(initial=0.0) > _LONGEST_STEP:
        step *= np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-12))
    return step, saddle

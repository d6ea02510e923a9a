"""Pixels around the outlines that a map of the board gives its circles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import FitPixels
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.fitting.strips import Single, packed
from neurocal_cli.detection.local_inverse import LocalInverse

_REACH = 4.0  # sigma on both sides of the outline
_ROUGHLY = 1.5  # of that, for a first selection
_ROOM = 0.5  # of the distance to the next circle; farther pixels may show it
_ANGLES = np.linspace(0, 2 * np.pi, 24, endpoint=False)
_RADII = (0.6, 0.8, 1.0, 1.2, 1.4)  # of samples of the map around a circle, over its radius


@frozen_dataclass(eq=False)
class CirclePixels(FitPixels):
    """Pixels around outlines, (N, M) float32 arrays."""

    d: Single  # [px] distance from the outline, positive outside
    u: Single  # normal of the outline
    v: Single
    bend: Single  # [1/px] half of its curvature


def outline_pixels(
    image: NDArray[np.float32],
    at: SmoothMap,
    places: Array,
    radius: float,
    blur: float,
    apart: float,
    shading: Shading | None,
) -> CirclePixels:
    """Gather the pixels around the outlines of circles at places (N, 2), padded to the same number.

    `radius` and the distance `apart` of two circles are in the unit of the places, `blur` in px.
    """
    ring = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
    samples = np.concatenate([[[0.0, 0.0]], *(share * radius * ring for share in _RADII)])
    seen, reach = at.at(places[:, None] + samples), _REACH * blur
    middle = seen[:, 0]
    outline = seen[:, 1 + 2 * len(_ANGLES) : 1 + 3 * len(_ANGLES)]
    point, d, normal, bend, rho, band = _distances(seen, samples, radius, _around(outline, reach), reach)
    band &= (np.abs(d) < reach) & (rho < _ROOM * apart)
    framed = band & (point >= 0).all(axis=2) & (point < image.shape[::-1]).all(axis=2)
    beyond = 1 - framed.sum(axis=1) / np.maximum(band.sum(axis=1), 1)
    index, used = packed(framed, framed.sum(axis=1))
    u, v, d, n_u, n_v, bend = (
        x.reshape(-1)[index] for x in (*np.moveaxis(point, 2, 0), d, *np.moveaxis(normal, 2, 0), bend)
    )
    value: Single = image[np.where(used, v, 0).astype(int), np.where(used, u, 0).astype(int)]
    gain: Single = np.ones_like(value)
    if shading is not None:
        off = ((u - middle[:, :1]).astype(np.float32), (v - middle[:, 1:]).astype(np.float32))
        value, gain = shading.off(middle, *off, value)
    columns: list[Single] = [np.where(used, x, 0).astype(np.float32) for x in (d, n_u, n_v, bend)]
    return CirclePixels(value, gain, np.ones_like(value), used.astype(np.float32), beyond, *columns)


def _around(outline: Array, reach: float) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, M, 2) of a window for each outline (N, K, 2), and a mask of those near its box."""
    low, high = np.floor(outline.min(axis=1) - reach), np.ceil(outline.max(axis=1) + reach) + 1
    width, height = (high - low).max(axis=0).astype(int)
    away = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    return low[:, None] + away, (away < (high - low)[:, None]).all(axis=2)


def _distances(
    seen: Array,
    samples: Array,
    radius: float,
    window: tuple[Array, NDArray[np.bool_]],
    reach: float,
) -> tuple[Array, Array, Array, Array, Array, NDArray[np.bool_]]:
    """Pixels near outlines: themselves, distance, normal, half curvature, radius on the board, and a mask.

    The map's inverse is a polynomial through its samples around the circle. All arrays are padded to the same
    number of pixels, which the mask tells from the padding.
    """
    inverse = LocalInverse.of(seen, samples)

    def nearer(foot: Array, point: Array) -> tuple[Array, Array, Array]:
        """Distance from the outline, normal at a foot near it, and the radius there."""
        a, b = inverse.at(foot)
        au, av, bu, bv = inverse.slopes(foot)
        rho = np.maximum(np.hypot(a, b), 1e-9)
        slope = np.stack([a * au + b * bu, a * av + b * bv], axis=-1) / rho[..., None]
        steep = np.maximum(np.hypot(slope[..., 0], slope[..., 1]), 1e-9)
        n = slope / steep[..., None]
        return ((point - foot) * n).sum(axis=2) + (rho - radius) / steep, n, rho

    point, inside = window
    d, n, rho = nearer(point, point)
    near = inside & (np.abs(d) < _ROUGHLY * reach)
    index, used = packed(near, near.sum(axis=1))
    d, rho = (x.reshape(-1)[index] for x in (d, rho))
    n, point = (x.reshape(-1, 2)[index] for x in (n, point))
    foot = point
    for _ in range(2):
        foot = point - d[..., None] * n
        d, n, _ = nearer(foot, point)
    # Curvature of an ellipse with the shape of the map at the centre: M maps pixels to the board.
    M = np.stack(inverse.slopes(seen[:, :1]), axis=-1).reshape(-1, 2, 2)
    G = M.swapaxes(1, 2) @ M / radius**2
    gradient = (foot - seen[:, :1]) @ G
    length = np.maximum(np.hypot(gradient[..., 0], gradient[..., 1]), 1e-12)
    tangent = np.stack([-gradient[..., 1], gradient[..., 0]], axis=-1) / length[..., None]
    curvature = ((tangent @ G) * tangent).sum(axis=2) / length
    return point, d, n, 0.5 * np.clip(curvature, 0, 2), rho, used

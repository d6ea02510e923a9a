"""Pixels around the outlines that a map of the board gives its circles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.detection.fitting.batched_newton import FitPixels
from neurocal_cli.detection.fitting.shading import Shading
from neurocal_cli.detection.fitting.smooth_map import SmoothMap
from neurocal_cli.detection.fitting.strips import Single
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
    seen = at.at(places[:, None] + samples)
    middle = seen[:, 0]
    height, width = image.shape
    parts: list[tuple[Array, ...]] = []
    for k in range(len(places)):
        outline = seen[k, 1 + 2 * len(_ANGLES) : 1 + 3 * len(_ANGLES)]
        low = np.floor(outline.min(axis=0) - _REACH * blur).astype(int)
        high = np.ceil(outline.max(axis=0) + _REACH * blur).astype(int) + 1
        v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].reshape(2, -1)
        u, v, d, n_u, n_v, bend, rho = _distances(seen[k], samples, radius, u, v, _REACH * blur)
        band = (np.abs(d) < _REACH * blur) & (rho < _ROOM * apart)
        used = band & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        share = float(used.sum()) / max(float(band.sum()), 1.0)
        beyond = np.array([1 - share])
        parts.append((u[used], v[used], d[used], n_u[used], n_v[used], bend[used], beyond))
    most = max(1, *[len(part[0]) for part in parts])

    def padded(column: int) -> Array:
        rows = np.zeros((len(parts), most))
        for row, part in zip(rows, parts, strict=True):
            row[: len(part[column])] = part[column]
        return rows

    count = np.array([len(part[0]) for part in parts])
    root = (np.arange(most) < count[:, None]).astype(np.float32)
    u, v = padded(0).astype(int), padded(1).astype(int)
    value: Single = image[v, u]
    gain: Single = np.ones_like(value)
    if shading is not None:
        off = ((u - middle[:, :1]).astype(np.float32), (v - middle[:, 1:]).astype(np.float32))
        value, gain = shading.off(middle, *off, value)
    beyond = np.concatenate([part[6] for part in parts])
    columns: list[Single] = [padded(column).astype(np.float32) for column in (2, 3, 4, 5)]
    return CirclePixels(value, gain, np.ones_like(value), root, beyond, *columns)


def _distances(
    seen: Array,
    samples: Array,
    radius: float,
    u: NDArray[np.signedinteger],
    v: NDArray[np.signedinteger],
    reach: float,
) -> tuple[Array, ...]:
    """Pixels within reach of an outline: u, v, distance, normal (u, v), half curvature, radius on the board.

    The map's inverse is a polynomial through its samples around the circle.
    """
    inverse = LocalInverse.of(seen[None], samples)
    point = np.stack([u, v], axis=-1).astype(float)

    def nearer(foot: Array, point: Array) -> tuple[Array, Array, Array]:
        """Distance from the outline, normal at a foot near it, and the radius there."""
        a, b = (one[0] for one in inverse.at(foot[None]))
        au, av, bu, bv = (one[0] for one in inverse.slopes(foot[None]))
        rho = np.maximum(np.hypot(a, b), 1e-9)
        slope = np.stack([a * au + b * bu, a * av + b * bv], axis=-1) / rho[:, None]
        steep = np.maximum(np.hypot(*slope.T), 1e-9)
        n = slope / steep[:, None]
        return ((point - foot) * n).sum(axis=1) + (rho - radius) / steep, n, rho

    d, n, rho = nearer(point, point)
    near = np.abs(d) < _ROUGHLY * reach
    d, n, rho, point = d[near], n[near], rho[near], point[near]
    foot = point
    for _ in range(2):
        foot = point - d[:, None] * n
        d, n, _ = nearer(foot, point)
    # Curvature of an ellipse with the shape of the map at the centre: M maps pixels to the board.
    au, av, bu, bv = (float(one[0, 0]) for one in inverse.slopes(seen[None, :1]))
    M = np.array([[au, av], [bu, bv]])
    G = M.T @ M / radius**2
    q = foot - seen[0]
    gradient = q @ G
    length = np.maximum(np.hypot(*gradient.T), 1e-12)
    tangent = np.stack([-gradient[:, 1], gradient[:, 0]], axis=-1) / length[:, None]
    curvature = np.einsum("ni,ij,nj->n", tangent, G, tangent) / length
    return (
        u[near].astype(float),
        v[near].astype(float),
        d,
        n[:, 0],
        n[:, 1],
        0.5 * np.clip(curvature, 0, 2),
        rho,
    )

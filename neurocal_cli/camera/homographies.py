"""Homographies from planes to images, of many sets of points at once."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array


def homographies(ground: Array, pixels: Array, weight: Array | None = None) -> Array:
    """Homographies (M, 3, 3) by linear least squares through K points each, (M, K, 2) to (M, K, 2)."""
    centre, middle = ground.mean(axis=1, keepdims=True), pixels.mean(axis=1, keepdims=True)
    size, scale = (np.maximum(np.abs(x).max(axis=(1, 2)), 1e-9) for x in (ground - centre, pixels - middle))
    (x, y), (u, v) = (
        np.moveaxis(moved / by[:, None, None], 2, 0)
        for moved, by in ((ground - centre, size), (pixels - middle, scale))
    )
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = [[x, y, one, zero, zero, zero, -u * x, -u * y], [zero, zero, zero, x, y, one, -v * x, -v * y]]
    A = np.concatenate([np.stack(row, axis=-1) for row in rows], axis=1)
    b = np.concatenate([u, v], axis=1)
    if weight is not None:
        double = np.concatenate([weight, weight], axis=1)
        A, b = A * double[..., None], b * double
    normal = A.swapaxes(1, 2) @ A + 1e-12 * np.eye(8)
    h = np.linalg.solve(normal, (A.swapaxes(1, 2) @ b[..., None]))[..., 0]
    H = np.concatenate([h, np.ones((len(h), 1))], axis=1).reshape(-1, 3, 3)
    to, back = np.zeros_like(H), np.zeros_like(H)
    to[:, [0, 1], [0, 1]], to[:, 2, 2] = 1 / size[:, None], 1
    to[:, :2, 2] = -centre[:, 0] / size[:, None]
    back[:, [0, 1], [0, 1]], back[:, 2, 2] = scale[:, None], 1
    back[:, :2, 2] = middle[:, 0]
    return np.asarray(back @ H @ to)


def homography_at(H: Array, ground: Array) -> Array:
    """Pixels of places by homographies; (M, 3, 3) and (M, K, 2)."""
    mapped = ground @ H[:, :, :2].swapaxes(1, 2) + H[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped[..., :2] / mapped[..., 2:])

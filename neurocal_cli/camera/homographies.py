"""Homographies from planes to images, of many sets of points at once."""

from __future__ import annotations

import numpy as np

from neurocal_cli.camera.geometry import Array


def homographies(ground: Array, pixels: Array, weight: Array | None = None) -> Array:
    """Homographies (M, 3, 3) by linear least squares through K points each, (M, K, 2) to (M, K, 2).

    The places may be the same for all, (1, K, 2).
    """
    centre, middle = ground.mean(axis=1, keepdims=True), pixels.mean(axis=1, keepdims=True)
    size, scale = (np.maximum(np.abs(x).max(axis=(1, 2)), 1e-9) for x in (ground - centre, pixels - middle))
    places, seen = (
        moved.swapaxes(1, 2) / by[:, None, None]
        for moved, by in ((ground - centre, size), (pixels - middle, scale))
    )
    # The last row is that of the right side; of the others, two are those of the products with both.
    A = np.zeros((len(seen), 9, *seen.shape[1:]))
    A[:, :2, 0] = A[:, 3:5, 1] = places
    A[:, 2, 0] = A[:, 5, 1] = 1.0
    A[:, 6:8], A[:, 8] = -places[:, :, None] * seen[:, None], seen
    if weight is not None:
        A *= weight[:, None, None]
    A = A.reshape(len(A), 9, 2 * seen.shape[2])
    products = A @ A.swapaxes(1, 2)
    h = np.linalg.solve(products[:, :8, :8] + 1e-12 * np.eye(8), products[:, :8, 8:])[..., 0]
    H = np.concatenate([h, np.ones((len(h), 1))], axis=1).reshape(-1, 3, 3)
    to, back = np.zeros_like(H), np.zeros_like(H)
    to[:, [0, 1], [0, 1]], to[:, 2, 2] = 1 / size[:, None], 1
    to[:, :2, 2] = -centre[:, 0] / size[:, None]
    back[:, [0, 1], [0, 1]], back[:, 2, 2] = scale[:, None], 1
    back[:, :2, 2] = middle[:, 0]
    return np.asarray(back @ H @ to)


def homography_at(H: Array, ground: Array) -> Array:
    """Pixels of places by homographies; (M, 3, 3) and (M, K, 2), or (1, K, 2) of the same for all."""
    mapped = H[:, :, :2] @ ground.swapaxes(1, 2) + H[:, :, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((mapped[:, :2] / mapped[:, 2:]).swapaxes(1, 2))

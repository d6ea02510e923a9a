"""Flat boards seen through lenses that bend, drawn at random, none of which folds back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scenes import Scene, random_flat_set

from neurocal_cli.lens import distort, fold_radius

BENT = ("none", "k1", "k1k2", "k1k2p1p2", "plumb_bob", "fisheye")
SIGMA = 0.2


def bent_set(model: str, seed: int) -> tuple[Scene, list[float]]:
    """A scene of a bent lens and its coefficients."""
    rng = np.random.default_rng(seed)
    n_views = int(rng.integers(8, 20))
    fixed = {"f": 330.0, "width": 640} if model == "fisheye" else {}
    while True:
        scene = random_flat_set(rng, n_views, False, **fixed)
        A, (width, height) = scene.intrinsics.A, scene.image_size
        corners = np.array([[u, v] for u in (0, width) for v in (0, height)])
        reach = float(np.hypot(*((corners - A[:2, 2]) / [A[0, 0], A[1, 1]]).T).max())
        k = coefficients(model, 0.6 * width / A[0, 0], rng)
        enough = len(scene.world) >= 25 * n_views
        if enough and (model == "none" or fold_radius(model, k, 1.6 * reach) > 1.6 * reach):
            return through(scene, model, k), k


def coefficients(model: str, r: float, rng: np.random.Generator) -> list[float]:
    """Coefficients that bend by 5 to 25 % at the radius r."""
    sign = rng.choice([-1.0, 1.0])
    k1, k2 = sign * rng.uniform(0.05, 0.25) / r**2, -sign * rng.uniform(0.02, 0.1) / r**4
    p1, p2 = rng.uniform(0.003, 0.01, 2) * rng.choice([-1, 1], 2) / r
    k3 = sign * rng.uniform(0.02, 0.06) / r**6
    whole = [k1, k2, p1, p2, k3]
    if model == "fisheye":
        return (rng.normal(size=4) * [0.05, 0.02, 0.01, 0.003]).tolist()
    return [float(k) for k in whole[: {"none": 0, "k1": 1, "k1k2": 2, "k1k2p1p2": 4, "plumb_bob": 5}[model]]]


def through(scene: Scene, model: str, k: list[float]) -> Scene:
    """The same scene through a lens."""
    if model == "none":
        return scene
    A = scene.intrinsics.A
    y = (scene.pixels[:, 1] - A[1, 2]) / A[1, 1]
    x = (scene.pixels[:, 0] - A[0, 2] - A[0, 1] * y) / A[0, 0]
    x, y = distort(model, k, x, y)
    return replace(
        scene, pixels=np.column_stack([A[0, 0] * x + A[0, 1] * y + A[0, 2], A[1, 1] * y + A[1, 2]])
    )

"""Clouds of surveyed points, seen by a known camera: every point is off by its standard deviation."""

from __future__ import annotations

import numpy as np

from neurocal_cli import Correspondences
from neurocal_cli.camera.geometry import Array, rotation_step
from neurocal_cli.camera.pinhole import Pose

K = np.array([[1000.0, 0.0, 640.0], [0.0, 1010.0, 480.0], [0.0, 0.0, 1.0]])
_SIZE = np.array([300.0, 250.0, 200.0])


def surveyed(
    seed: int, n: int = 60, n_views: int = 4, std: float = 2.0, spread: float = 0.7, stated: float = 1.0
) -> tuple[Correspondences, dict[str, Pose], Array]:
    """Points, their true poses, and the true places of the points (n, 3).

    Parameters
    ----------
    seed : int
    n, n_views : int
    std : float [mm]
        Median standard deviation of a coordinate; the pixels' is 0.3 px.
    spread : float
        Of its logarithm, from point to point.
    stated : float
        What the survey states, of the true ones.
    """
    rng = np.random.default_rng([14, seed])
    true = rng.uniform(-1, 1, (n, 3)) * _SIZE
    own = np.repeat(std * np.exp(spread * rng.standard_normal((n, 1))), 3, axis=1)
    given = true + own * rng.standard_normal((n, 3))
    poses, pixels = {}, []
    for k in range(n_views):
        R = rotation_step(rng.uniform(-0.6, 0.6, 3))
        pose = Pose(R, np.array([*rng.uniform(-30, 30, 2), rng.uniform(800, 1200)]))
        x = (true @ R.T + pose.t) @ K.T
        pixels.append(x[:, :2] / x[:, 2:] + 0.3 * rng.standard_normal((n, 2)))
        poses[f"view{k}"] = pose
    labels = np.repeat(list(poses), n)
    points = Correspondences(
        np.tile(given, (n_views, 1)), np.concatenate(pixels), labels, (1280, 960),
        world_std=stated * np.tile(own, (n_views, 1)),
    )  # fmt: skip
    return points, poses, true

"""Mid-points as a detector gives them: measured across their edges, along them told by a common map."""

from __future__ import annotations

import numpy as np
from scenes import board_midpoints, random_flat_set

from neurocal_cli import Correspondences
from neurocal_cli.camera import Intrinsics, project
from neurocal_cli.geometry import Array


def edge_set(seed: int, n_views: int = 8, sigma: float = 0.01) -> tuple[Intrinsics, Correspondences]:
    """A camera and what it saw of a board of 9 x 6 vertices in some views."""
    rng = np.random.default_rng(seed)
    scene = random_flat_set(rng, n_views, False, cols=9, rows=6, width=640, f=600.0)
    middle = board_midpoints(9, 6)
    world = 25.0 * np.column_stack([middle, np.zeros(len(middle))])
    ends = world + np.where((middle[:, :1] % 1) > 0, [[1.0, 0, 0]], [[0, 1.0, 0]])
    pixels, across, covariance = [], [], []
    for pose in scene.poses.values():
        true, _ = project(scene.intrinsics.A, pose, world)
        along = project(scene.intrinsics.A, pose, ends)[0] - true
        along /= np.linalg.norm(along, axis=1)[:, None]
        normal = along[:, ::-1] * [-1.0, 1.0]
        noise, C = measured(true, along, normal, sigma * rng.uniform(0.5, 2.0, len(true)), rng)
        pixels.append(true + noise)
        across.append(normal)
        covariance.append(C)
    points = Correspondences(
        np.tile(world, (n_views, 1)),
        np.concatenate(pixels),
        np.repeat(list(scene.poses), len(world)),
        scene.image_size,
        covariance=np.concatenate(covariance),
        across=np.concatenate(across),
    )
    return scene.intrinsics, points


def measured(
    true: Array, along: Array, normal: Array, sigma: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Errors (N, 2) of the points of one board and their covariances (N, 3), each true by itself.

    Across the edges they are independent; along them they are those of a homography through all edges.
    """
    across = sigma * rng.normal(size=len(true))
    x, y = ((true - true.mean(axis=0)) / np.abs(true - true.mean(axis=0)).max()).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    to_u = np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=1)
    to_v = np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=1)
    by_map = np.stack([to_u, to_v], axis=1)
    J = (normal[:, None] @ by_map)[:, 0] / sigma[:, None]
    of_map = np.linalg.inv(J.T @ J)
    told = (along[:, None] @ by_map)[:, 0]
    slipped = told @ of_map @ J.T @ (across / sigma)
    of_along = ((told @ of_map) * told).sum(axis=1)
    (nu, nv), (su, sv), s2 = normal.T, along.T, sigma**2
    C = [
        s2 * nu * nu + of_along * su * su,
        s2 * nu * nv + of_along * su * sv,
        s2 * nv * nv + of_along * sv * sv,
    ]
    return across[:, None] * normal + slipped[:, None] * along, np.stack(C, axis=1)

"""Mid-points as a detector gives them: measured across their edges, along them told by a common map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli import Correspondences
from neurocal_cli.camera.distortion import distort
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics
from support.distorted import without_camera
from support.plain_projection import project
from support.scenes import board_midpoints, random_flat_set


def edges(square: float = 25.0) -> tuple[Array, Array]:
    """Mid-points of a board of 9 x 6 vertices, and points farther along their edges; (93, 3) each."""
    middle = board_midpoints(9, 6)
    world = square * np.column_stack([middle, np.zeros(len(middle))])
    return world, world + np.where((middle[:, :1] % 1) > 0, [[1.0, 0, 0]], [[0, 1.0, 0]])


def edge_set(
    seed: int, n_views: int = 8, sigma: float = 0.01, lens: tuple[float, ...] = ()
) -> tuple[Intrinsics, Correspondences]:
    """A camera, with or without k1, k2 and so on, and what it saw of a board in some views."""
    rng = np.random.default_rng(seed)
    scene = random_flat_set(rng, n_views, False, cols=9, rows=6, width=640, f=600.0)
    world, ends = edges()
    true, farther = (
        bent(
            scene.intrinsics.A,
            np.concatenate([project(scene.intrinsics.A, pose, some)[0] for pose in scene.poses.values()]),
            lens,
        )
        for some in (world, ends)
    )
    exact = Correspondences(
        np.tile(world, (n_views, 1)), true, np.repeat(list(scene.poses), len(world)), scene.image_size
    )
    return scene.intrinsics, as_measured(exact, farther, sigma, rng)


def bent(A: Array, pixels: Array, lens: tuple[float, ...]) -> Array:
    if not lens:
        return pixels
    x, y = without_camera(A, pixels)
    x, y = distort("plumb_bob", [*lens, *[0.0] * (5 - len(lens))], x, y)
    return np.column_stack([A[0, 0] * x + A[0, 1] * y + A[0, 2], A[1, 1] * y + A[1, 2]])


def as_measured(
    exact: Correspondences, farther: Array, sigma: float, rng: np.random.Generator
) -> Correspondences:
    """Exact points with the errors of a detector, given pixels (N, 2) farther along each edge."""
    pixels, across, covariance = [], [], []
    for view in range(exact.n_views):
        rows = exact.view_index == view
        along = farther[rows] - exact.pixels[rows]
        along /= np.linalg.norm(along, axis=1)[:, None]
        normal = along[:, ::-1] * [-1.0, 1.0]
        spread = sigma * rng.uniform(0.5, 2.0, len(along))
        noise, C = measured(exact.pixels[rows], along, normal, spread, rng)
        pixels.append(exact.pixels[rows] + noise)
        across.append(normal)
        covariance.append(C)
    joined = (np.concatenate(parts) for parts in (pixels, across, covariance))
    return replace(exact, **dict(zip(("pixels", "across", "covariance"), joined, strict=True)))


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

"""Calibration sessions of one camera: each time other views of a chessboard, with other noise."""

from __future__ import annotations

import numpy as np

from neurocal_cli import Camera, Correspondences, Intrinsics, Pose
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import Array

SIZE = (1280, 960)
_FEWEST = 30  # of the 54 points in a view


def camera(scale: float = 1.0, centre: tuple[float, float] = (652.0, 471.0)) -> Camera:
    """A camera of 1280 x 960 px, whose scale and image centre may have changed."""
    return Camera(Intrinsics(1100.0 * scale, 1102.0 * scale, *centre), Distortion("k1k2", [-0.2, 0.08]), SIZE)


def session(seen_by: Camera, rng: np.random.Generator, n_views: int, sigma: float = 0.15) -> Correspondences:
    """Points of 9 x 6 vertices, 25 mm apart, in tilted views all over the image, with noise [px]."""
    world = np.column_stack([25.0 * np.indices((9, 6)).reshape(2, -1).T, np.zeros(54)])
    seen: list[tuple[Array, Array]] = []
    while len(seen) < n_views:
        tilt, side, roll = np.radians(rng.uniform(10, 40)), rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4)
        turn = Pose.from_euler(0, 0, side, np.zeros(3)).R
        R = turn @ Pose.from_euler(tilt, 0, 0, np.zeros(3)).R @ turn.T
        R = R @ Pose.from_euler(0, 0, roll, np.zeros(3)).R
        z = rng.uniform(250, 600)
        t = np.array([rng.uniform(-0.5, 0.5) * z, rng.uniform(-0.4, 0.4) * z, z]) - R @ world.mean(axis=0)
        pixels, in_front = seen_by.project(world @ R.T + t)
        inside = in_front & (pixels > 0).all(axis=1) & (pixels < np.array(SIZE) - 1).all(axis=1)
        if np.count_nonzero(inside) >= _FEWEST:
            noisy = pixels[inside] + sigma * rng.normal(size=(np.count_nonzero(inside), 2))
            seen.append((world[inside], noisy))
    worlds, pixels_of = zip(*seen, strict=True)
    names = np.repeat([f"view{k:02d}" for k in range(n_views)], [len(one) for one in worlds])
    return Correspondences(np.concatenate(worlds), np.concatenate(pixels_of), names, image_size=SIZE)

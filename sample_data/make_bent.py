"""Photographs' points of a board that is bent and stretched; its file says that it is flat.

Run ``python sample_data/make_bent.py`` to write ``bent.csv`` again, byte for byte.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.distortion import Distortion
from neurocal_cli.camera.geometry import rotation_step
from neurocal_cli.camera.pinhole import Intrinsics
from neurocal_cli.files.points_csv import write_points
from neurocal_cli.observations.points import Correspondences

HERE = Path(__file__).resolve().parent
SIZE = (1280, 960)
CAMERA = Camera(Intrinsics(1100.0, 1102.0, 652.0, 471.0), Distortion("k1k2", np.array([-0.2, 0.08])), SIZE)
COLS, ROWS, SQUARE = 9, 6, 25.0
BEND, STRETCH = 0.6, 0.002  # mm between the middle and the ends; share along x
SIGMA = 0.1  # px
VIEWS = 12


def board() -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Vertices as the file has them, as they are, and their ids."""
    c, r = np.meshgrid(np.arange(COLS), np.arange(ROWS))
    given = SQUARE * np.column_stack([c.ravel(), r.ravel(), np.zeros(c.size)])
    x = (given[:, 0] - given[:, 0].mean()) / np.ptp(given[:, 0]) * 2
    true = given + np.column_stack([STRETCH * given[:, 0], np.zeros(len(given)), BEND * x**2])
    return given, true, [f"{a}:{b}" for a, b in zip(c.ravel(), r.ravel(), strict=True)]


def views() -> Correspondences:
    """All views, with noise."""
    rng = np.random.default_rng(14)
    given, true, ids = board()
    pixels = []
    while len(pixels) < VIEWS:
        R = rotation_step(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.3, 0.3))[None])[0]
        depth = rng.uniform(300, 480)
        t = np.append(rng.uniform(-0.25, 0.25, 2) * depth, depth) - R @ given.mean(axis=0)
        seen, _ = CAMERA.project(true @ R.T + t)
        if (seen > 5).all() and (seen < np.array(SIZE) - 5).all():
            pixels.append(np.round(seen + SIGMA * rng.standard_normal(seen.shape), 3))
    names = np.repeat([f"bent{k + 1:02d}" for k in range(VIEWS)], len(given))
    world = np.tile(given, (VIEWS, 1))
    return Correspondences(world, np.concatenate(pixels), names, SIZE, point=np.tile(ids, VIEWS))


if __name__ == "__main__":
    write_points(views(), str(HERE / "bent.csv"))

"""Scenes that can be calibrated, and ways to spoil their data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli import Calibration, Correspondences
from neurocal_cli.errors import NeurocalError
from support.plain_projection import project
from support.scenes import Scene, pinhole, random_flat_set, random_solid

SIGMA = 0.3
MISMATCHES = (
    *("shuffled", "read by columns", "another camera", "oblong squares", "mirrored"),
    *("half shifted by a square", "rows to and fro"),
)


def good(seed: int, flat: bool, n_views: int = 0) -> tuple[Scene, Correspondences, Calibration]:
    """A scene whose points tell the camera well, the points and what they give."""
    rng = np.random.default_rng(seed)
    while True:
        if flat:
            views = n_views or int(rng.integers(5, 13))
            size = {"cols": int(rng.integers(7, 12)), "rows": int(rng.integers(5, 8))}
            scene = random_flat_set(rng, views, False, **size)
        else:
            scene = random_solid(rng, 1, False)
            if len(scene.world) < 60:
                continue
        points = scene.points(SIGMA, rng)
        try:
            found = pinhole(points, skew=False)
        except NeurocalError:
            continue
        if found.std["alpha_u"] < 0.05 * found.intrinsics.alpha_u:
            return scene, points, found


def with_outliers(
    scene: Scene, points: Correspondences, share: float, rng: np.random.Generator
) -> tuple[Correspondences, np.ndarray]:
    """Pixels of a share of the points anywhere in the image, and the rows."""
    pixels = points.pixels.copy()
    rows = rng.choice(len(points), round(share * len(points)), replace=False)
    pixels[rows] = rng.uniform(0, 1, (len(rows), 2)) * scene.image_size
    return replace(points, pixels=pixels), rows


def mismatched(
    scene: Scene, points: Correspondences, view: int, kind: str, rng: np.random.Generator
) -> Correspondences:
    """One view of flat boards spoilt in one of the ways of `MISMATCHES`."""
    pixels, world = points.pixels.copy(), points.world.copy()
    rows = np.flatnonzero(points.view_index == view)
    cols = len(np.unique(world[rows, 0]))
    if kind == "shuffled":
        pixels[rows] = pixels[rng.permutation(rows)]
    elif kind == "read by columns":
        pixels[rows] = pixels[rows].reshape(-1, cols, 2).transpose(1, 0, 2).reshape(-1, 2)
    elif kind == "another camera":
        A = scene.intrinsics.A @ np.diag([1.25, 1.25, 1.0])
        seen, _ = project(A, scene.poses[points.view_names[view]], world[rows])
        pixels[rows] = seen + SIGMA * rng.normal(size=seen.shape)
    elif kind == "oblong squares":
        world[rows, 1] *= 1.1
    elif kind == "mirrored":
        world[rows, 0] = world[rows, 0].max() - world[rows, 0]
    elif kind == "half shifted by a square":
        world[rows[world[rows, 0] > np.median(world[rows, 0])], 0] += 25.0
    else:
        to_and_fro = rows.reshape(-1, cols).copy()
        to_and_fro[::2] = to_and_fro[::2, ::-1]
        pixels[rows] = pixels[to_and_fro.ravel()]
    return replace(points, pixels=pixels, world=world)


def farthest(spoilt: Calibration, clean: Calibration, but: str = "") -> float:
    """Most standard deviations of the clean result by which a parameter or a pose (but one) differs."""
    far = []
    for name in ("alpha_u", "alpha_v", "u0", "v0"):
        far.append(abs(getattr(spoilt.intrinsics, name) - getattr(clean.intrinsics, name)) / clean.std[name])
    for name in (clean.views.keys() & spoilt.views.keys()) - {but}:
        one, two, std = clean.views[name].pose, spoilt.views[name].pose, clean.views[name].std
        far += (np.abs(one.t - two.t) / [std["t_x"], std["t_y"], std["t_z"]]).tolist()
        turn = two.R @ one.R.T
        omega = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        far.append(float(np.linalg.norm(omega) / np.linalg.norm([std["R_x"], std["R_y"], std["R_z"]])))
    return max(far)

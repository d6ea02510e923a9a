"""Folded targets of two or three boards that were set up by hand, and their photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli import Calibration, Correspondences
from neurocal_cli.camera.distortion import Distortion, distort
from neurocal_cli.camera.geometry import Array, rotation_step
from support.rigs import RigScene, corner, random_rig

_PER_PLANE = 36
SIZE = (1280, 960)


@dataclass(frozen=True, eq=False)
class Folded:
    """A folded target as its file has it, and a rig that sees it as it is."""

    given: Array  # (n, 3) [mm]
    plane: NDArray[np.intp]
    scene: RigScene

    def seen(self, side: int, sigma: float, rng: np.random.Generator) -> Correspondences:
        """What one camera sees, with the coordinates of the file."""
        points = self.scene.points(side, sigma, rng)
        return replace(points, world=np.tile(self.given, (points.n_views, 1)))


def folded(
    rng: np.random.Generator,
    off: float,
    n_views: int = 1,
    planes: int = 3,
    bend: float = 0.0,
    lens: str = "none",
    ids: bool = True,
) -> Folded:
    """Planes `off` mm and as many hundredths of a radian from their places, and bent by `bend` mm."""
    given = corner()[: planes * _PER_PLANE]
    plane, true = np.repeat(np.arange(planes), _PER_PLANE), given.copy()
    for k in range(planes):
        own, normal = given[plane == k], int(np.argmin(np.ptp(given[plane == k], axis=0)))
        centred = own - own.mean(axis=0)
        bent = centred.copy()
        bent[:, normal] += (centred / 70.0) ** 2 @ rng.normal(0, bend, 3)
        turned = bent @ rotation_step(rng.normal(0, 0.01 * off, 3)).T
        true[plane == k] = own.mean(axis=0) + turned + rng.normal(0, off, 3)
    scene = random_rig(rng, "verging", n_views, lens, true)
    if ids:
        named = (f"{'abc'[k]}/{i % 6}:{i // 6 % 6}" for i, k in enumerate(plane))
        scene = replace(scene, ids=tuple(named))
    return Folded(given, plane, scene)


@dataclass(frozen=True, eq=False)
class Corner:
    """One photograph of two or three boards that meet at any angle, with its camera."""

    points: Correspondences
    f: float  # alpha_u [px]; alpha_v is 1.001 times as much, and the centre is that of the image

    def off(self, found: Calibration) -> Array:
        """Errors of the intrinsic parameters over std."""
        truth = {"alpha_u": self.f, "alpha_v": 1.001 * self.f, "u0": SIZE[0] / 2, "v0": SIZE[1] / 2}
        return np.array([(getattr(found.intrinsics, k) - v) / found.std[k] for k, v in truth.items()])


def random_corner(seed: int) -> Corner:
    """Boards of any size and number of squares, set up within 0 to 4 % of a square, flat or bent."""
    rng = np.random.default_rng([seed, 7])
    square, f = rng.uniform(10, 40), rng.uniform(600, 1600)
    off, bend = rng.choice([0, 0.004, 0.02, 0.04]) * square, rng.choice([0, 0, 0.01, 0.04]) * square
    a, b = np.radians(rng.uniform(70, 120)), np.radians(rng.uniform(70, 110))
    frames = np.array(
        [
            np.eye(3),
            [[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]],
            [[0, 1, 0], [np.cos(b), 0, np.sin(b)], [np.sin(b), 0, -np.cos(b)]],
        ]
    )  # rows: x axis, y axis, normal
    given, true, ids = [], [], []
    for k, frame in enumerate(frames[: rng.integers(2, 4)]):
        cols, rows = rng.integers(5, 10), rng.integers(4, 8)
        x, y = (v.ravel() for v in np.meshgrid(np.arange(1, cols + 1), np.arange(1, rows + 1)))
        local = square * np.column_stack([x, y, 0 * x])
        middle = local.mean(axis=0)
        x, y = ((local - middle) / (0.5 * np.ptp(local[:, 0]))).T[:2]
        bent = local - middle
        bent[:, 2] = np.column_stack([x * x, y * y, x * y]) @ rng.normal(0, bend, 3)
        turned = bent @ frame @ rotation_step(rng.normal(0, 0.28 * off / square, 3)).T
        given.append(local @ frame)
        true.append(middle @ frame + turned + rng.normal(0, off, 3))
        ids += [f"{'abc'[k]}/{i % cols}:{i // cols}" for i in range(len(local))]
    lens = Distortion("k1k2", np.array([-0.2, 0.08])) if rng.random() < 0.5 else Distortion()
    world, noise = np.concatenate(true), rng.choice([0.03, 0.1, 0.4])
    while True:
        away = np.abs(rng.normal(size=3))
        forward = -away / np.linalg.norm(away)
        across = np.cross(forward, rng.normal(size=3))
        across /= np.linalg.norm(across)
        R = np.stack([across, np.cross(forward, across), forward])
        depth = f * np.ptp(world, axis=0).max() / rng.uniform(600, 900)
        camera = (world - world.mean(axis=0)) @ R.T + [0, 0, depth]
        if camera[:, 2].min() < 0.2 * depth:
            continue
        x, y = distort(lens.model, lens.coefficients, *(camera[:, :2] / camera[:, 2:]).T)
        pixels = np.column_stack([f * x, 1.001 * f * y]) + np.array(SIZE) / 2
        seen = ((pixels > 5) & (pixels < np.array(SIZE) - 5)).all(axis=1)
        if seen.mean() > 0.9:
            break
    pixels += noise * rng.standard_normal(pixels.shape)
    every = Correspondences(np.concatenate(given), pixels, None, SIZE, point=np.array(ids))
    return Corner(every.select(np.flatnonzero(seen)), f)

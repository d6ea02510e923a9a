"""Folded targets of two or three boards that were set up by hand, and their photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli import Correspondences
from neurocal_cli.geometry import Array, rotation_step
from support.rigs import RigScene, corner, random_rig

_PER_PLANE = 36


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

"""Render images of a simulated scene, with its visible points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.errors import InputError
from neurocal_cli.observations.points import Correspondences
from neurocal_cli.simulation.rendering import Scene, Sides, Target, render
from neurocal_cli.simulation.scenes import SimulatedScene

_MARGIN = 0.5  # squares of white paper around a board of one plane


@frozen_dataclass(eq=False)
class Picture:
    """A rendered view."""

    name: str
    image: NDArray[np.uint8]
    visible: frozenset[str]  # ids of the mid-points whose edges are visible


def pictures(scene: SimulatedScene, seed: int = 0) -> Iterator[Picture]:
    """Render every view of a scene of a board, with default blur and noise of a seed.

    Raises InputError if the scene has no board.
    """
    if scene.board is None:
        raise InputError("there is no board to render: the scene's points are those of a file; give a board")
    planes = scene.board.planes
    # With several planes, the pattern may extend to a fold, and paper beyond it would cross the fold.
    margin = Sides.all(_MARGIN if len(planes) == 1 else 0.0)
    targets = tuple(Target(plane, margin=margin) for plane in planes)
    for number, (name, pose) in enumerate(scene.poses.items()):
        drawn = render(
            Scene(scene.camera, pose, targets, unit=scene.unit), np.random.default_rng((seed, number))
        )
        seen = [np.array(one.midpoint_ids)[one.edges_visible] for one in drawn.truth.planes]
        yield Picture(
            name, drawn.image.astype(np.uint8, copy=False), frozenset(np.concatenate(seen).tolist())
        )


def visible_points(scene: SimulatedScene, rendered: list[Picture]) -> Correspondences:
    """Exact points that are visible in the pictures."""
    shown = {one.name: one.visible for one in rendered}
    points = scene.points()
    assert scene.point is not None  # a board's points have ids
    rows = [id_ in shown[name] for name, id_ in zip(scene.view, scene.point, strict=True)]
    return replace(points.select(np.array(rows)), image_center=None)

"""The target that all settings of a zoom lens share, found from some of them together.

Each of these settings is calibrated by itself; then the offsets of the target's points are found with all of
these cameras (`pipeline.common_target`). The lens is fitted to the target that was found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.errors import NeurocalError
from neurocal_cli.initialisation.options import Progress
from neurocal_cli.methods import calibrate
from neurocal_cli.pipeline.common_target import common_target
from neurocal_cli.target import Target
from neurocal_cli.zoom_lens.settings import LensPoints

_SETTINGS = 12  # most settings used; each adds unknowns, and more hardly improve the target
_FEWEST = 2


def lens_target(
    lens: LensPoints,
    choice: str,
    distortion: str,
    skew: bool,
    seed: int,
    progress: Progress,
) -> Target | None:
    """Estimate the target; None if it stays as given.

    Parameters
    ----------
    lens : LensPoints
        Several views of a target at each setting.
    choice : {"auto", "given", "flat", "free"}
    distortion : str
        Distortion model, or auto.
    skew : bool
    seed : int
    progress : callable
    """
    if choice == "given":
        return None
    some = np.unique(np.linspace(0, lens.n_settings - 1, _SETTINGS).astype(np.intp))
    cameras = []
    for k, s in enumerate(some.tolist()):
        progress("finding the target", k / len(some))
        points = replace(lens.points.select(lens.point_setting == s), world_std=None)
        try:
            cameras.append(calibrate(points, distortion=distortion, target="given", skew=skew, seed=seed))
        except NeurocalError:
            continue
    return common_target(cameras, choice) if len(cameras) >= _FEWEST else None


def on_target(lens: LensPoints, target: Target | None) -> LensPoints:
    """Points with the coordinates of the target."""
    return lens if target is None else replace(lens, points=target.applied(lens.points))

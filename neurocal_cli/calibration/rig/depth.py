"""How uncertain the depth of triangulated points is, by the covariance of a rig and its cameras."""

from __future__ import annotations

import numpy as np

from neurocal_cli.calibration.rig.adjust import RigFit
from neurocal_cli.calibration.rig.pairing import ViewPairs, pair_points
from neurocal_cli.calibration.rig.point_moves import (
    camera_in_pixels,
    in_camera,
    point_moves,
    shared_covariance,
)
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Pose
from neurocal_cli.errors import InputError

_MOST_POINTS = 400  # most points that are triangulated


def depth_std(fit: RigFit, first: int, second: int) -> tuple[Array, Array]:
    """Depths of points that two cameras see, in the first of them, and their std for exact pixels.

    Both are (N,) in world units, of some points that are evenly spaced over the frames of both; nan for
    points that are behind a camera, and empty without common points.
    """
    problem, state = fit.problem, fit.state
    sides = problem.calibrations[first].points, problem.calibrations[second].points
    seen = [problem.observations[side] for side in (first, second)]
    of_second = {
        frame: name
        for name, frame in zip(problem.names[second], seen[1].view.tolist(), strict=True)
        if problem.together[frame]
    }
    frames = zip(problem.names[first], seen[0].view.tolist(), strict=True)
    pairs = tuple((name, of_second[frame]) for name, frame in frames if frame in of_second)
    if not pairs:
        return np.zeros(0), np.zeros(0)
    try:
        rows = pair_points(*sides, ViewPairs(pairs))
    except InputError:  # views of different parts of the target
        return np.zeros(0), np.zeros(0)
    step = max(1, len(rows.left) // _MOST_POINTS)
    pixels = sides[0].pixels[rows.left[::step]], sides[1].pixels[rows.right[::step]]
    cameras = camera_in_pixels(fit, first), camera_in_pixels(fit, second)
    R = state.R[second] @ state.R[first].T
    pose = Pose(R, (state.t[second] - R @ state.t[first]) * problem.unit)
    found = triangulate(*cameras, pose, *pixels)
    kept = ~found.behind
    points = (found.points[kept] - problem.unit * state.t[first]) @ state.R[first]
    sees = np.isin(np.arange(len(problem.cameras)), (first, second))
    moves, _ = point_moves(fit, points, np.repeat(sees[:, None], len(points), axis=1))
    down = state.R[first][2] @ moves
    if first:
        down[:, state.columns.rigs[first]] += in_camera(fit, points, first)[1][:, 2]
    depth, std = np.full(len(kept), np.nan), np.full(len(kept), np.nan)
    depth[kept] = found.points[kept, 2]
    variance = np.einsum("ni,ij,nj->n", down, shared_covariance(fit), down)
    std[kept] = np.sqrt(np.maximum(variance, 0.0))
    return depth, std

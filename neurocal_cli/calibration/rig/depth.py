"""How uncertain the depth of triangulated points is, by the covariance of a rig and its cameras."""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.problem import intrinsic_matrix
from neurocal_cli.calibration.rig.adjust import RigFit, is_significant, scatter
from neurocal_cli.calibration.rig.covariance import contradicting_covariance, covariance_by_given
from neurocal_cli.calibration.rig.pairing import ViewPairs, pair_points
from neurocal_cli.calibration.rig.state import RigState
from neurocal_cli.calibration.rig.triangulation import triangulate
from neurocal_cli.camera.camera import Camera
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.pinhole import Intrinsics, Pose
from neurocal_cli.errors import InputError

_MOST_POINTS = 400  # most points that are triangulated
_STEP = 1e-2  # standard deviations: small enough to be linear, large against rounding
_LEAST_STEP = 1e-9


def depth_std(fit: RigFit, first: int, second: int) -> tuple[Array, Array]:
    """Depths of points that two cameras see, in the first of them, and their std for exact pixels.

    Both are (N,) in world units, of some points that are evenly spaced over the frames of both; nan for
    points that are behind a camera, and empty without common points.
    """
    problem, state, columns = fit.problem, fit.state, fit.state.columns
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

    def camera(of: RigState, side: int) -> Camera:
        entries = problem.observations[side].in_pixels(of.cameras[side].entries[0])
        return Camera(Intrinsics.from_matrix(intrinsic_matrix(entries)), of.cameras[side].distortion)

    def depths(step: Array) -> Array:
        moved = state.moved(step, np.zeros((len(problem.scale), 6)))
        R = moved.R[second] @ moved.R[first].T
        pose = Pose(R, (moved.t[second] - R @ moved.t[first]) * problem.unit)
        found = triangulate(camera(moved, first), camera(moved, second), pose, *pixels)
        return np.where(found.behind, np.nan, found.points[:, 2])

    own = np.concatenate([place for side in (first, second)
                          for place in (columns.cameras[side], columns.rigs[side])])  # fmt: skip
    covariance = _covariance(fit)[np.ix_(own, own)]
    depth = depths(np.zeros(columns.n_shared))
    moving = np.flatnonzero(np.diagonal(covariance))
    covariance = covariance[np.ix_(moving, moving)]
    steps = np.maximum(_STEP * np.sqrt(np.abs(np.diagonal(covariance))), _LEAST_STEP)
    unit = np.eye(columns.n_shared)[own[moving]]
    J = np.stack([(depths(h * one) - depth) / h for h, one in zip(steps, unit, strict=True)], axis=1)
    return depth, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, covariance, J), 0.0))


def _covariance(fit: RigFit) -> Array:
    """(n_shared, n_shared) covariance of what the frames share: of the fit, and of given cameras."""
    free = np.flatnonzero(fit.free)
    shared = np.zeros((len(fit.free), len(fit.free)))
    if is_significant(*scatter(fit)):
        shared[np.ix_(free, free)] = contradicting_covariance(fit)
    else:
        shared[np.ix_(free, free)] = fit.variance * fit.normal.only(free).covariance().shared
    given = covariance_by_given(fit.problem, fit.state, fit.normal, fit.free)
    return shared if given is None else shared + given.shared

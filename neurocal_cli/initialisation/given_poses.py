"""Type 4: V is given, so all views together are one layer, W, with known inputs."""

from __future__ import annotations

import numpy as np

from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.problem import intrinsic_matrix
from neurocal_cli.bundle_adjustment.reprojection import ENTRIES, CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import point_residuals
from neurocal_cli.bundle_adjustment.units import translations_normalised
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.geometry import Array
from neurocal_cli.network import Patterns
from neurocal_cli.training.starts import FixedWeights, learn

__all__ = ["solve_given_poses"]


def solve_given_poses(job: Job) -> Solution:
    """Train the five weights of W, then take the last step on the pixel error.

    Raises
    ------
    DegenerateGeometryError
        A given pose puts points behind the camera, or only a mirrored camera could see them so.
    """
    views, known, strategy = job.views, job.known, job.strategy
    R, t = _normalised_poses(job)
    _check_in_front(views, R, t)
    rows = views.patterns(np.arange(views.n_views), False, strategy.finish_points, job.rng)
    # Hidden outputs Y = V Z, eq. (6): the camera's coordinates.
    hidden = rows.inputs @ np.swapaxes(np.concatenate([R, t[..., None]], axis=2), 1, 2)
    # Each view has its own scale; gamma absorbs it, and starts at 1: depths should be about 1,
    # "with appropriate scaling if necessary".
    real = rows.weights > 0
    depth = np.where(real, hidden[..., 2], np.nan)
    hidden = hidden / np.nanmean(depth, axis=1)[:, None, None]
    patterns = Patterns(hidden[real][None], rows.targets[real][None], rows.weights[real][None])
    W = intrinsic_matrix(job.entries)
    row, column = ENTRIES
    W[row[known.free], column[known.free]] = np.nan
    fixed = FixedWeights(W, np.eye(3)[None])
    learnt = learn(patterns, strategy.trainer, job.rng, strategy.limit, fixed, strategy.agreement)
    entries = np.where(known.free, learnt.W[0][ENTRIES], job.entries)[None]
    if (entries[0, [0, 2]] <= 0).any():
        raise DegenerateGeometryError(
            "only a mirrored camera could see these pixels from the given poses; check the poses (world to "
            "camera, z forward), the axes of X,Y,Z (right-handed?) and of u,v (v downwards?), and the pairing"
        )
    state = CameraState(entries, R, t)
    tally = job.tally
    tally.note(np.arange(views.n_views), learnt.agreed, int(learnt.starts.sum()), learnt.iterations)
    tally.squares = float(learnt.rms[0] ** 2 * len(views.index))
    tally.before = float((point_residuals(views, state) ** 2).sum())
    tally.curve = learnt.curve
    return Solution(job.adjust(state), tally)


def _check_in_front(views: Views, R: Array, t: Array) -> None:
    """Every point, not only those that train the network."""
    depth = (views.local * np.repeat(R[:, 2], views.counts, axis=0)).sum(axis=1)
    behind = np.minimum.reduceat(depth, views.first) + t[:, 2] <= 0
    if behind.any():
        raise DegenerateGeometryError(
            f"the given pose of view {views.names[int(np.argmax(behind))]!r} puts points behind the camera; "
            "it must map world to camera, Xc = R M + t, z forward"
        )


def _normalised_poses(job: Job) -> tuple[Array, Array]:
    """The given R (V, 3, 3), and t (V, 3) of each view's centroid in units of its S2."""
    views, poses = job.views, job.known.poses
    assert poses is not None  # type 4
    R = np.stack([poses[name].R for name in views.names])
    t = np.stack([poses[name].t for name in views.names])
    return R, translations_normalised(views, R, t)

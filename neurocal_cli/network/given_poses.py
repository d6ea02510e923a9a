"""Type 4: V is given, so all views together train a single layer, W, with known inputs."""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.problem import Problem, intrinsic_matrix
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution, TrainingRecord
from neurocal_cli.adjustment.units import translations_normalised
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.options import MOST_POINTS, Options
from neurocal_cli.network.patterns import Patterns, patterns_of
from neurocal_cli.network.starts import learn

# With a wide lens: least depth of a training point as a share of its distance (60 degrees from the axis), and
# fewest training points.
_LEAST_DEPTH, _FEWEST = 0.5, 12


def solve_given_poses(problem: Problem, options: Options, rng: np.random.Generator) -> Solution:
    """Train the five weights of W, then minimise the reprojection error.

    Raises DegenerateGeometryError if a given pose puts points behind the camera, or if the pixels fit only a
    mirrored camera.
    """
    views = problem.views
    assert problem.poses is not None  # type 4
    poses = [problem.poses[name] for name in views.names]
    R = np.stack([pose.R for pose in poses])
    t = translations_normalised(views, R, np.stack([pose.t for pose in poses]))
    wide = problem.distortion.wide
    if not wide:
        _check_in_front(views, R, t)
    rows = patterns_of(views, np.arange(views.n_views), False, MOST_POINTS, rng)
    # Hidden outputs Y = V Z, eq. (6): the camera's coordinates.
    hidden = rows.inputs @ np.swapaxes(np.concatenate([R, t[..., None]], axis=2), 1, 2)
    # Each view has its own scale, which gamma absorbs. Gamma starts at 1, so depths should be about 1, "with
    # appropriate scaling if necessary".
    real = rows.weights > 0
    depth = np.where(real, hidden[..., 2], np.nan)
    if wide:  # the network is a pinhole, so it is trained on points well in front only
        real &= depth > _LEAST_DEPTH * np.linalg.norm(hidden, axis=2)
        if real.sum() < _FEWEST:
            raise DegenerateGeometryError(
                "the given poses put nearly all points beside or behind the camera; they must map world to "
                "camera, Xc = R M + t, z forward"
            )
        depth = np.linalg.norm(hidden, axis=2)
    hidden = hidden / np.nanmean(depth, axis=1)[:, None, None]
    patterns = Patterns(hidden[real][None], rows.targets[real][None], rows.weights[real][None])
    given = problem.normalised_entries
    W = intrinsic_matrix(given)
    row, column = ENTRIES
    W[row[problem.free], column[problem.free]] = np.nan
    learnt = learn(patterns, options.trainer, rng, options.starts, options.agreement, W=W, V=np.eye(3)[None])
    entries = np.where(problem.free, learnt.W[0][ENTRIES], given)[None]
    if (entries[0, [0, 2]] <= 0).any():
        raise DegenerateGeometryError(
            "only a mirrored camera could see these pixels from the given poses; check the poses (world to "
            "camera, z forward), the axes of X,Y,Z (right-handed?) and of u,v (v downwards?), and the pairing"
        )
    state = CameraState(entries, R, t)
    record = TrainingRecord(
        np.repeat(learnt.agreed, views.n_views),
        int(learnt.starts.sum()),
        learnt.iterations,
        squares=float(learnt.rms[0] ** 2 * len(views.index)),
        before=float((point_residuals(views, state) ** 2).sum()),
        curve=learnt.curve,
    )
    return Solution(problem, problem.adjust(state), record)


def _check_in_front(views: Views, R: Array, t: Array) -> None:
    """Refuse given poses that put any point behind the camera, also points that do not train the network."""
    depth = (views.local * np.repeat(R[:, 2], views.counts, axis=0)).sum(axis=1)
    behind = np.minimum.reduceat(depth, views.first) + t[:, 2] <= 0
    if behind.any():
        raise DegenerateGeometryError(
            f"the given pose of view {views.names[int(np.argmax(behind))]!r} puts points behind the camera; "
            "it must map world to camera, Xc = R M + t, z forward, with t in the unit of X,Y,Z; a lens that "
            "sees 90 degrees from its axis and more needs --distortion fisheye"
        )

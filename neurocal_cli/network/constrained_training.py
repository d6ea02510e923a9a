"""The paper's constrained training, eq. (14), between stages 2 and 3 for trainers that support it.

It starts from an upper triangular W and an orthonormal V, into which the free network's product has been
split; from random weights it would stall. Training follows eq. (15), with W's structural zeros and given
weights fixed and beta E_orth added to the error.
"""

from __future__ import annotations

import numpy as np

from neurocal_cli.adjustment.problem import Problem, intrinsic_matrix
from neurocal_cli.camera.geometry import nearest_rotation
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.options import MOST_POINTS, Options
from neurocal_cli.network.patterns import patterns_of
from neurocal_cli.network.trainers import Task


def train_constrained(problem: Problem, options: Options, state: CameraState) -> tuple[CameraState, int]:
    """Train one view's network on E_tot from a camera; a flat board's V cannot be constrained.

    Returns the state and the number of iterations. The state is unchanged if the trainer does not support
    this, or if the result is no valid camera.
    """
    views = problem.views
    if options.constrained is None or views.n_views > 1 or views.nearly_flat[0]:
        return state, 0
    depth = float(state.t[0, 2])
    # V is scaled so that depths, and so every gamma, are about 1; the constant a of E_orth compensates.
    V = np.concatenate([state.R, state.t[:, :, None]], axis=2) / depth
    free_W = np.zeros((3, 3), dtype=bool)
    free_W[ENTRIES] = problem.free
    patterns = patterns_of(views, np.array([0]), False, MOST_POINTS)
    task = Task(patterns, intrinsic_matrix(state.entries[0])[None], V, free_W, np.ones((3, 4), dtype=bool))
    trained = options.constrained(task, 1.0 / depth**2)
    entries, R = trained.W[0][ENTRIES], nearest_rotation(trained.V[:, :, :3])
    t = trained.V[:, :, 3] * depth
    moved = CameraState(entries[None], R, t)
    usable = np.isfinite(entries).all() and entries[[0, 2]].min() > 0 and t[0, 2] > 0
    return moved if usable else state, int(trained.iterations.sum())

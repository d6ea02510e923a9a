"""The neural method, from random weights to the minimum of the pixel error, in three stages.

1. Each view's network learns the product W V_k from random weights (`stage_networks`).
2. The orthogonality conditions split the products into one W and a pose for each view
   (`stage_cameras`).
   The paper's trainer goes on with its orthogonality term (`stage_constraints`).
3. All together on the true pixel error (3), with exact rotations (`adjust`), and against whatever
   else might fit (`rivals`).

Nowhere is there an initial guess. Views with too few points for a free network, and cameras that a
free network cannot tell, begin at random cameras instead (`random_cameras`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import Adjusted
from neurocal_cli.bundle_adjustment.job import Job, Solution
from neurocal_cli.bundle_adjustment.observability import parameter_count
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.residual_correlation import point_residuals
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.initialisation.cameras_from_networks import cameras_from_products, candidate_intrinsics
from neurocal_cli.initialisation.constrained_training import train_constrained
from neurocal_cli.initialisation.given_poses import solve_given_poses
from neurocal_cli.initialisation.local_minima import (
    better_by_view,
    reaches_bound,
    refuse_mirrored,
    short_of_bound,
    try_mirrored,
    try_start,
)
from neurocal_cli.initialisation.random_cameras import find_camera, find_poses
from neurocal_cli.initialisation.view_networks import Group, begin_flat, refuse_few_conditions, train_networks

__all__ = ["solve"]

_FEW_POINT_STARTS = 100
_MANY_EQUATIONS = 12  # with so many more equations than unknowns there is one good minimum


def solve(job: Job) -> Solution:
    """Calibrate.

    Raises
    ------
    DegenerateGeometryError
        The views cannot determine what is asked for.
    """
    if job.known.type == 4:
        return solve_given_poses(job)
    views = job.views
    # A free product needs 4 points of a plane or 6 in space.
    able = np.asarray(views.distinct >= np.where(begin_flat(job), 4, 6))
    if job.known.type == 3:
        adjusted = _poses(job, able)
    elif able.all():
        adjusted = _camera_and_poses(job)
    elif views.n_views == 1:
        adjusted = _camera_from_few_points(job)
    else:
        adjusted = _helped_by_others(job, able)
    job.progress("refining", 1.0)
    return Solution(adjusted, job.tally)


def _begin(job: Job, state: CameraState) -> Adjusted:
    """The last stage for the first time: what it starts from is noted."""
    job.progress("refining", 0.0)
    job.tally.before = float((point_residuals(job.views, state) ** 2).sum())
    return job.adjust(state)


def _camera_and_poses(job: Job) -> Adjusted:
    """Types 1 and 2."""
    groups = train_networks(job, np.ones(job.views.n_views, dtype=bool))
    refuse_few_conditions(job, groups)
    first, *others = candidate_intrinsics(job, groups)
    best = _begin(job, train_constrained(job, cameras_from_products(job, groups, first)))
    for entries in others:
        if reaches_bound(job, best, groups):
            break
        best = try_start(job, best, cameras_from_products(job, groups, entries))
    best = try_mirrored(job, best)
    if job.views.n_views == 1:
        best = _against_random_cameras(job, best, groups)
    refuse_mirrored(job, best, groups)
    return best


def _against_random_cameras(job: Job, best: Adjusted, groups: Sequence[Group]) -> Adjusted:
    """One view: with hardly a spare equation, or off the bound, other minima may be lower."""
    spare = 2 * int(job.views.distinct.sum()) - parameter_count(job.known, 1)
    if spare >= _MANY_EQUATIONS and reaches_bound(job, best, groups):
        return best
    found = find_camera(job.views, job.entries, job.known.free, job.rng, job.strategy.limit)
    if found is None:
        return best
    job.tally.starts += found.starts
    return try_start(job, best, found.state)


def _camera_from_few_points(job: Job) -> Adjusted:
    """Type 2 with one view of 5 points: random cameras instead of a free product."""
    starts = max(job.strategy.limit, _FEW_POINT_STARTS)
    found = find_camera(job.views, job.entries, job.known.free, job.rng, starts)
    if found is None:
        raise DegenerateGeometryError(
            f"no random start found a camera for these {len(job.views.index)} points; give more points"
        )
    job.tally.note(np.array([0]), found.agreed, found.starts, found.iterations)
    return _begin(job, found.state)


def _helped_by_others(job: Job, able: NDArray[np.bool_]) -> Adjusted:
    """Types 1 and 2, some views with too few points: they join once the others have told W."""
    views = job.views
    if not able.any():
        raise DegenerateGeometryError(
            f"no view has enough different points by itself (view {views.names[0]!r} has "
            f"{views.distinct[0]}); give at least one view with 6, or 4 on a flat board"
        )
    helpers = np.flatnonzero(able)
    part = Job(views.subset(helpers), job.known, job.strategy, job.rng, job.progress)
    known = _camera_and_poses(part).state
    job.tally.note(helpers, part.tally.agreed, part.tally.starts, part.tally.iterations)
    job.tally.squares, job.tally.before = part.tally.squares, part.tally.before
    job.tally.refinements, job.tally.curve = part.tally.refinements, part.tally.curve
    R, t = np.zeros((views.n_views, 3, 3)), np.zeros((views.n_views, 3))
    R[helpers], t[helpers] = known.R, known.t
    state = _with_random_poses(job, replace(known, R=R, t=t), ~able)
    return try_mirrored(job, job.adjust(state))


def _poses(job: Job, able: NDArray[np.bool_]) -> Adjusted:
    """Type 3: each view's pose by itself."""
    groups = train_networks(job, able) if able.any() else []
    state = cameras_from_products(job, groups, job.entries[None])
    state = train_constrained(job, _with_random_poses(job, state, ~able))
    best = try_mirrored(job, _begin(job, state))
    late = short_of_bound(job, best, groups) | (able & (job.tally.agreed < 2))
    if late.any():
        best = better_by_view(job, best, job.adjust(_with_random_poses(job, best.state, late)))
    refuse_mirrored(job, best, groups)
    return best


def _with_random_poses(job: Job, state: CameraState, which: NDArray[np.bool_]) -> CameraState:
    """The state with some views' poses found from random rotations."""
    members = np.flatnonzero(which)
    if not members.size:
        return state
    starts = max(job.strategy.limit, _FEW_POINT_STARTS)
    found = find_poses(job.views, members, state.entries, job.rng, starts)
    job.tally.note(members, found.agreed, found.starts, found.iterations)
    R, t = state.R.copy(), state.t.copy()
    R[members], t[members] = found.state.R, found.state.t
    return replace(state, R=R, t=t)

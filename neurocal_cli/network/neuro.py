"""The neural method, from random weights to the minimum of the reprojection error, in three stages.

1. Each view's network learns the product W V_k from random weights (`view_networks`).
2. The orthogonality conditions split the products into one W and a pose for each view (`orthogonality`). The
   paper's trainer goes on with its orthogonality term, eq. (14).
3. Bundle adjustment minimises the reprojection error (3) over all parameters, with exact rotations
   (`adjustment.adjust`), also from other starts if another minimum may be lower (`local_minima`).

No stage needs an initial guess. Views with too few points for a free network, and cameras that a free network
does not determine, start from random cameras instead (`starts`). In type 4 V is given, so all views
together train a single layer, W, with known inputs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import OPTIONS, Adjusted
from neurocal_cli.adjustment.problem import Problem, intrinsic_matrix, translations_normalised
from neurocal_cli.adjustment.residual_correlation import point_residuals
from neurocal_cli.adjustment.solution import Solution, TrainingRecord
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.geometry import Array, nearest_rotation
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.local_minima import (
    better_by_view,
    reaches_bound,
    refuse_mirrored,
    short_of_bound,
    try_mirrored,
    try_start,
)
from neurocal_cli.network.network import Patterns, Task, patterns_of
from neurocal_cli.network.options import MOST_POINTS, Options
from neurocal_cli.network.orthogonality import cameras_from_products, candidate_intrinsics
from neurocal_cli.network.starts import find_camera, find_poses, learn
from neurocal_cli.network.view_networks import (
    Group,
    begin_flat,
    radial_step,
    refuse_few_conditions,
    train_networks,
)

# Repeated by test_convergence.py: its scenes with hardly more equations than unknowns need up to 100
# starts.
_FEW_POINT_STARTS = 100
# Initial damping of the first bundle adjustment from a pinhole, and from a camera near the minimum.
_FAR, _NEAR = OPTIONS.damping, 1e-7
_MANY_EQUATIONS = 12  # with so many more equations than unknowns there is only one good minimum
# Type 4 with a wide lens: least depth of a training point as a share of its distance (60 degrees from the
# axis), and fewest training points.
_LEAST_DEPTH, _FEWEST = 0.5, 12

_Begun = tuple[Adjusted, TrainingRecord]


def solve(problem: Problem, options: Options) -> Solution:
    """Estimate a camera and its poses from random weights.

    Raises DegenerateGeometryError if the views do not determine the unknowns.
    """
    rng = np.random.default_rng(options.seed)
    if problem.type == 4:
        return solve_given_poses(problem, options, rng)
    # A free product needs 4 points of a plane or 6 in space.
    able = np.asarray(problem.views.distinct >= np.where(begin_flat(problem), 4, 6))
    if problem.type == 3:
        adjusted, record = _poses(problem, options, rng, able)
    elif able.all():
        adjusted, record = _camera_and_poses(problem, options, rng)
    elif problem.views.n_views == 1:
        adjusted, record = _camera_from_few_points(problem, options, rng)
    else:
        adjusted, record = _camera_then_other_poses(problem, options, rng, able)
    options.progress("refining", 1.0)
    return Solution(problem, adjusted, record)


def _camera_and_poses(problem: Problem, options: Options, rng: np.random.Generator) -> _Begun:
    """Types 1 and 2."""
    every = np.ones(problem.views.n_views, dtype=bool)
    groups, record = train_networks(problem, options, rng, every)
    refuse_few_conditions(problem, groups)
    # The paper's constrained training needs the networks as they are.
    bend = radial_step(problem, groups) if options.constrained is None else None
    products = groups if bend is None else bend.groups

    def camera(entries: Array) -> CameraState:
        pinhole = cameras_from_products(problem, products, entries)
        return pinhole if bend is None else bend.bent(pinhole, problem.distortion.model)

    first, *others = candidate_intrinsics(problem, products, rng)
    state, record = _constrained(problem, options, camera(first), record)
    best, record = _refined(problem, options, state, record, _FAR if bend is None else _NEAR)
    for entries in others:
        if reaches_bound(problem, best, groups):
            break
        best = try_start(problem, best, camera(entries))
    best = try_mirrored(problem, best)
    if problem.views.n_views == 1:
        # One view: random cameras as well, if equations are scarce or the bound is not reached.
        spare = 2 * int(problem.views.distinct.sum()) - problem.n_parameters
        if spare < _MANY_EQUATIONS or not reaches_bound(problem, best, groups):
            found = find_camera(problem.views, problem.normalised_entries, problem.free, rng, options.starts)
            if found is not None:
                record = replace(record, starts=record.starts + found.starts)
                best = try_start(problem, best, found.state)
    refuse_mirrored(problem, best, groups)
    late = record.agreed < 2
    if late.any() and 2 * late.sum() < len(late):
        # Noise in few points can have a product that puts some of them behind the camera; the camera of the
        # other views then finds the pose.
        state, record = _with_random_poses(problem.views, best.state, record, late, rng, options.starts)
        best = try_start(problem, best, state)
    return best, record


def _camera_from_few_points(problem: Problem, options: Options, rng: np.random.Generator) -> _Begun:
    """Type 2 with one view of 5 points: random cameras instead of a free product."""
    many = max(options.starts, _FEW_POINT_STARTS)
    found = find_camera(problem.views, problem.normalised_entries, problem.free, rng, many)
    if found is None:
        raise DegenerateGeometryError(
            f"no random start found a camera for these {len(problem.views.index)} points; give more points"
        )
    record = TrainingRecord.empty(1)
    record = record.with_starts(np.array([0]), found.agreed, found.starts, found.iterations)
    return _refined(problem, options, found.state, record)


def _camera_then_other_poses(
    problem: Problem, options: Options, rng: np.random.Generator, able: NDArray[np.bool_]
) -> _Begun:
    """Types 1 and 2 with some views of too few points, which are added once the others determine W."""
    views = problem.views
    if not able.any():
        raise DegenerateGeometryError(
            f"no view has enough different points by itself (view {views.names[0]!r} has "
            f"{views.distinct[0]}); give at least one view with 6, or 4 on a flat board"
        )
    members = np.flatnonzero(able)
    part = replace(problem, views=views.subset(members))
    adjusted, record = _camera_and_poses(part, options, rng)
    agreed = np.zeros(views.n_views, dtype=np.int64)
    agreed[members] = record.agreed
    R, t = np.zeros((views.n_views, 3, 3)), np.zeros((views.n_views, 3))
    R[members], t[members] = adjusted.state.R, adjusted.state.t
    state, record = _with_random_poses(
        views, replace(adjusted.state, R=R, t=t), replace(record, agreed=agreed), ~able, rng,
        max(options.starts, _FEW_POINT_STARTS),
    )  # fmt: skip
    return try_mirrored(problem, problem.adjust(replace(adjusted, state=state))), record


def _poses(problem: Problem, options: Options, rng: np.random.Generator, able: NDArray[np.bool_]) -> _Begun:
    """Type 3: each view's pose by itself."""
    views = problem.views
    groups: list[Group] = []
    record = TrainingRecord.empty(views.n_views)
    if able.any():
        groups, record = train_networks(problem, options, rng, able)
    state = cameras_from_products(problem, groups, problem.normalised_entries[None])
    many = max(options.starts, _FEW_POINT_STARTS)
    state, record = _with_random_poses(views, state, record, ~able, rng, many)
    state, record = _constrained(problem, options, state, record)
    best, record = _refined(problem, options, state, record)
    best = try_mirrored(problem, best)
    late = short_of_bound(problem, best, groups) | (able & (record.agreed < 2))
    if late.any():
        state, record = _with_random_poses(views, best.state, record, late, rng, options.starts)
        best = better_by_view(problem, best, problem.adjust(state))
    refuse_mirrored(problem, best, groups)
    return best, record


def _constrained(
    problem: Problem, options: Options, state: CameraState, record: TrainingRecord
) -> tuple[CameraState, TrainingRecord]:
    """The paper's constrained training of one view's network, eq. (14), for trainers that support it.

    It starts from an upper triangular W and an orthonormal V, into which the free network's product has been
    split; from random weights it would stall. Training follows eq. (15), with W's structural zeros and given
    weights fixed and beta E_orth added to the error. A flat board's V cannot be constrained. The state is
    unchanged if the result is no valid camera.
    """
    views = problem.views
    if options.constrained is None or views.n_views > 1 or views.nearly_flat[0]:
        return state, record
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
    usable = np.isfinite(entries).all() and entries[[0, 2]].min() > 0 and t[0, 2] > 0
    record = replace(record, iterations=record.iterations + int(trained.iterations.sum()))
    return CameraState(entries[None], R, t) if usable else state, record


def _refined(
    problem: Problem, options: Options, state: CameraState, record: TrainingRecord, damping: float = _FAR
) -> _Begun:
    """First bundle adjustment; the error of its start is recorded."""
    options.progress("refining", 0.0)
    adjusted = problem.adjust(state, damping=damping)
    before = adjusted.before
    if problem.views.whitening is not None:
        before = float((point_residuals(problem.views, state) ** 2).sum())
    return adjusted, replace(record, before=before)


def _with_random_poses(
    views: Views,
    state: CameraState,
    record: TrainingRecord,
    which: NDArray[np.bool_],
    rng: np.random.Generator,
    starts: int,
) -> tuple[CameraState, TrainingRecord]:
    """The state with some views' poses found from random rotations."""
    members = np.flatnonzero(which)
    if not members.size:
        return state, record
    found = find_poses(views, members, state.entries, rng, starts)
    R, t = state.R.copy(), state.t.copy()
    R[members], t[members] = found.state.R, found.state.t
    record = record.with_starts(members, found.agreed, found.starts, found.iterations)
    return replace(state, R=R, t=t), record


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

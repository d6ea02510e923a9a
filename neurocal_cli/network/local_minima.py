"""Test whether a minimum is the global one, and try other starts if not.

A free network has more freedom than a camera, so its pixel error is a lower bound for the camera's. A camera
that reaches the bound up to noise is at the global minimum. Otherwise other starts are tried: other
intrinsics, the mirrored pose of a flat board, random cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import Adjusted, SecondPoses, adjust
from neurocal_cli.adjustment.cross_validation import reduced, solve_or_nan
from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.reprojection import squared_errors
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.errors import DegenerateGeometryError
from neurocal_cli.network.view_networks import Group

# Repeated by test_convergence.py (1000 solid and 300 flat scenes, three seeds) and
# test_refusals.py: no start that won there was behind after so many steps, no mirrored pose won from
# beyond this range, and no correct data were called mirrored.
_TRIAL_STEPS = 15  # another start must be better after so many steps
# Further steps of a mirrored pose, and how many times the other's its rms error may be after them.
_FLIP_RANGES = ((0, 10.0), (3, 2.0), (200, 2.0))
_SAME = 1e-4  # rotations whose entries differ by less are of one minimum
_FLIPS, _FLIPS_WITH_CAMERA = 12, 3  # rounds of flipping poses, and views tried in each
# Data count as mirrored if a mirrored camera's rms error is so many times lower, with at least so many
# points, so that it is not by chance.
_MIRRORED_BETTER, _MIRRORED_POINTS = 3.0, 12
_FREEDOM = {True: 8, False: 11}  # degrees of freedom of the product of a flat (True) or a solid view


class OnlyMirroredError(DegenerateGeometryError):
    """A free network fits the points well only as a mirrored camera; strong distortion can cause it, too."""


def reaches_bound(problem: Problem, adjusted: Adjusted, groups: Sequence[Group]) -> bool:
    """Whether the camera fits as well as the free networks, up to noise."""
    bound = sum(float(g.bound.sum()) for g in groups)
    freedom = sum(len(g.views) * _FREEDOM[g.flat] for g in groups)
    conditions = freedom - problem.n_parameters
    return bool(_explained(adjusted.cost.sum(), bound, conditions, problem.views.n_equations - freedom))


def short_of_bound(problem: Problem, adjusted: Adjusted, groups: Sequence[Group]) -> NDArray[np.bool_]:
    """(V,) views of given intrinsics (type 3) whose pose does not fit as well as their network."""
    short = np.zeros(problem.views.n_views, dtype=bool)
    for group in groups:
        freedom = _FREEDOM[group.flat]
        spare = problem.views.equations[group.views] - freedom
        short[group.views] = ~_explained(adjusted.cost[group.views], group.bound, freedom - 6, spare)
    return short


def _explained(cost: Array, bound: Array | float, conditions: int, spare: Array | float) -> NDArray[np.bool_]:
    """Whether the excess over the bound is what `conditions` constraints cost under noise.

    The excess over the residual variance has a chi-squared distribution; the limit is its mean plus six
    standard deviations.
    """
    limit = conditions + 6 * np.sqrt(2.0 * max(conditions, 1)) + 10
    variance = np.where(np.greater(spare, 0), np.asarray(bound) / np.maximum(spare, 1), 0.0)
    return np.asarray(cost <= bound * (1 + 1e-9) + 1e-20 + limit * variance)


def refuse_mirrored(problem: Problem, adjusted: Adjusted, groups: Sequence[Group]) -> None:
    """Refuse points in space that a free network fits well only as a mirrored camera.

    Raises OnlyMirroredError. Causes are a left-handed X,Y,Z, two swapped columns, or v pointing upwards.
    """
    for group in groups:
        if group.flat:
            continue
        # The normalised origin is the points' centroid, which lies in front if the sign of P is right.
        mirrored = np.linalg.det(group.product[:, :, :3]) * group.product[:, 2, 3] < 0
        mirrored &= adjusted.cost[group.views] > _MIRRORED_BETTER**2 * group.bound + 1e-20
        mirrored &= problem.views.distinct[group.views] >= _MIRRORED_POINTS
        if mirrored.any():
            name = problem.views.names[group.views[int(np.argmax(mirrored))]]
            raise OnlyMirroredError(
                f"view {name!r}: only a mirrored camera "
                "could see these points; check the axes of X,Y,Z (right-handed?) and of u,v (v downwards?)"
            )


def try_start(problem: Problem, best: Adjusted, state: CameraState) -> Adjusted:
    """The better of a result and that of another start, which must be better after a few steps."""
    trial = problem.adjust(state, _TRIAL_STEPS)
    if trial.cost.sum() >= best.cost.sum():
        return best
    return trial if trial.converged else problem.adjust(trial)


def better_by_view(problem: Problem, one: Adjusted, two: Adjusted) -> Adjusted:
    """The better of two results for each view; for independent views (type 3)."""
    better = two.cost < one.cost
    R = np.where(better[:, None, None], two.state.R, one.state.R)
    t = np.where(better[:, None], two.state.t, one.state.t)
    return problem.adjust(replace(one, state=replace(one.state, R=R, t=t)))


def try_mirrored(problem: Problem, adjusted: Adjusted) -> Adjusted:
    """Try the mirrored pose of each flat view: far boards have a second pose that fits nearly as well.

    First, all views whose mirrored pose fits better with the current camera are flipped at once. Then others
    are flipped one by one if all views together fit better with the camera adjusted to the flipped pose,
    because the current camera is biased towards the wrong pose. Given poses stay.
    """
    if not problem.free_poses:
        return adjusted
    for _ in range(_FLIPS):
        second = second_poses(problem, adjusted)
        better = second.posed.cost < adjusted.cost[second.views] * (1 - 1e-9)
        turned = _with_poses(problem, adjusted, second, better) if better.any() else None
        if turned is None:
            turned = _flip_with_camera(problem, adjusted, second)
        if turned is None:
            return replace(adjusted, second=second)
        adjusted = turned
    return adjusted


def second_poses(problem: Problem, adjusted: Adjusted) -> SecondPoses:
    """The views of flat targets whose mirrored pose fits nearly as well, and these poses."""
    views, state = problem.views, adjusted.state
    if adjusted.second is not None and adjusted.second.at is state:
        return adjusted.second
    candidates = np.flatnonzero(views.nearly_flat & problem.free_poses)
    R, t = state.R[candidates], state.t[candidates]
    mirrored = replace(state, R=_mirrored(R, t, views.basis[candidates]), t=t)
    unsettled, no_camera = np.zeros(len(candidates), dtype=bool), np.zeros(5 + len(state.k), dtype=bool)
    posed = Adjusted(mirrored, adjusted.normal[candidates], adjusted.cost[candidates], 0, unsettled)
    for steps, most in _FLIP_RANGES:
        if not candidates.size:
            break
        batches = (views if len(candidates) == views.n_views else views.subset(candidates)).batches
        if steps:
            posed = adjust(batches, posed.state, no_camera, max_iterations=steps)
        else:  # points behind the camera's plane lie far from their pixels, or are nan
            posed = replace(posed, cost=squared_errors(batches, posed.state))
        close = posed.cost < most**2 * adjusted.cost[candidates] + 1e-20
        close &= (np.abs(posed.state.R - state.R[candidates]) > _SAME).any(axis=(1, 2))
        candidates, posed = candidates[close], posed.of_views(close)
    return SecondPoses(state, candidates, posed)


def _flip_with_camera(problem: Problem, adjusted: Adjusted, second: SecondPoses) -> Adjusted | None:
    """Flip the view with the largest predicted gain if the camera is adjusted, too; None if none improves."""
    views, posed = second.views, second.posed
    if not views.size or not problem.free_camera.any() or problem.penalty is not None:
        return None
    free = problem.free if adjusted.state.model == "none" else problem.free_camera
    one, two = (reduced(normal, free, True) for normal in (adjusted.normal, posed.normal))
    S, g = one.S.sum(axis=0) - one.S[views] + two.S, one.g.sum(axis=0) - one.g[views] + two.g
    gain = (g * solve_or_nan(S, g)).sum(axis=1)
    promised = adjusted.cost.sum() - adjusted.cost[views] + posed.cost - gain
    order = np.argsort(promised)
    for place in order[:_FLIPS_WITH_CAMERA]:
        if not promised[place] < adjusted.cost.sum() * (1 - 1e-9):
            return None
        again = _with_poses(problem, adjusted, second, np.array([place]))
        if again is not None:
            return again
    return None


def _with_poses(
    problem: Problem, adjusted: Adjusted, second: SecondPoses, rows: NDArray[Any]
) -> Adjusted | None:
    """Adjust again with some of the second poses; None if that is no better."""
    state, views, posed = adjusted.state, second.views[rows], second.posed.state
    R, t = state.R.copy(), state.t.copy()
    R[views], t[views] = posed.R[rows], posed.t[rows]
    again = try_start(problem, adjusted, replace(state, R=R, t=t))
    return again if again.cost.sum() < adjusted.cost.sum() * (1 - 1e-9) else None


def _mirrored(R: Array, t: Array, basis: Array) -> Array:
    """The second pose of a far flat board: its depths mirrored along the viewing ray."""
    ray = t / np.linalg.norm(t, axis=1, keepdims=True)
    normal = basis[:, :, 2]
    across_ray = np.eye(3) - 2 * ray[:, :, None] * ray[:, None, :]
    across_plane = np.eye(3) - 2 * normal[:, :, None] * normal[:, None, :]
    return np.asarray(across_ray @ R @ across_plane)

"""The relative pose of two cameras, estimated from each pair of views separately.

Each camera alone gives the poses of its views. So every pair of views gives its own relative pose, with a
covariance. All are equal up to noise if the cameras are fixed to each other and the images of each pair were
taken at the same moment.

The model is linear around each camera's own result. Let d be the errors of both cameras' parameters, x the
step of the rig from a reference, and z_i the step of the relative pose of pair i from the same reference:

    z_i = x - D_i d + e_i,   cov(e_i) = C_i,

where D_i is the response of the views' poses to the cameras' parameters, and C_i the covariance of the
relative pose for given cameras. The information of each camera's views about d is a second sum of squares.
Together they are the cost of the common bundle adjustment beyond that of both cameras alone.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.leave_out import Quadratics
from neurocal_cli.adjustment.normal_equations import eliminate, solve_scaled
from neurocal_cli.adjustment.reprojection import POSE, camera_columns
from neurocal_cli.calibration.rig.problem import RigProblem, steps_through
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, rotation_vector
from neurocal_cli.camera.pinhole import Pose

_POSE = np.arange(POSE.start, POSE.stop)
_MUCH_LARGER = 2.0  # ratio of a view's variance to that of all; 50 equations reach it once in 10 million
_LEAST_NOISE = 1e-6  # normalised pixels; smaller noise is rounding, and a pixel is about 0.004


@frozen_dataclass(eq=False)
class RelativePoses:
    """Relative poses of P pairs of views, in order of their names, as linear functions of the unknowns.

    The F unknowns are the free parameters of the left camera, those of the right one, and the step of the
    rig: rotation [rad] and translation [`unit`].
    """

    problem: RigProblem
    names: tuple[tuple[str, str], ...]  # left and right name of each pair
    cameras: Quadratics  # information of each frame's views about the cameras alone, V groups
    pairs: Quadratics  # the cost of the common fit beyond that of the cameras alone, P groups
    frame: NDArray[np.intp]  # (P,) of each pair
    rig: NDArray[np.intp]  # (6,) columns of the rig's step
    offset: Array  # (P, 6) z
    design: Array  # (P, 6, F) of z by the unknowns
    covariance: Array  # (P, 6, 6) C
    n_equations: Array  # (P,) of both views of each pair

    @property
    def unit(self) -> float:
        """Unit of the rig's translation [world unit]."""
        return self.problem.unit

    def __len__(self) -> int:
        return len(self.names)

    def normal(self, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Normal matrix (F, F) and right side (F,) of the common fit of some pairs, (P,) bool."""
        S = self.cameras.S.sum(axis=0) + self.pairs.S[used].sum(axis=0)
        return S, self.cameras.g.sum(axis=0) + self.pairs.g[used].sum(axis=0)

    def solution(self, used: NDArray[np.bool_]) -> Array:
        """(F,) unknowns of the common fit of some pairs."""
        S, g = self.normal(used)
        return np.asarray(solve_scaled(S, g[:, None])[:, 0])


def relative_poses(problem: RigProblem, reference: Pose) -> RelativePoses | None:
    """Relative poses of all pairs of a problem; None if a view does not determine its pose.

    The cameras need not be at their own minimum; one step leads there. `reference` is a rig near those of
    most pairs.
    """
    sides = [_Alone(problem, side) for side in (0, 1)]
    if not all(side.determined for side in sides):
        return None
    names = in_order(problem.pairs)
    place = {pair: k for k, pair in enumerate(problem.pairs)}
    order = np.array([place[pair] for pair in names], dtype=np.intp)
    first, second = problem.paired_left[order], problem.paired_right[order]
    left, right = problem.cameras
    frame = problem.paired[order]
    size = problem.scale[frame]
    scale = size / problem.unit
    R = right.R[second] @ np.swapaxes(left.R[first], 1, 2)
    centre = (R @ left.t[first][..., None])[..., 0]
    t = scale[:, None] * (right.t[second] - centre)
    offset = np.concatenate([rotation_vector(R @ reference.R.T), t - reference.t / problem.unit], axis=1)
    by_rig, by_pose = steps_through(R, centre, 1.0 / scale)
    of_right = np.asarray(np.linalg.inv(by_rig), dtype=float)
    of_left = -of_right @ by_pose
    covariance = _transformed(of_right, sides[1].covariance[second])
    covariance += _transformed(of_left, sides[0].covariance[first])
    offset += (of_right @ sides[1].step[second][..., None] + of_left @ sides[0].step[first][..., None])[
        ..., 0
    ]
    n_left, n_right = (int(side.sum()) for side in problem.estimated)
    columns = np.arange(n_left + n_right + 6)
    places, rig = (columns[:n_left], columns[n_left:-6]), columns[-6:]
    design = np.zeros((len(order), 6, len(columns)))
    design[:, :, places[0]] = of_left @ sides[0].follow[first]
    design[:, :, places[1]] = of_right @ sides[1].follow[second]
    design[:, :, rig] = np.eye(6)
    weight = np.linalg.inv(covariance)
    weighted = np.swapaxes(design, 1, 2) @ weight
    cost = np.einsum("pi,pij,pj->p", offset, weight, offset)
    pairs = Quadratics(weighted @ design, (weighted @ offset[..., None])[..., 0], cost)
    counts = [observed.equations_by_view for observed in problem.observations]
    return RelativePoses(
        problem=problem,
        names=tuple(names),
        cameras=_both(problem, sides, places, len(columns)),
        pairs=pairs,
        frame=frame,
        rig=rig,
        offset=offset,
        design=design,
        covariance=covariance,
        n_equations=counts[0][first] + counts[1][second],
    )


class _Alone:
    """One camera alone: the poses of its views at its minimum, and their response to its parameters."""

    def __init__(self, problem: RigProblem, side: int) -> None:
        observed, normal, free = problem.observations[side], problem.own_normal[side], problem.estimated[side]
        shared = camera_columns(len(free) - 5)[np.flatnonzero(free)]
        left, solved = eliminate(normal, np.append(shared, normal.shape[-1] - 1), _POSE)
        S, g, cost = left[:, :-1, :-1], left[:, :-1, -1], left[:, -1, -1]
        camera = solve_scaled(S.sum(axis=0), g.sum(axis=0)[:, None])[:, 0]
        self.spare = max(observed.n_equations - len(shared) - 6 * len(normal), 1.0)
        least = max(cost.sum() - g.sum(axis=0) @ camera, self.spare * observed.weight * _LEAST_NOISE**2)
        variance = least / self.spare
        self.follow, self.step = solved[..., :-1], solved[..., -1]
        own = np.linalg.pinv(normal[:, _POSE[:, None], _POSE], hermitian=True)
        larger = cost / (variance * np.maximum(observed.equations_by_view - len(_POSE), 1.0))
        # A view with a much larger error, for example of a board that bends, is more uncertain accordingly.
        times = np.where(larger > _MUCH_LARGER, larger, 1.0)[:, None, None]
        self.covariance = np.asarray(times * variance * own, dtype=float)
        self.quadratics = Quadratics(S / variance, g / variance, cost / variance)
        self.determined = bool(np.isfinite(solved).all() and np.isfinite(camera).all())


def _both(
    problem: RigProblem, sides: Sequence[_Alone], places: Sequence[NDArray[np.intp]], width: int
) -> Quadratics:
    """Information of the views of both cameras about the cameras, by frame."""
    n = len(problem.scale)
    S, g, cost = np.zeros((n, width, width)), np.zeros((n, width)), np.zeros(n)
    for side, place in enumerate(places):
        view, own = problem.observations[side].view, sides[side].quadratics
        S[view[:, None, None], place[:, None], place] += own.S
        g[view[:, None], place] += own.g
        cost[view] += own.cost
    return Quadratics(S, g, cost)


def _transformed(J: Array, covariance: Array) -> Array:
    return np.asarray(J @ covariance @ np.swapaxes(J, 1, 2))


def in_order(pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Pairs in order of their left names, in which numbers count as numbers."""
    return sorted(pairs, key=lambda pair: [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", pair[0])
    ])  # fmt: skip

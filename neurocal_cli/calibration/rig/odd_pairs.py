"""Pairs of views whose relative pose contradicts that of most others, by least trimmed squares.

The half of the pairs whose relative poses are nearest to one rig determines it; the others are judged by
their squared distance from it (Rousseeuw 1984).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.calibration.rig.adjust import RigFit
from neurocal_cli.calibration.rig.causes import MOVED_CAMERA
from neurocal_cli.calibration.rig.consensus import HYPOTHESES
from neurocal_cli.calibration.rig.problem import RigProblem
from neurocal_cli.calibration.rig.rivals import along, seen_by
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.pinhole import Pose

# The squared distance of a sound pair from the rig is a chi-squared variable of 6 degrees of freedom, whose
# median is 5.35. Real cameras deviate from their models, so the median distance of all pairs replaces it
# where it is larger. The limit of 60 has the probability 5e-11;
# test_a_pair_not_taken_at_the_same_moment_is_named has pairs on both sides.
MEDIAN = 5.35
SUSPECT = 60.0
# The distance must also exceed this multiple of the pair's equations: the pair's rms error is twice as large
# with the rig as without it.
_OWN_SHARE = 3.0
_MUCH_LARGER = 2.0  # ratio of a view's variance to that of all; 50 equations reach it once in 10 million
_STEPS = 10  # most concentration steps; fewer suffice


@frozen_dataclass(eq=False)
class RelativePoses:
    """Steps of the relative poses of P pairs from a rig, as linear functions of the unknowns.

    The f unknowns are the free parameters of both cameras and the step of the rig. With errors d of these,
    the pair's own step is `offset` - `design` d, with the given `covariance`.
    """

    offset: Array  # (P, 6)
    design: Array  # (P, 6, f)
    covariance: Array  # (P, 6, 6) for given cameras
    n_equations: Array  # (P,) of both views of each pair
    whole: Array  # (f + 1, f + 1) normal matrix of the common fit, bordered by the right side and the cost
    of_pairs: Array  # (P, f + 1, f + 1) what the tie of each pair adds to it

    def normal(self, used: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Normal matrix (f, f) and right side (f,) of the common fit of some pairs, (P,) bool."""
        M = self.whole - self.of_pairs[~used].sum(axis=0)
        return M[:-1, :-1], M[:-1, -1]


def relative_poses(problem: RigProblem, rig: Pose) -> RelativePoses | None:
    """Relative poses of all pairs of two cameras, by a rig near most; None if they are not determined.

    A view with a much larger error, for example of a board that bends, is more uncertain accordingly.
    """
    free, state = problem.estimated_shared, problem.start([rig])
    fit = RigFit(problem, free, state, problem.normal(state)[0], 0, True)
    shared = np.flatnonzero(free)
    arrow = fit.normal.only(shared)
    steps = MOVED_CAMERA.steps(fit, 1, None)
    A, X, r = along(arrow, problem.paired, [seen_by(fit, 1, shared)], [steps])
    bordered = np.concatenate([X, r[..., None]], axis=2)
    solved = solve_scaled(A, np.concatenate([bordered, np.broadcast_to(np.eye(6), A.shape)], axis=2))
    if not np.isfinite(solved).all():
        return None
    sides = zip(problem.observations, problem.own_normal, strict=True)
    counts = [seen.equations_by_view for seen in problem.observations]
    larger = [own[:, -1, -1] / np.maximum(seen.equations_by_view - 6, 1.0) for seen, own in sides]
    left, right = problem.paired_left, problem.paired_right
    times = np.maximum(larger[0][left], larger[1][right])
    times = np.where(times > _MUCH_LARGER, times, 1.0)[:, None, None]
    return RelativePoses(
        solved[..., -7], solved[..., :-7], times * solved[..., -6:], counts[0][left] + counts[1][right],
        arrow.reduced()[0], np.swapaxes(bordered, 1, 2) @ solved[..., :-6],
    )  # fmt: skip


def odd_pairs(poses: RelativePoses, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pairs that contradict most of the used ones, (P,) bool; none where there is no majority."""
    none = np.zeros(len(poses.offset), dtype=bool)
    places = np.flatnonzero(used)
    if len(places) < 3:
        return none
    starts = places[np.unique(np.linspace(0, len(places) - 1, min(len(places), HYPOTHESES)).astype(int))]
    best, lowest = none, np.inf
    for start in starts:
        total, core = _concentrated(poses, places, start)
        if total < lowest:
            best, lowest = core, total
    for _ in range(_STEPS):
        distance = _predicted(poses, best)
        limit = SUSPECT * max(1.0, float(median(distance[places])) / MEDIAN)
        odd = used & (distance > limit) & (distance > _OWN_SHARE * poses.n_equations)
        if (best == (used & ~odd)).all():
            break
        best = used & ~odd
    return odd if 2 * odd.sum() < len(places) else none


def _concentrated(
    poses: RelativePoses, places: NDArray[np.intp], start: int
) -> tuple[float, NDArray[np.bool_]]:
    """The half of the pairs that is nearest to its own rig, and the sum of its squared distances from it.

    The search begins with the pairs nearest to one of them, and ends when the half stays the same.
    """
    half = len(places) // 2 + 1
    apart = poses.offset - poses.offset[start]
    together = poses.covariance + poses.covariance[start]
    distance = np.asarray((apart * np.linalg.solve(together, apart[..., None])[..., 0]).sum(axis=1))
    core = np.zeros(len(poses.offset), dtype=bool)
    for _ in range(_STEPS):
        nearest = np.zeros_like(core)
        nearest[places[np.argsort(distance[places], kind="stable")[:half]]] = True
        if (nearest == core).all():
            break
        core = nearest
        distance = _predicted(poses, core)
    return float(np.sort(distance[places])[:half].sum()), core


def _predicted(poses: RelativePoses, core: NDArray[np.bool_]) -> Array:
    """(P,) squared distances from the rig of some pairs; of the others, with the uncertainty of that rig.

    Few pairs determine the rig poorly, because errors of both cameras bias it. Without this uncertainty,
    sound pairs might seem far off.
    """
    S, g = poses.normal(core)
    solved = solve_scaled(S, np.column_stack([np.eye(len(S)), g]))
    apart = poses.offset - poses.design @ solved[:, -1]
    spread = poses.design @ solved[:, :-1] @ np.swapaxes(poses.design, 1, 2)
    covariance = poses.covariance + np.where(core[:, None, None], 0.0, spread)
    return np.asarray((apart * solve_scaled(covariance, apart[..., None])[..., 0]).sum(axis=1))

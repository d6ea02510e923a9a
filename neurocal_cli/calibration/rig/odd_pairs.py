"""Pairs of views whose relative pose contradicts that of most others, by least trimmed squares.

The half of the pairs whose relative poses are nearest to one rig determines it; the others are judged by
their squared distance from it (Rousseeuw 1984).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.calibration.rig.relative_poses import RelativePoses
from neurocal_cli.camera.geometry import Array, median

# The squared distance of a sound pair from the rig is a chi-squared variable of 6 degrees of freedom, whose
# median is 5.35. Real cameras deviate from their models, so the median distance of all pairs replaces it
# where it is larger. The limit of 60 has the probability 5e-11;
# test_a_pair_not_taken_at_the_same_moment_is_named has pairs on both sides.
MEDIAN = 5.35
SUSPECT = 60.0
# The distance must also exceed this multiple of the pair's equations: the pair's rms error is twice as large
# with the rig as without it.
_OWN_SHARE = 3.0
_MOST_STARTS = 40
_STEPS = 10  # most concentration steps; fewer suffice


def odd_pairs(poses: RelativePoses, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pairs that contradict most of the used ones, (P,) bool; none where there is no majority."""
    none = np.zeros(len(poses), dtype=bool)
    places = np.flatnonzero(used)
    if len(places) < 3:
        return none
    starts = places[np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_STARTS)).astype(int))]
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
    core = np.zeros(len(poses), dtype=bool)
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

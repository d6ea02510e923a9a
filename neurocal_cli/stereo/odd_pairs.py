"""Pairs of views whose relative pose contradicts that of most pairs, by least trimmed squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.normal_equations import solve_scaled
from neurocal_cli.median import median
from neurocal_cli.stereo.relative_poses import RelativePoses

# The squared distance of a sound pair from the rig is a chi-squared variable of 6 degrees of freedom, whose
# median is 5.35. Real cameras deviate from their models, so the median distance of all pairs replaces it
# where it is larger. The limit of 60 has the probability 5e-11;
# test_a_pair_not_taken_at_the_same_moment_is_named has pairs on both sides.
_MEDIAN = 5.35
_SUSPECT = 60.0
# The distance must also exceed this multiple of the pair's equations: the pair's rms error is twice as large
# with the rig as without it.
_OWN_SHARE = 3.0
_MOST_STARTS = 40
_STEPS = 10  # most concentration steps; fewer suffice


def odd_pairs(poses: RelativePoses, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the pairs that contradict most of the used ones, (P,) bool; none where there is no majority."""
    none = np.zeros(len(poses), dtype=bool)
    places = np.flatnonzero(used)
    half = len(places) // 2 + 1
    if len(places) < 3:
        return none
    starts = places[np.unique(np.linspace(0, len(places) - 1, min(len(places), _MOST_STARTS)).astype(int))]
    best, lowest = none, np.inf
    for start in starts:
        distance, core = _concentrated(poses, places, half, _from_one(poses, start))
        sum_of_core = float(np.sort(distance[places])[:half].sum())
        if sum_of_core < lowest:
            best, lowest = core, sum_of_core
    for _ in range(_STEPS):
        distance = _predicted(poses, best)
        limit = _SUSPECT * max(1.0, float(median(distance[places])) / _MEDIAN)
        odd = used & (distance > limit) & (distance > _OWN_SHARE * poses.n_equations)
        if (best == (used & ~odd)).all():
            break
        best = used & ~odd
    return odd if 2 * odd.sum() < len(places) else none


def _from_one(poses: RelativePoses, start: int) -> Array:
    """(P,) squared distances of all relative poses from that of one pair."""
    apart = poses.offset - poses.offset[start]
    together = poses.covariance + poses.covariance[start]
    return np.asarray((apart * np.linalg.solve(together, apart[..., None])[..., 0]).sum(axis=1))


def _concentrated(
    poses: RelativePoses, places: NDArray[np.intp], half: int, distance: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Distances from the rig of the nearest half of the pairs, repeated until that half stays the same."""
    core = np.zeros(len(poses), dtype=bool)
    for _ in range(_STEPS):
        nearest = np.zeros_like(core)
        nearest[places[np.argsort(distance[places], kind="stable")[:half]]] = True
        if (nearest == core).all():
            break
        core = nearest
        distance = _predicted(poses, core)
    return distance, core


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

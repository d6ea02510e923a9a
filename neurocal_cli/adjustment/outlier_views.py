"""Outlier views: whole views that contradict the others, although their own points are consistent.

Such a view comes from another camera (another zoom, another picture size), or its target has wrong world
coordinates: points in the wrong order, mirrored, or with the wrong size of square.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import Quadratics, inverse_or_nan, reduced
from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.adjustment.reprojection import POSE
from neurocal_cli.adjustment.solution import Solution
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.geometry import Array, median
from neurocal_cli.camera.state import CameraState

# Repeated by test_outlier_rejection.py (slow: 105 sets with one wrong view, all found; 200 clean ones,
# none blamed) and test_multi_start.py (1000 clean sets under strong distortion, no view blamed).
_FEWEST = 4  # fewest views, so that the others outvote one
_MOVES = 2.5  # leaving a view out must move some shared parameter by at least this many standard deviations
OUTLIER = 25.0
"""Least contradiction of an outlier view, times that which noise causes, and that of the other views."""
_STEPS = 60
# Steps of a view's own camera, from the common one. A flat view with distortion has a long valley: 60 steps
# end up to 0.6 % above the rms error of hundreds of steps; one step and the minimum of its quadratic model
# come within 0.5 % of it if the common camera is right. test_free_networks.py repeats it.
_FREE_STEPS = 1
_UNSEEN = 1e-9  # ridge on a unit diagonal, against steps in undetermined directions
_SAME_PLANE = 1e-3


def find_outlier_view(solution: Solution) -> str | None:
    """The view that contradicts the others most, or None if no view is an outlier.

    The contradiction of a view is the drop in squared error if the view had its own camera, per condition
    that the common camera imposes on it, in units of the noise variance. Noise alone gives 1. On real boards,
    which are not quite flat, every view has some tens; an outlier must stand out from the other views.
    """
    problem, adjusted = solution.problem, solution.adjusted
    views = problem.views
    V = views.n_views
    if V < _FEWEST or problem.type == 3 or not problem.free_poses:
        return None
    quadratics = reduced(adjusted.normal, problem.free_of_prior, problem.free_poses)
    spare = views.n_equations - problem.n_parameters
    if _largest_move(quadratics, float(adjusted.cost.sum()) / max(spare, 1)) < _MOVES:
        return None
    conditions = conditions_on_views(views, adjusted.state)
    own = free_networks(views, adjusted.state, _STEPS)
    own_spare = views.equations - 6 - conditions
    if own_spare.min() <= 0:
        return None
    variance = float(median(own / own_spare)) + 1e-24
    contradiction = _contradictions(quadratics, own, conditions) / variance
    view = int(np.argmax(contradiction))
    if not contradiction[view] > OUTLIER:
        return None
    rest = np.delete(np.arange(V), view)
    others = adjust(
        views.subset(rest).batches, adjusted.state.of_views(rest), problem.free_of_prior, True, _STEPS
    )
    left = reduced(others.normal, problem.free_of_prior, True)
    among = float(median(_contradictions(left, own[rest], conditions[rest]))) / variance
    return views.names[view] if contradiction[view] > OUTLIER * max(among, 1.0) else None


def _largest_move(q: Quadratics, variance: float) -> float:
    """Largest move of a shared parameter when one view is left out, in standard deviations."""
    S = q.S.sum(axis=0)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.abs(np.diagonal(inverse_or_nan(S))) * variance)
        moves = np.abs(q.moves_without_each()) / std
    return float(np.where(np.isfinite(moves), moves, np.inf).max(initial=0.0))


def _contradictions(q: Quadratics, own: Array, conditions: NDArray[np.intp]) -> Array:
    """(V,) drop in squared error if each view had its own camera, per condition."""
    with np.errstate(invalid="ignore"):
        spared = q.cost.sum() - q.cost_without_each() - own
    return np.asarray(np.where(np.isfinite(spared), spared, 0.0) / conditions)


def conditions_on_views(views: Views, state: CameraState) -> NDArray[np.intp]:
    """(V,) number of conditions that a common camera imposes on the network of each view.

    Of the network's eleven parameters a flat target determines eight, or all if seen through a wide lens.
    """
    flat = views.nearly_flat & (state.model not in WIDE)
    return np.where(flat, 2, 5)


def free_networks(views: Views, state: CameraState, steps: int = _FREE_STEPS) -> Array:
    """(V,) squared reprojection error of each view with a camera of its own and the common distortion.

    Its eleven parameters are as free as the network's product W V. No camera common to all views can have a
    smaller error, so this measures the precision of the points themselves.
    """
    own = CameraState(np.repeat(state.entries, views.n_views, axis=0), state.R, state.t, state.model, state.k)
    free = np.concatenate([np.ones(5, dtype=bool), np.zeros(len(state.k), dtype=bool)])
    return least_of_free_networks(adjust(views.batches, own, free, True, steps).normal)


def least_of_free_networks(normal: Array) -> Array:
    """The same from the quadratic model at a state: normal (V, 12 + K, 12 + K) to squared errors (V,)."""
    H, g = normal[:, : POSE.stop, : POSE.stop], normal[:, : POSE.stop, -1]
    H = H * (1.0 + _UNSEEN * np.eye(POSE.stop))
    gain = (g * solve_scaled(H, g[..., None])[..., 0]).sum(axis=1)
    return np.asarray(np.maximum(normal[:, -1, -1] - gain, 0.0))


def seen_from_behind(views: Views, state: CameraState) -> list[str]:
    """Names of the views that seem to show a flat target from behind.

    A board is opaque, so the points of these views (or of all others) are mirrored.
    """
    if views.n_views < _FEWEST or not views.nearly_flat.all():
        return []
    normal = views.basis[:, :, 2] * np.sign(views.basis[:, :, 2] @ views.basis[0, :, 2])[:, None]
    if np.abs(normal - normal[0]).max() > _SAME_PLANE:
        return []
    # The centroid lies along t: its sign tells on which side of the plane the camera is.
    side = ((state.R @ normal[..., None])[..., 0] * state.t).sum(axis=1)
    behind = (side < 0) != (np.sign(side).sum() < 0)
    return [views.names[k] for k in np.flatnonzero(behind)]


def variance_of_views(views: Views, state: CameraState) -> float:
    """Variance of the residuals with a separate camera for each view, normalised."""
    unknowns = int((6 + conditions_on_views(views, state)).sum())
    return float(free_networks(views, state).sum()) / max(views.n_equations - unknowns, 1)

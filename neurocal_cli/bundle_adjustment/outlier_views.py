"""Views that contradict the others as wholes, though their own points agree with each other.

Such a view is of another camera (another zoom, another picture size), or of a target whose points are
not where its world coordinates say: read in the wrong order, mirrored, with the wrong size of square.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.adjust import adjust
from neurocal_cli.bundle_adjustment.cross_validation import reduced
from neurocal_cli.bundle_adjustment.reprojection import POSE, CameraState
from neurocal_cli.bundle_adjustment.solution import Solution
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.geometry import Array
from neurocal_cli.least_squares.leave_out import Quadratics, inverse_or_nan
from neurocal_cli.least_squares.normal_equations import solve_scaled
from neurocal_cli.median import median

# Repeated by tests/test_outlier_rejection.py (slow: 105 sets with one wrong view, all found; 200 clean ones,
# none blamed) and tests/test_multi_start.py (1000 clean sets under strong distortion, no view blamed).
_FEWEST = 4  # views, of which the others must outvote one
_MOVES = 2.5  # standard deviations of any shared parameter that leaving a view out must move
_OUTLIER = 25.0  # times what noise, and what the others contradict each other by
_STEPS = 60
# Of a free camera, from the common one. A flat view under distortion has a long valley: 60 steps end up to
# 0.6 % above the rms error of hundreds, one step and the minimum of its quadratic within 0.5 % of it where
# the common camera is right; tests/test_free_networks.py repeats it.
_FREE_STEPS = 1
_UNSEEN = 1e-9  # added to a unit diagonal: directions that the points do not tell are not followed
_SAME_PLANE = 1e-3


def find_outlier_view(solution: Solution) -> str | None:
    """The view that contradicts the others most, if any does.

    By how much is measured by the squared error that it would spare if it had a camera of its own,
    for each of the conditions that the common camera puts on it, in units of the noise's variance: 1
    for noise alone. On real boards, which are not quite flat, it is some tens for every view; an
    outlier's stands out from the others'.
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
    if not contradiction[view] > _OUTLIER:
        return None
    rest = np.delete(np.arange(V), view)
    others = adjust(
        views.subset(rest).batches, _of(adjusted.state, rest), problem.free_of_prior, True, _STEPS
    )
    left = reduced(others.normal, problem.free_of_prior, True)
    among = float(median(_contradictions(left, own[rest], conditions[rest]))) / variance
    return views.names[view] if contradiction[view] > _OUTLIER * max(among, 1.0) else None


def _largest_move(q: Quadratics, variance: float) -> float:
    """Most standard deviations by which leaving one view out moves a shared parameter."""
    S = q.S.sum(axis=0)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.abs(np.diagonal(inverse_or_nan(S))) * variance)
        moves = np.abs(q.moves_without_each()) / std
    return float(np.where(np.isfinite(moves), moves, np.inf).max(initial=0.0))


def _contradictions(q: Quadratics, own: Array, conditions: NDArray[np.intp]) -> Array:
    """(V,) squared error that each view would spare with a camera of its own, by condition."""
    with np.errstate(invalid="ignore"):
        spared = q.cost.sum() - q.cost_without_each() - own
    return np.asarray(np.where(np.isfinite(spared), spared, 0.0) / conditions)


def _of(state: CameraState, views: NDArray[np.intp]) -> CameraState:
    return CameraState(state.entries, state.R[views], state.t[views], state.model, state.k)


def conditions_on_views(views: Views, state: CameraState) -> NDArray[np.intp]:
    """(V,) conditions that a common camera puts on the network of each view.

    Of its eleven parameters a flat target determines eight; seen through a wide lens, all.
    """
    flat = views.nearly_flat & (state.model not in WIDE)
    return np.where(flat, 2, 5)


def free_networks(views: Views, state: CameraState, steps: int = _FREE_STEPS) -> Array:
    """Squared reprojection error of a free camera for each view, with the distortion as it is; (V,).

    Eleven parameters for each view are as free as its product W V: what no camera common to all the
    views can go below, and so the precision of the points themselves.
    """
    own = CameraState(np.repeat(state.entries, views.n_views, axis=0), state.R, state.t, state.model, state.k)
    free = np.concatenate([np.ones(5, dtype=bool), np.zeros(len(state.k), dtype=bool)])
    return least_of_free_networks(adjust(views.batches, own, free, True, steps).normal)


def least_of_free_networks(normal: Array) -> Array:
    """The same by the quadratics at a state: normal matrices (V, 12 + K, 12 + K) to squared errors (V,)."""
    H, g = normal[:, : POSE.stop, : POSE.stop], normal[:, : POSE.stop, -1]
    H = H * (1.0 + _UNSEEN * np.eye(POSE.stop))
    gain = (g * solve_scaled(H, g[..., None])[..., 0]).sum(axis=1)
    return np.asarray(np.maximum(normal[:, -1, -1] - gain, 0.0))


def seen_from_behind(views: Views, state: CameraState) -> list[str]:
    """Views that show a flat target from the side that the other views do not show.

    Nobody sees through a board: its points are mirrored in those views (or in the others).
    """
    if views.n_views < _FEWEST or not views.nearly_flat.all():
        return []
    normal = views.basis[:, :, 2] * np.sign(views.basis[:, :, 2] @ views.basis[0, :, 2])[:, None]
    if np.abs(normal - normal[0]).max() > _SAME_PLANE:
        return []
    # The centroid lies along t: on which side of the plane is the camera?
    side = ((state.R @ normal[..., None])[..., 0] * state.t).sum(axis=1)
    behind = (side < 0) != (np.sign(side).sum() < 0)
    return [views.names[k] for k in np.flatnonzero(behind)]

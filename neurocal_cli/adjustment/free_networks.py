"""The least error of each view: that of a network, or camera, of its own.

No camera common to all views can have a smaller one, so it measures the precision of the points themselves,
and what a view has beyond it contradicts the other views.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.normal_equations import solve_scaled
from neurocal_cli.adjustment.reprojection import POSE
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

# Steps of a view's own camera, from the common one. A flat view with distortion has a long valley: 60 steps
# end up to 0.6 % above the rms error of hundreds of steps; one step and the minimum of its quadratic model
# come within 0.5 % of it if the common camera is right. test_free_networks.py repeats it.
_FREE_STEPS = 1
_FEWEST = 4  # fewest views that tell from which side a target is seen
_UNSEEN = 1e-9  # ridge on a unit diagonal, against steps in undetermined directions
_SAME_PLANE = 1e-3


def conditions_on_views(views: Views, state: CameraState) -> NDArray[np.intp]:
    """(V,) number of conditions that a common camera imposes on the network of each view.

    Of the network's eleven parameters a flat target determines eight, or all if the lens distorts it.
    """
    flat = views.nearly_flat & (state.model not in WIDE) & (not state.k.any())
    return np.where(flat, 2, 5)


def free_networks(views: Views, state: CameraState, steps: int = _FREE_STEPS) -> Array:
    """(V,) squared reprojection error of each view with a camera of its own and the distortion of the state.

    Its eleven parameters are as free as the network's product W V. No camera common to all views can have a
    smaller error, so this measures the precision of the points themselves.
    """
    entries = np.tile(state.entries, (views.n_views // len(state.entries), 1))
    own = CameraState(entries, state.R, state.t, state.model, state.k)
    free = np.concatenate([np.ones(5, dtype=bool), np.zeros(state.k.shape[-1], dtype=bool)])
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

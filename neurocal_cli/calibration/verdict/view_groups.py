"""Test whether the views come from two cameras, or from one whose focal length changes from view to view.

A common camera imposes conditions on the network of each view: two for a flat target, five for a solid one.
Their cost in squared error per condition, in units of the noise variance, is 1 for noise alone. If it is much
larger, the views are clustered as in k-means: each view is assigned to the better of two cameras, and both
cameras are adjusted to their views. If hardly more than noise remains, there are two cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.adjust import adjust
from neurocal_cli.adjustment.cross_validation import reduced
from neurocal_cli.adjustment.leave_out import Quadratics
from neurocal_cli.adjustment.outlier_views import conditions_on_views, free_networks
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState

# Cost per condition in units of the noise variance: least cost of a contradiction, and largest cost that may
# remain. Of 200 clean sets of 5 to 40 views none exceeds the first: test_view_groups.py repeats it.
_CONTRADICTS = 5.0
_NOISE = 4.0
_FEWEST = 2  # fewest views of a group
_SPARE = 4  # least excess of conditions over the parameters that explain them
_DIFFERENT = 0.01  # least difference, over the focal length
_STARTS = 20
_ROUNDS = 20
OWN_STEPS = 40  # steps of a separate camera for each view
_STEPS = 30
_ADJUSTED = 4  # clustering rounds with adjusted cameras, after those with the quadratic model


@frozen_dataclass(eq=False)
class ViewGroups:
    """Two cameras among the views, or a focal length for each view."""

    # The views of each camera, the smaller group first; empty if only the focal length changes.
    names: tuple[tuple[str, ...], tuple[str, ...]]
    cameras: Array  # (2, 5) [px] A11, A12, A22, A13 and A23 of both; nan if only the focal length changes
    scale: Array  # (V,) focal length of each view over the common one; empty if there are two cameras
    explained: float  # share of the squared error that this explains

    @property
    def apart(self) -> float:
        """Largest difference of the cameras or of the focal lengths, over the focal length."""
        if self.scale.size:
            return float(np.ptp(self.scale))
        first, second = self.cameras[:, [0, 2, 3, 4]]
        return float(np.abs(first - second).max() / second[0])


def view_groups(
    views: Views, state: CameraState, normal: Array, free: NDArray[np.bool_], networks: Array | None = None
) -> ViewGroups | None:
    """Find two cameras among the views, or a changing focal length; None if neither explains the error.

    The state is the common camera, at its minimum with all poses free; `networks` (V,) is the result of
    `free_networks`, if known.
    """
    conditions = conditions_on_views(views, state)
    n_free = int(free[:5].sum())
    spare = int(conditions.sum()) - n_free
    freedom = views.n_equations - float((6 + conditions).sum())
    if spare < n_free + _SPARE or freedom <= 0:
        return None
    cost = float(normal[:, -1, -1].sum())
    own = float((free_networks(views, state) if networks is None else networks).sum())
    if cost - own < _CONTRADICTS * spare * own / freedom:
        return None
    own = float(free_networks(views, state, OWN_STEPS).sum())
    noise = _NOISE * own / freedom
    quadratics = reduced(normal, free, True)
    scale, gain = _focal_lengths(quadratics, state, free)
    one_each = (cost - gain - own) / max(spare - views.n_views + 1, 1)
    told_apart = spare - views.n_views >= _SPARE - 1 and np.ptp(scale) >= _DIFFERENT
    if not (told_apart and (np.abs(scale - 1) < 0.5).all()):
        one_each = np.inf
    found = _two_cameras(views, state, quadratics, free)
    two = np.inf
    if found is not None and found.differs:
        two = (found.cost - own) / (spare - n_free)
    if min(one_each, two) > noise:
        return None
    if found is None or two > one_each + noise / _NOISE:
        return ViewGroups(((), ()), np.full((2, 5), np.nan), scale, gain / cost)
    member, cameras = found.member, found.cameras
    if np.count_nonzero(member) > np.count_nonzero(~member):
        member, cameras = ~member, cameras[::-1]
    names = np.array(views.names)
    px = views.pixel_scale * cameras + np.array([0, 0, 0, *views.pixel_centre])
    return ViewGroups(
        (tuple(names[member].tolist()), tuple(names[~member].tolist())),
        px,
        np.zeros(0),
        1.0 - found.cost / cost,
    )


def variance_of_views(views: Views, state: CameraState) -> float:
    """Variance of the residuals with a separate camera for each view, normalised."""
    unknowns = int((6 + conditions_on_views(views, state)).sum())
    return float(free_networks(views, state).sum()) / max(views.n_equations - unknowns, 1)


@frozen_dataclass(eq=False)
class _Split:
    member: NDArray[np.bool_]
    cameras: Array  # (2, 5), normalised
    cost: float

    @property
    def differs(self) -> bool:
        first, second = self.cameras[:, [0, 2, 3, 4]]
        return bool((np.abs(first - second) > _DIFFERENT * first[0]).any())


def _two_cameras(
    views: Views, state: CameraState, quadratics: Quadratics, free: NDArray[np.bool_]
) -> _Split | None:
    member = divided(quadratics)
    found: _Split | None = None
    for _ in range(_ADJUSTED):
        if member is None or min(np.count_nonzero(member), np.count_nonzero(~member)) < _FEWEST:
            return found
        groups = np.flatnonzero(member), np.flatnonzero(~member)
        both = [
            adjust(views.subset(which).batches, state.of_views(which), free, True, _STEPS).state
            for which in groups
        ]
        cost = np.stack([_cost_of_each(views, state, camera) for camera in both])
        cameras = np.stack([camera.entries[0] for camera in both])
        found = _Split(member, cameras, float(cost[0][member].sum() + cost[1][~member].sum()))
        nearer = cost[0] < cost[1]
        if (nearer == member).all():
            return found
        member = nearer
    return found


def divided(quadratics: Quadratics, starts: int = _STARTS) -> NDArray[np.bool_] | None:
    """The best clustering into two groups from several random starts, with the quadratic model."""
    rng = np.random.default_rng(0)
    V = len(quadratics.cost)
    best, division = np.inf, None
    for _ in range(starts):
        member = rng.random(V) < 0.5
        for _ in range(_ROUNDS):
            steps = quadratics.steps(np.array([member, ~member], dtype=float))
            if not np.isfinite(steps).all():
                break
            cost = np.stack([quadratics.at(step) for step in steps])
            total, nearer = float(cost.min(axis=0).sum()), cost[0] < cost[1]
            if total < best:
                best, division = total, nearer
            if (nearer == member).all():
                break
            member = nearer
    return division


def _cost_of_each(views: Views, state: CameraState, camera: CameraState) -> Array:
    """(V,) squared error of each view with a given camera and its best pose."""
    start = replace(camera, R=state.R, t=state.t)
    return adjust(views.batches, start, np.zeros(5 + camera.k.shape[-1], dtype=bool), True, _STEPS).cost


def _focal_lengths(q: Quadratics, state: CameraState, free: NDArray[np.bool_]) -> tuple[Array, float]:
    """(V,) focal length of each view over the common one, by one Gauss-Newton step.

    The second result is the drop in squared error with them and all other parameters in common.
    """
    d = np.zeros(len(free))
    d[:3] = state.entries[0][:3]
    d = d[free]  # step of the free parameters for a relative change of the focal length
    Sd, gd = q.S @ d, q.g @ d
    weight = 1 / np.maximum(Sd @ d, 1e-300)
    S = (q.S - weight[:, None, None] * Sd[:, :, None] * Sd[:, None, :]).sum(axis=0)
    g = (q.g - (weight * gd)[:, None] * Sd).sum(axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diagonal(q.S.sum(axis=0)), 1e-300))
    common = np.linalg.pinv(S * np.outer(scale, scale), rcond=1e-9, hermitian=True) @ (scale * g)
    gain = float((weight * gd**2).sum() + (scale * g) @ common)
    return np.asarray(1 + gd / np.einsum("i,vij,j->v", d, q.S, d)), gain

"""Views that repeat a pose: frames of a video without motion, or photographs from a tripod.

Such views count as one view wherever views are counted. How much independent information they hold is
measured: if a point has the same residual in all of them, n views are worth no more than one; if the
residuals are independent, they average out. If rho is the correlation of residuals between repeated views, n
of them are worth n / (1 + (n - 1) rho) views. Frames whose errors last from one to the next
(`following_views`) are counted in the same way, by blocks of views.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.adjustment.following_views import following_views
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.directions import WIDE
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, distinct_rows
from neurocal_cli.camera.projection import project_points
from neurocal_cli.camera.state import CameraState

# Repeated by test_repeated_poses.py: copies with 0.01 to 0.1 px of motion are found, and no two of a
# thousand random views are called the same.
_STILL = 1.0  # px by which the target's points may move, or
_NOISE = 3.0  # this many standard deviations of their noise, if that is more
_FEWEST = 3  # blocks of views that follow each other: with one left out, two must still differ
_ROWS = 100  # rows of the distance matrix computed at a time: they stay in the cache


def folds_of(n_groups: int, n_folds: int) -> NDArray[np.intp]:
    """(G,) fold of each group, assigned in turn; with at most `n_folds` groups each is a fold of its own."""
    return np.arange(n_groups) % n_folds if n_groups > n_folds else np.arange(n_groups)


@frozen_dataclass(eq=False)
class RepeatedPoses:
    """Groups of views whose errors are alike: they share a pose, or follow each other."""

    pose: NDArray[np.intp]  # (V,) number of each view's pose, from 0 in the order of the views
    group: NDArray[np.intp]  # (V,) the same of each view's group: these poses, or blocks of views
    correlation: float  # of a point's residuals between views of one group, 0 to 1

    @property
    def n_poses(self) -> int:
        """Number of different poses."""
        return int(self.pose.max(initial=-1)) + 1

    @property
    def n_groups(self) -> int:
        """Number of groups."""
        return int(self.group.max(initial=-1)) + 1

    @property
    def none(self) -> bool:
        """Whether every view is a group of its own."""
        return self.n_groups == len(self.group)

    @property
    def size(self) -> NDArray[np.intp]:
        """(G,) number of views of each group."""
        return np.bincount(self.group, minlength=self.n_groups)

    @property
    def variance(self) -> Array:
        """(G,) variance of a sum over the views of a group, relative to that of independent views."""
        return np.asarray(1.0 + (self.size - 1) * self.correlation)

    @property
    def worth(self) -> float:
        """Effective number of independent views over the number of views."""
        return float((self.size / self.variance).sum() / len(self.group))

    def folds(self, n_folds: int) -> NDArray[np.intp]:
        """(V,) fold of each view; views of one group are in the same fold."""
        return folds_of(self.n_groups, n_folds)[self.group]

    def summed(self, of_views: Array) -> Array:
        """Sum values of the views (V, ...) over the views of each group; (G, ...)."""
        out = np.zeros((self.n_groups, *of_views.shape[1:]))
        np.add.at(out, self.group, of_views)
        return out


def repeated_poses(views: Views, state: CameraState, errors: Array) -> RepeatedPoses:
    """Find views that repeat a pose or share errors that last, given the normalised state of a fit.

    `errors` (N, 2) are its normalised residuals, in the order of the views' points.
    """
    noise = float(np.sqrt((errors**2).mean())) if len(errors) else 0.0
    pose = _by_distance(_seen(views, state), max(_STILL / views.pixel_scale, _NOISE * noise))
    V, (length, variance) = len(pose), following_views(views, state, errors, pose)
    if length > 1:
        n = max(V // length, _FEWEST)
        return RepeatedPoses(pose, np.arange(V) * n // V, min((variance - 1.0) / (V / n - 1.0), 1.0))
    if int(pose.max()) + 1 == V:
        return RepeatedPoses(pose, pose, 0.0)
    return RepeatedPoses(pose, pose, _correlation(views, errors, pose))


def _seen(views: Views, state: CameraState) -> Array:
    """Normalised pixels of five target points in each view; (V, 10). Only wide lenses are distorted."""
    centre = views.counts @ views.centre / views.counts.sum()
    reach = views.scale[0] * views.extent[0, :2] * views.basis[0][:, :2]  # columns
    places = centre + np.concatenate([np.zeros((1, 3)), reach.T, -reach.T])
    local = (places - views.centre[:, None]) / views.scale[:, None, None]
    X, Y, Z = np.moveaxis(local @ np.swapaxes(state.R, 1, 2) + state.t[:, None], 2, 0)
    model, k = (state.model, state.k) if state.model in WIDE else ("none", np.zeros(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, in_front = project_points(state.entries.T[..., None], model, k, X, Y, Z)
        seen = np.concatenate([u, v], axis=1)
    lost = np.asarray(~in_front.all(axis=1) | ~np.isfinite(seen).all(axis=1))
    return np.where(lost[:, None], np.inf, seen)


def _by_distance(seen: Array, near: float) -> NDArray[np.intp]:
    """Pose number of each view: a pose consists of its first view and all views near that one.

    Nearness is not transitive here; otherwise a slow video would be a single pose.
    """
    V = len(seen)
    leader = np.arange(V)
    fit = np.asarray(np.isfinite(seen).all(axis=1))
    seen = np.where(fit[:, None], seen, 0.0)
    limit = near**2 * (seen.shape[1] / 2)  # rms over the places
    half = np.where(fit, 0.5 * (seen**2).sum(axis=1), np.inf)
    for first in range(0, V, _ROWS):
        rows = slice(first, first + _ROWS)
        close = seen[rows] @ seen.T > half[rows, None] + (half - 0.5 * limit)  # |a - b|^2 < limit
        for k in np.flatnonzero(close.sum(axis=1) > 1):
            if leader[first + k] == first + k:
                mine = close[k] & (leader == np.arange(V)) & (np.arange(V) > first + k)
                leader[mine] = first + k
    if (leader == np.arange(V)).all():
        return leader
    _, group = np.unique(leader, return_inverse=True)
    return group.reshape(-1)


def _correlation(views: Views, errors: Array, group: NDArray[np.intp]) -> float:
    """Correlation of a point's residuals between views of one pose; negative ones count as 0."""
    size = np.bincount(group)
    rows = np.flatnonzero((size > 1)[group][views.index])
    view = views.index[rows]
    place = np.round(views.world[rows] / (1e-6 * views.scale[0]))
    key = np.column_stack([group[view], place])
    _, same = distinct_rows(key)
    n = np.bincount(same)
    errors = errors[rows]
    together = np.stack([np.bincount(same, errors[:, k], len(n)) for k in (0, 1)], axis=1)
    power = np.bincount(same, (errors**2).sum(axis=1), len(n))
    whole = float(((n - 1) * power).sum())
    if not whole > 0:
        return 1.0
    return float(np.clip(((together**2).sum(axis=1) - power).sum() / whole, 0.0, 1.0))

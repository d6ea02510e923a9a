"""Stage 2: the trained products become cameras, one W for all views and a pose for each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurocal_cli.adjustment.problem import Problem, intrinsic_matrix
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.state import CameraState
from neurocal_cli.network.orthogonality import pose_from_product, shared_intrinsics
from neurocal_cli.network.view_networks import Group

# Repeated by tests/test_convergence.py: its 1300 scenes show how many local minima the conditions have, and
# which depths keep all points in front of the first camera.
_MOST_CANDIDATES = 4
_NEAREST = 1.05  # depth of the centroid, relative to that at which the nearest point reaches the focal plane


def candidate_intrinsics(problem: Problem, groups: Sequence[Group], rng: np.random.Generator) -> Array:
    """Candidates for W's entries, the minima of all views' orthogonality conditions; best first (C, 1, 5)."""
    flat, solid = np.zeros((0, 3, 2)), np.zeros((0, 3, 3))
    for group in groups:
        if group.flat:
            flat = group.product[:, :, :2]
        else:
            solid = group.product[:, :, :3]
    shared = shared_intrinsics(solid, flat, problem.normalised_entries, problem.free, rng)
    return shared.entries[:_MOST_CANDIDATES, None]


def cameras_from_products(problem: Problem, groups: Sequence[Group], entries: Array) -> CameraState:
    """Poses of the trained views, given W's entries (1, 5); all points in front.

    Views that are in no group get the identity.
    """
    views = problem.views
    V = views.n_views
    R, t = np.tile(np.eye(3), (V, 1, 1)), np.tile([0.0, 0.0, 2.0], (V, 1))
    W = intrinsic_matrix(entries[0])
    for group in groups:
        rotation, t[group.views] = pose_from_product(W, group.product)
        if group.flat:
            rotation = rotation @ np.swapaxes(views.basis[group.views], 1, 2)
        R[group.views] = rotation
    return CameraState(entries, R, _in_front(views, R, t))


def _in_front(views: Views, R: Array, t: Array) -> Array:
    """Move views that an inexact W puts partly behind the camera away along their ray; the new t."""
    # Local coordinates are at most 1, which gives a quick bound that nearly always suffices.
    if (t[:, 2] > np.abs(R[:, 2]).sum(axis=1)).all():
        return t
    depth = (views.local * np.repeat(R[:, 2], views.counts, axis=0)).sum(axis=1)
    lowest = np.minimum.reduceat(depth, views.first)
    return np.asarray(t * (np.maximum(t[:, 2], -_NEAREST * lowest) / t[:, 2])[:, None])

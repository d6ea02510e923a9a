"""Between a state in normalised units and one in pixels and world units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.geometry import Array


def in_pixels(problem: Problem, state: CameraState) -> CameraState:
    """Take a normalised state into pixels and world units; given entries come back exactly as given."""
    entries = problem.matrix(state.entries[0])[ENTRIES]
    return replace(state, entries=entries[None], t=translations(problem.views, state))


def normalised(state: CameraState, views: Views) -> CameraState:
    """The inverse, for the normalisation of any views; the poses are those of `views`, in their order."""
    entries = state.entries.copy()
    entries[:, 3:] -= views.pixel_centre
    t = translations_normalised(views, state.R, state.t)
    return replace(state, entries=entries / views.pixel_scale, t=t)


def translations(views: Views, state: CameraState) -> Array:
    """(V, 3) t in world units; the normalised one is of each view's centroid."""
    return state.t * views.scale[:, None] - (state.R @ views.centre[..., None])[..., 0]


def translations_normalised(views: Views, R: Array, t: Array) -> Array:
    """(V, 3) t of each view's centroid in units of its S2, from t in world units."""
    return np.asarray(((R @ views.centre[..., None])[..., 0] + t) / views.scale[:, None])

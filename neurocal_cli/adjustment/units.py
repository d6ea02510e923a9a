"""Convert a state between normalised units and pixels with world units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neurocal_cli.adjustment.problem import Problem
from neurocal_cli.adjustment.views import Views
from neurocal_cli.camera.geometry import Array
from neurocal_cli.camera.projection import ENTRIES
from neurocal_cli.camera.state import CameraState


def in_pixels(problem: Problem, state: CameraState) -> CameraState:
    """Convert a normalised state to pixels and world units; given entries come back exactly as given."""
    entries = problem.matrix(state.entries[0])[ENTRIES]
    return replace(state, entries=entries[None], t=translations(problem.views, state))


def normalised(state: CameraState, views: Views) -> CameraState:
    """Convert a state to the normalised units of `views`; its poses are those of `views`, in their order."""
    entries = state.entries.copy()
    entries[:, 3:] -= views.pixel_centre
    t = translations_normalised(views, state.R, state.t)
    return replace(state, entries=entries / views.pixel_scale, t=t)


def translations(views: Views, state: CameraState) -> Array:
    """(V, 3) t in world units, from the normalised t, which refers to each view's centroid."""
    return state.t * views.scale[:, None] - (state.R @ views.centre[..., None])[..., 0]


def translations_normalised(views: Views, R: Array, t: Array) -> Array:
    """(V, 3) t of each view's centroid in units of its S2, from t in world units."""
    return np.asarray(((R @ views.centre[..., None])[..., 0] + t) / views.scale[:, None])

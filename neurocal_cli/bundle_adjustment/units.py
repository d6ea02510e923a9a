"""Between normalised cameras and poses and those in pixels and world units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.bundle_adjustment.problem import Problem
from neurocal_cli.bundle_adjustment.reprojection import ENTRIES, CameraState
from neurocal_cli.bundle_adjustment.views import Views
from neurocal_cli.camera.distortion_models import Lens, distort
from neurocal_cli.geometry import Array

__all__ = ["Seen", "normalised", "see", "translations", "translations_normalised"]


@dataclass(frozen=True, eq=False)
class Seen:
    """A camera and its poses, in pixels and world units.

    Attributes
    ----------
    A : (3, 3) array
    lens : Lens
    R : (V, 3, 3) array
    t : (V, 3) array
    """

    A: Array
    lens: Lens
    R: Array
    t: Array

    @classmethod
    def of(cls, problem: Problem, state: CameraState) -> Seen:
        """Take a normalised state out of its units."""
        A = problem.matrix(state.entries[0])
        return cls(A, Lens(state.lens, state.k), state.R, translations(problem.views, state))

    def predict(self, world: Array, view: NDArray[np.intp]) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of world points through the pose of each one's view, and which lie in front."""
        return see(self.A, self.lens, (self.R[view] @ world[..., None])[..., 0] + self.t[view])


def see(A: Array, lens: Lens, camera: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of points in the camera's frame (N, 3), nan unless they lie in front, and which do."""
    depth = camera[:, 2]
    in_front = np.asarray(depth > 0)
    image = camera[:, :2] / np.where(in_front, depth, np.nan)[:, None]
    if lens.model != "none":
        image = np.column_stack(distort(lens.model, lens.coefficients, image[:, 0], image[:, 1]))
    return image @ A[:2, :2].T + A[:2, 2], in_front


def translations(views: Views, state: CameraState) -> Array:
    """(V, 3) t in world units; the normalised one is of each view's centroid."""
    return state.t * views.scale[:, None] - (state.R @ views.centre[..., None])[..., 0]


def translations_normalised(views: Views, R: Array, t: Array) -> Array:
    """(V, 3) t of each view's centroid in units of its S2, from t in world units."""
    return np.asarray(((R @ views.centre[..., None])[..., 0] + t) / views.scale[:, None])


def normalised(seen: Seen, views: Views) -> CameraState:
    """The state of other views' normalisation; the poses are those of `views`, in their order."""
    entries = seen.A[ENTRIES]
    entries[3:] -= views.pixel_centre
    t = translations_normalised(views, seen.R, seen.t)
    return CameraState(entries[None] / views.pixel_scale, seen.R, t, seen.lens.model, seen.lens.coefficients)

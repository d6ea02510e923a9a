"""`CameraState`: a camera and its poses as arrays, the unknowns that an adjustment moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurocal_cli.camera.directions import WITH_XI
from neurocal_cli.camera.distortion import Distortion, coefficient_names
from neurocal_cli.camera.frozen_dataclass import frozen_dataclass
from neurocal_cli.camera.geometry import Array, rotation_step


@frozen_dataclass(eq=False)
class CameraState:
    """Camera and poses, the unknowns of an adjustment, in normalised units or in pixels and world units."""

    # A11, A12, A22, A13, A23: (1, 5) of the camera that all views share, or (V, 5) of each view's own camera.
    entries: Array
    R: Array  # (V, 3, 3)
    t: Array  # (V, 3)
    model: str = "none"  # distortion model, one of `distortion.MODELS`
    # Coefficients of the model: (K,) the same for all views, or (V, K) each view's own.
    k: Array = field(default_factory=lambda: np.zeros(0))
    # Whether A22 follows A11, so that the pixels are square. The derivative by A11 is then that by both.
    square: bool = False

    @property
    def distortion(self) -> Distortion:
        """The distortion that all views share."""
        return Distortion(self.model, self.k)

    def with_model(self, model: str) -> CameraState:
        """The same camera with a model that begins with the same coefficients; new ones are 0."""
        k = np.zeros(len(coefficient_names(model)))
        kept = min(len(k), len(self.k))
        k[:kept] = self.k[:kept]
        return replace(self, model=model, k=k)

    def of_view(self, view: int) -> CameraState:
        """The state of one view alone."""
        own = slice(view, view + 1)
        entries = self.entries if len(self.entries) == 1 else self.entries[own]
        k = self.k if self.k.ndim == 1 else self.k[view]
        return replace(self, entries=entries, R=self.R[own], t=self.t[own], k=k)

    def of_views(self, which: NDArray[np.intp]) -> CameraState:
        """The state of some views, which share one camera."""
        return replace(self, R=self.R[which], t=self.t[which])

    def moved(self, by_camera: Array, by_pose: Array) -> CameraState:
        """The state after a step; by_camera (1 or V, 5 + K), by_pose (V, 6) with omega and tau."""
        R, t = rotation_step(by_pose[:, :3]) @ self.R, self.t + by_pose[:, 3:]
        return replace(self.changed(by_camera), R=R, t=t)

    def changed(self, by_camera: Array) -> CameraState:
        """The state after a step of the camera (1 or V, 5 + K)."""
        by_entries, by_k = by_camera[:, :5], by_camera[:, 5:]
        if self.model in WITH_XI:
            by_entries = by_entries + self._along_valley(by_entries, by_k)
        k = self.k + (by_k[0] if self.k.ndim == 1 else by_k)
        return replace(self.with_entries(self.entries + by_entries), k=k)

    def with_entries(self, entries: Array) -> CameraState:
        """The state with other entries of A; those of square pixels stay square."""
        if self.square:
            entries = np.concatenate([entries[:, :2], entries[:, :1], entries[:, 3:]], axis=1)
        return replace(self, entries=entries)

    def _along_valley(self, by_entries: Array, by_k: Array) -> Array:
        """Second-order correction of a step along the valley in which xi and alpha compensate.

        The points determine the scale in the image centre, alpha / (1 + xi).
        """
        bend = np.zeros_like(by_entries)
        xi, by_xi = self.k[..., :1], by_k[:, :1]
        bend[:, :3] = by_xi / (1 + xi) * (by_entries[:, :3] - self.entries[:, :3] * by_xi / (1 + xi))
        return bend

    def camera_of(self, view: NDArray[np.intp]) -> tuple[Sequence[Any] | Array, Sequence[Any] | Array]:
        """A's entries and the coefficients for the points of some batches, given each batch's view."""
        # For one camera, Python numbers are faster than NumPy scalars or columns of one.
        entries = self.entries[view].T[..., None] if len(self.entries) > 1 else self.entries[0].tolist()
        return entries, self.k.tolist() if self.k.ndim == 1 else self.k[view].T[..., None]
